//! Plans of several robots.

use super::fields::{Field, RANDOM, fields, objectives, paths};
use emberwatch_belief::planning::team::{ROUNDS, plan_team, robot_seed};
use emberwatch_belief::planning::{
    BeamSearch, CellValues, Integration, Objective, Plan, Planner, Shooting, Target,
};
use emberwatch_model::path::fly;
use emberwatch_model::{Cell, Move, Shape};
use proptest::prelude::*;
use std::collections::BTreeSet;

/// Robots, and what cells are worth to them.
struct Team<'a> {
    field: &'a Field,
    values: CellValues,
}

impl<'a> Team<'a> {
    fn new(field: &'a Field, objective: Objective) -> Self {
        let values = objective.values(&field.belief);
        Self { field, values }
    }

    fn plan(&self, planner: &mut dyn Planner, rounds: usize) -> Vec<Plan> {
        let Field {
            starts, n_moves, ..
        } = self.field;
        plan_team(planner, &self.values, starts, *n_moves, RANDOM, rounds)
    }

    /// What the team gains: each cell once, however many robots visit it, unless each visit counts.
    fn worth(&self, plans: &[Plan]) -> f64 {
        let paths: Vec<&[Move]> = plans.iter().map(|plan| &*plan.moves).collect();
        self.worth_of(&paths)
    }

    fn worth_of(&self, paths: &[&[Move]]) -> f64 {
        let robots = self.field.starts.iter().zip(paths);
        if self.values.revisits() {
            let own = robots.map(|(&start, path)| self.values.score(start, path));
            return own.map(f64::from).sum();
        }
        let shape = self.values.shape();
        let visited = robots.flat_map(|(&start, path)| fly(shape, start, path).visited);
        let cells: BTreeSet<usize> = visited.collect();
        let gain = |&index: &usize| {
            let cell = shape.cell(index);
            self.values.value()[[cell.row, cell.col]] + self.values.coverage_bonus()
        };
        cells.iter().map(gain).map(f64::from).sum()
    }

    /// The most that any two paths gain.
    fn optimum_of_two(&self) -> f64 {
        let paths = paths(self.field.n_moves);
        let pairs = paths.iter().flat_map(|a| paths.iter().map(move |b| (a, b)));
        let worth = pairs.map(|(a, b)| self.worth_of(&[a, b]));
        worth.fold(f64::NEG_INFINITY, f64::max)
    }
}

fn planners() -> [Box<dyn Planner>; 3] {
    [
        Box::new(BeamSearch::new(1)),
        Box::new(BeamSearch::new(20)),
        Box::new(Shooting::new(20, Integration::ClampEachMove)),
    ]
}

/// Sums of `f32` in another order.
const ROUNDING: f64 = 1e-4;

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(200) })]

    #[test]
    fn a_team_has_a_path_for_each_robot_and_the_scores_it_reports(
        field in fields(12, 30, 6),
        objective in objectives(),
    ) {
        let team = Team::new(&field, objective);
        for mut planner in planners() {
            let plans = team.plan(&mut *planner, ROUNDS);
            prop_assert_eq!(plans.len(), field.starts.len());
            prop_assert!(plans.iter().all(|plan| plan.moves.len() == field.n_moves));
            // In order of planning each score counts what was left: none counts a cell twice.
            let greedy = team.plan(&mut *planner, 0);
            let scores: f64 = greedy.iter().map(|plan| f64::from(plan.score)).sum();
            prop_assert!((scores - team.worth(&greedy)).abs() < ROUNDING * scores.abs().max(1.0));
        }
    }

    #[test]
    fn a_teams_value_never_falls_from_round_to_round(
        field in fields(8, 20, 5),
        objective in objectives(),
    ) {
        let team = Team::new(&field, objective);
        for mut planner in planners() {
            let worth = |rounds| team.worth(&team.plan(&mut *planner, rounds));
            let values: Vec<f64> = (0..5).map(worth).collect();
            let rises = |pair: &[f64]| pair[1] >= pair[0] - ROUNDING * pair[0].abs().max(1.0);
            prop_assert!(values.windows(2).all(rises), "{:?}", values);
        }
    }

    #[test]
    fn a_team_plan_depends_on_nothing_but_the_problem(
        field in fields(12, 30, 5),
        other in fields(16, 40, 5),
        objective in objectives(),
    ) {
        let (team, other) = (Team::new(&field, objective), Team::new(&other, objective));
        for (mut used, mut fresh) in planners().into_iter().zip(planners()) {
            other.plan(&mut *used, ROUNDS);
            prop_assert_eq!(team.plan(&mut *used, ROUNDS), team.plan(&mut *fresh, ROUNDS));
        }
    }

    #[test]
    fn one_robot_is_planned_once_as_if_there_were_no_team(
        field in fields(20, 70, 1),
        objective in objectives(),
    ) {
        let team = Team::new(&field, objective);
        for (mut planner, mut of_team) in planners().into_iter().zip(planners()) {
            let alone = planner.plan(&field.problem(&team.values));
            prop_assert_eq!(team.plan(&mut *of_team, ROUNDS), [alone]);
        }
    }
}

/// Two robots on 2 x 3 cells with two moves, for which a beam of 16 holds all paths.
fn pair(starts: [(usize, usize); 2], seed: u64) -> Field {
    let shape = Shape::new(2, 3).expect("valid sides");
    let starts = starts.map(|(row, col)| Cell { row, col }).to_vec();
    Field::new(shape, starts, 2, seed)
}

#[test]
fn two_robots_gain_nearly_what_the_best_pair_of_paths_gains() {
    let (mut n_best, mut n_all) = (0, 0);
    for seed in 0..60 {
        for starts in [[(0, 0), (0, 0)], [(0, 1), (1, 1)], [(0, 0), (1, 2)]] {
            let field = pair(starts, seed);
            let team = Team::new(&field, Objective::new(Target::State(0)));
            let worth = team.worth(&team.plan(&mut BeamSearch::new(16), ROUNDS));
            let optimum = team.optimum_of_two();
            assert!(worth <= optimum + ROUNDING, "{worth} above {optimum}");
            // What a greedy team is worth at least (Fisher, Nemhauser and Wolsey, 1978).
            assert!(worth >= optimum / 2.0 - ROUNDING, "{worth} of {optimum}");
            n_best += usize::from(worth >= optimum - ROUNDING);
            n_all += 1;
        }
    }
    assert!(
        4 * n_best >= 3 * n_all,
        "the best pair in {n_best} of {n_all}"
    );
}

#[test]
fn a_second_robot_leaves_the_best_cells_to_the_first() {
    // On a row of five both start in the middle: one goes left, one right.
    let shape = Shape::new(1, 5).expect("valid sides");
    let start = Cell { row: 0, col: 2 };
    let field = Field::new(shape, vec![start; 2], 2, 0);
    let team = Team::new(&field, Objective::new(Target::Coverage));
    let plans = team.plan(&mut BeamSearch::new(16), ROUNDS);
    assert_eq!(team.worth(&plans), 4.0);
    assert_ne!(plans[0].moves, plans[1].moves);
    let alone = team.plan(&mut BeamSearch::new(16), 0)[0].clone();
    assert_eq!(team.worth(&[alone.clone(), alone]), 2.0);
}

#[test]
fn planning_again_against_the_others_gains_more_than_planning_once() {
    // The first robot may take cells of which the second can reach no others.
    let gains = |rounds| {
        let count = |seed| {
            let field = pair([(0, 1), (0, 0)], seed);
            let team = Team::new(&field, Objective::new(Target::State(0)));
            team.worth(&team.plan(&mut BeamSearch::new(16), rounds))
        };
        (0..200).map(count).sum::<f64>()
    };
    assert!(
        gains(ROUNDS) > gains(0) + 0.5,
        "{} and {}",
        gains(0),
        gains(ROUNDS)
    );
}

#[test]
fn robots_draw_different_random_numbers_and_the_first_its_worlds() {
    let seeds: BTreeSet<u64> = (0..64).map(|robot| robot_seed(7, robot)).collect();
    assert_eq!((seeds.len(), robot_seed(7, 0)), (64, 7));
}
