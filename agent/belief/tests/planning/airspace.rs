//! Plans around no-fly cells and for what is seen beside a path, against all paths.

use super::fields::Field;
use emberwatch_belief::planning::team::plan_team;
use emberwatch_belief::planning::{
    Ahead, BeamSearch, CellValues, Integration, Memory, OPTIONS, Objective, OptionPlanner, Outlook,
    Planner, RandomWalk, Shooting, Target,
};
use emberwatch_model::Pays;
use emberwatch_model::randomness::split_mix;
use emberwatch_model::{Airspace, Cell, Grid, Move, Shape};
use proptest::prelude::*;
use std::collections::BTreeSet;
use std::sync::Arc;

/// Free cells with a way out, of a grid where a quarter is closed.
fn airspace(key: u64, shape: Shape, start: Cell, radius: usize, pays: Pays) -> Airspace {
    let closed = |index: usize| split_mix(key, index as u64).is_multiple_of(4);
    let map = Grid::from_shape_fn(shape.dim(), |(row, col)| {
        let cell = Cell { row, col };
        let near = row.abs_diff(start.row) + col.abs_diff(start.col) < 2;
        !near && closed(shape.index(cell))
    });
    Airspace::new(shape, Some(Arc::new(map)), radius, 1, pays)
}

/// The sum over the distinct cells that count, by sets of cells.
fn score(objective: Objective, field: &Field, air: &Airspace, moves: &[Move]) -> f32 {
    let shape = air.shape();
    let mut cell = field.starts[0];
    let mut counted = BTreeSet::new();
    for step in moves {
        let next = step.apply(cell, shape);
        cell = if air.is_free(next) { next } else { cell };
        let is_seen = objective.target == Target::Entropy || air.pays() == Pays::Seen;
        let radius = if is_seen { air.radius() } else { 0 };
        for (row, col) in ndarray::indices(shape.dim()) {
            if row.abs_diff(cell.row).max(col.abs_diff(cell.col)) <= radius {
                counted.insert((row, col));
            }
        }
    }
    let value = |at: &(usize, usize)| match objective.target {
        Target::State(state) => field.belief.probability(state)[*at],
        Target::Entropy => field.belief.entropy(objective.entropy)[*at],
        Target::Coverage => 0.0,
    };
    counted
        .iter()
        .map(|at| value(at) + objective.coverage_bonus)
        .sum()
}

fn moves(code: u64, n_moves: usize) -> Vec<Move> {
    (0..n_moves)
        .map(|at| Move::from_low_bits(code >> (2 * at)))
        .collect()
}

/// Whether a path has no move into a no-fly cell.
fn avoids(air: &Airspace, start: Cell, moves: &[Move]) -> bool {
    let mut cell = start;
    moves.iter().all(|step| {
        let next = step.apply(cell, air.shape());
        cell = next;
        air.is_free(next)
    })
}

proptest! {
    // No file of failures: tests leave the source tree alone.
    #![proptest_config(ProptestConfig { cases: 60, failure_persistence: None, ..Default::default() })]

    #[test]
    fn plans_are_the_best_of_all_paths_and_avoid_no_fly_cells(
        key in any::<u64>(),
        (height, width) in (2_usize..9, 2_usize..9),
        radius in 0_usize..4,
        target in prop_oneof![Just(Target::State(0)), Just(Target::Entropy), Just(Target::Coverage)],
        seen in any::<bool>(),
    ) {
        let shape = Shape::new(height, width).expect("test shape");
        let start = shape.cell((key % shape.n_cells() as u64) as usize);
        let pays = if seen { Pays::Seen } else { Pays::Visited };
        let air = airspace(key, shape, start, radius, pays);
        let field = Field::new(shape, vec![start], 5, key);
        let objective = Objective { coverage_bonus: 0.1, ..Objective::new(target) };
        let values = objective.values_in(&field.belief, &air);
        let all = (0..4_u64.pow(5)).map(|code| moves(code, 5));
        let mut best = f32::NEG_INFINITY;
        for path in all {
            let expected = score(objective, &field, &air, &path);
            let got = values.score(start, &path);
            prop_assert!((got - expected).abs() < 1e-4, "{got}, expected {expected}");
            best = best.max(expected);
        }
        let problem = field.problem(&values);
        let planners: [(Box<dyn Planner>, bool); 5] = [
            (Box::new(BeamSearch::new(4096)), true),
            (Box::new(BeamSearch::new(20)), false),
            (Box::new(Ahead::new(20)), false),
            (Box::new(Shooting::new(20, Integration::ClampSum)), false),
            (Box::new(RandomWalk), false),
        ];
        for (mut planner, is_exact) in planners {
            let plan = planner.plan(&problem);
            let flown = score(objective, &field, &air, &plan.moves);
            prop_assert!((plan.score - flown).abs() < 1e-4, "{} {flown}", plan.score);
            prop_assert!(!is_exact || (plan.score - best).abs() < 1e-4, "{} {best}", plan.score);
            prop_assert!(avoids(&air, start, &plan.moves));
        }
        let outlook = Outlook::new(&field.belief, &air, 0, &Memory::new(shape), 5);
        let proposals = OptionPlanner::new(20).propose(&outlook, start);
        prop_assert_eq!(proposals.len(), OPTIONS.len());
        prop_assert!(proposals.iter().all(|it| avoids(&air, start, &it.plan.moves)));
    }

    #[test]
    fn teammates_gain_nothing_from_what_another_sees(
        key in any::<u64>(),
        radius in 1_usize..4,
    ) {
        let shape = Shape::new(12, 14).expect("test shape");
        let start = Cell { row: 5, col: 6 };
        let air = airspace(key, shape, start, radius, Pays::Seen);
        let field = Field::new(shape, vec![start], 6, key);
        let values = Objective::new(Target::State(0)).values_in(&field.belief, &air);
        let plans = plan_team(&mut BeamSearch::new(50), &values, &[start, start], 6, (1, 2), 0);
        let first: BTreeSet<usize> = seen_from(&values, start, &plans[0].moves);
        let second = seen_from(&values, start, &plans[1].moves);
        let gain: f32 = second.difference(&first).map(|&cell| {
            field.belief.probability(0)[[cell / 14, cell % 14]]
        }).sum();
        prop_assert!((plans[1].score - gain).abs() < 1e-3, "{} {gain}", plans[1].score);
    }
}

fn seen_from(values: &CellValues, start: Cell, moves: &[Move]) -> BTreeSet<usize> {
    let visited = values.airspace().fly(start, moves).visited;
    values
        .airspace()
        .see(&visited)
        .iter()
        .map(|it| it.cell)
        .collect()
}
