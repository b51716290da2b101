//! Tests of plans for several robots.

use super::fields::{Field, RANDOM, fields, objectives};
use emberwatch_belief::planning::team::{ROUNDS, plan_team, robot_seed};
use emberwatch_belief::planning::{
    BeamSearch, CellValues, Integration, Objective, Plan, Planner, Shooting, Target,
};
use emberwatch_model::{Airspace, Cell, Move, Shape};
use proptest::prelude::*;
use std::collections::BTreeSet;

/// The robots of a team on a grid without no-fly cells.
struct Team<'a> {
    field: &'a Field,
    objective: Objective,
    values: CellValues,
}

impl<'a> Team<'a> {
    fn new(field: &'a Field, objective: Objective) -> Self {
        Self {
            field,
            objective,
            values: objective.values(&field.belief),
        }
    }

    fn plan(&self, planner: &mut dyn Planner, rounds: usize) -> Vec<Plan> {
        let (starts, n_moves) = (&self.field.starts, self.field.n_moves);
        plan_team(planner, &self.values, starts, n_moves, RANDOM, rounds)
    }

    fn worth(&self, plans: &[Plan]) -> f32 {
        let paths: Vec<&[Move]> = plans.iter().map(|plan| &*plan.moves).collect();
        self.worth_of(&paths)
    }

    fn worth_of(&self, paths: &[&[Move]]) -> f32 {
        let open = Airspace::open(self.values.shape());
        self.field.score(self.objective, &open, paths)
    }
}

/// Tolerance for `f32` sums in a different order.
const ROUNDING: f32 = 1e-4;

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(64) })]

    #[test]
    fn a_teams_value_never_falls_from_round_to_round(
        field in fields(12, 30, 5),
        objective in objectives(),
    ) {
        let team = Team::new(&field, objective);
        let planners: [Box<dyn Planner>; 3] = [
            Box::new(BeamSearch::new(1)),
            Box::new(BeamSearch::new(20)),
            Box::new(Shooting::new(20, Integration::ClampEachMove)),
        ];
        for mut planner in planners {
            let rounds: Vec<_> = (0..4).map(|rounds| team.plan(&mut *planner, rounds)).collect();
            let rounding = ROUNDING * team.worth(&rounds[0]).abs().max(1.0);
            prop_assert_eq!(&rounds[0][0], &planner.plan(&field.problem(&team.values)));
            for pair in rounds.windows(2) {
                prop_assert!(team.worth(&pair[1]) >= team.worth(&pair[0]) - rounding);
                prop_assert_eq!(pair[1].len(), field.starts.len());
                prop_assert!(pair[1].iter().all(|plan| plan.moves.len() == field.n_moves));
                prop_assert!(field.starts.len() > 1 || pair[0] == pair[1]);
            }
        }
    }
}

#[test]
fn two_robots_gain_nearly_what_the_best_pair_of_paths_gains() {
    let shape = Shape::new(2, 3).expect("valid sides");
    let paths: Vec<[Move; 2]> = (0..16)
        .map(|code| [code, code >> 2].map(Move::from_low_bits))
        .collect();
    let (mut n_best, mut n_all, mut gained, mut gained_at_once) = (0, 0, 0.0, 0.0);
    for seed in 0..30 {
        for starts in [[(0, 1), (0, 0)], [(0, 1), (1, 1)], [(0, 0), (1, 2)]] {
            let starts = starts.map(|(row, col)| Cell { row, col }).to_vec();
            let field = Field::new(shape, starts, 2, seed);
            let team = Team::new(&field, Objective::new(Target::State(0)));
            // A beam of width 16 contains all paths.
            let plan = |rounds| team.worth(&team.plan(&mut BeamSearch::new(16), rounds));
            let pairs = paths.iter().flat_map(|a| paths.iter().map(move |b| (a, b)));
            let optimum = pairs.map(|(a, b)| team.worth_of(&[a, b]));
            let (worth, optimum) = (plan(ROUNDS), optimum.fold(0.0, f32::max));
            assert!(worth <= optimum + ROUNDING, "{worth} above {optimum}");
            // A greedy team reaches at least half of the optimum (Fisher, Nemhauser and Wolsey, 1978).
            assert!(worth >= optimum / 2.0 - ROUNDING, "{worth} of {optimum}");
            n_best += usize::from(worth >= optimum - ROUNDING);
            n_all += 1;
            (gained, gained_at_once) = (gained + worth, gained_at_once + plan(0));
        }
    }
    assert!(3 * n_best >= 2 * n_all, "{n_best} of {n_all}");
    // In a greedy team, the first robot may take the only cells that the second can reach.
    assert!(gained > gained_at_once + 0.1, "{gained} {gained_at_once}");
}

#[test]
fn robots_draw_different_random_numbers_and_the_first_its_worlds() {
    let seeds: BTreeSet<u64> = (0..64).map(|robot| robot_seed(7, robot)).collect();
    assert_eq!((seeds.len(), robot_seed(7, 0)), (64, 7));
}
