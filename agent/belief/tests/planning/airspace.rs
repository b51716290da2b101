//! Tests plans with no-fly cells and with cells in sight of the path, against an enumeration of all paths.

use super::fields::{Field, RANDOM};
use emberwatch_belief::planning::team::plan_team;
use emberwatch_belief::planning::{
    Ahead, BeamSearch, Integration, Memory, OPTIONS, Objective, OptionPlanner, Planner, RandomWalk,
    Shooting, Target, ValueLayers,
};
use emberwatch_model::randomness::split_mix;
use emberwatch_model::{Airspace, Cell, Grid, Move, Shape};
use proptest::prelude::*;
use std::sync::Arc;

/// Closes a quarter of a grid's cells at random, but not the start or the cells next to it.
fn airspace(key: u64, shape: Shape, start: Cell, radius: usize) -> Airspace {
    let closed = |index: usize| split_mix(key, index as u64).is_multiple_of(4);
    let map = Grid::from_shape_fn(shape.dim(), |(row, col)| {
        let near = row.abs_diff(start.row) + col.abs_diff(start.col) < 2;
        !near && closed(shape.index(Cell { row, col }))
    });
    Airspace::new(shape, Some(Arc::new(map)), radius)
}

/// Checks that no move of a path leads into a no-fly cell.
fn avoids(air: &Airspace, start: Cell, moves: &[Move]) -> bool {
    let mut cell = start;
    moves.iter().all(|step| {
        cell = step.apply(cell, air.shape());
        air.is_free(cell)
    })
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(60) })]

    #[test]
    fn plans_are_the_best_of_all_paths_and_avoid_no_fly_cells(
        key in any::<u64>(),
        (height, width) in (1_usize..9, 1_usize..9),
        radius in 0_usize..4,
        target in prop_oneof![Just(Target::State(0)), Just(Target::Entropy), Just(Target::Coverage)],
    ) {
        let shape = Shape::new(height, width).expect("test shape");
        let start = shape.cell((key % shape.n_cells() as u64) as usize);
        let air = airspace(key, shape, start, radius);
        let field = Field::new(shape, vec![start; 2], 5, key);
        let objective = Objective { coverage_bonus: 0.1, ..Objective::new(target) };
        let values = objective.values_in(&field.belief, &air);
        let mut best = f32::NEG_INFINITY;
        for code in 0..4_u64.pow(5) {
            let path = [0, 2, 4, 6, 8].map(|bits| Move::from_low_bits(code >> bits));
            let expected = field.score(objective, &air, &[&path]);
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
            let flown = field.score(objective, &air, &[&plan.moves]);
            prop_assert!((plan.score - flown).abs() < 1e-4, "{} {flown}", plan.score);
            let is_best = (plan.score - best).abs() < 1e-4;
            prop_assert!(!is_exact || is_best, "{} {best}", plan.score);
            prop_assert!(avoids(&air, start, &plan.moves));
        }
        // A robot gains nothing from cells that a teammate sees or visits.
        let team = plan_team(&mut BeamSearch::new(20), &values, &field.starts, 5, RANDOM, 0);
        let paths = [0, 1].map(|robot| &*team[robot].moves);
        let (gains, together) = (team[0].score + team[1].score, field.score(objective, &air, &paths));
        prop_assert!((gains - together).abs() < 1e-3, "{gains} {together}");
        let layers = ValueLayers::new(&field.belief, &air, 0, &Memory::new(shape), 5);
        let proposals = OptionPlanner::new(20).propose(&layers, start);
        prop_assert_eq!(proposals.len(), OPTIONS.len());
        for proposal in proposals {
            prop_assert!(avoids(&air, start, &proposal.plan.moves));
            // With a wide sensor, a path may show many cells.
            let most = if radius == 0 { 10.0 } else { 100.0 };
            prop_assert!(proposal.features.iter().all(|number| (0.0..=most).contains(number)));
        }
    }
}
