//! Random planning problems.

use emberwatch_belief::Belief;
use emberwatch_belief::planning::{CellValues, Objective, PlanningProblem, Target};
use emberwatch_model::randomness::split_mix;
use emberwatch_model::{Airspace, Cell, Move, Probabilities, Shape};
use proptest::prelude::*;
use std::collections::BTreeSet;

/// The seed and the step that select the planners' random numbers.
pub const RANDOM: (u64, u64) = (3, 5);

/// A random belief about two states, and the robots' starts.
#[derive(Debug, Clone)]
pub struct Field {
    pub belief: Belief,
    pub starts: Vec<Cell>,
    pub n_moves: usize,
}

impl Field {
    pub fn new(shape: Shape, starts: Vec<Cell>, n_moves: usize, seed: u64) -> Self {
        let (height, width) = shape.dim();
        let numbers = Probabilities::from_shape_fn((2, height, width), |(state, row, col)| {
            let index = shape.index(Cell { row, col }) as u64;
            let p = (split_mix(seed, index) >> 40) as f32 / (1 << 24) as f32;
            if state == 0 { p } else { 1.0 - p }
        });
        Self {
            belief: Belief::from_probabilities(numbers).expect("on the simplex"),
            starts,
            n_moves,
        }
    }

    pub fn values(&self) -> CellValues {
        Objective::new(Target::State(0)).values(&self.belief)
    }

    /// Computes the score of the robots' paths from the set of their cells. Each cell counts once.
    pub fn score(&self, objective: Objective, air: &Airspace, paths: &[&[Move]]) -> f32 {
        let radius = match objective.target {
            Target::Entropy => air.radius(),
            _ => 0,
        };
        let mut counted = BTreeSet::new();
        for (start, path) in self.starts.iter().zip(paths) {
            let mut cell = *start;
            for step in *path {
                let next = step.apply(cell, air.shape());
                cell = if air.is_free(next) { next } else { cell };
                for (row, col) in ndarray::indices(air.shape().dim()) {
                    if row.abs_diff(cell.row).max(col.abs_diff(cell.col)) <= radius {
                        counted.insert((row, col));
                    }
                }
            }
        }
        let value = |at: &(usize, usize)| match objective.target {
            Target::State(state) => self.belief.probability(state)[*at],
            Target::Entropy => self.belief.mean_entropy()[*at],
            Target::Coverage => 0.0,
        };
        let bonus = objective.coverage_bonus * counted.len() as f32;
        counted.iter().map(value).sum::<f32>() + bonus
    }

    /// Returns the planning problem of the first robot.
    pub fn problem<'a>(&self, values: &'a CellValues) -> PlanningProblem<'a> {
        PlanningProblem {
            start: self.starts[0],
            n_moves: self.n_moves,
            values,
            seed: RANDOM.0,
            step: RANDOM.1,
        }
    }
}

pub fn fields(
    max_side: usize,
    max_moves: usize,
    max_robots: usize,
) -> impl Strategy<Value = Field> {
    let sides = (1..=max_side, 1..=max_side);
    let sized = sides.prop_flat_map(move |(height, width)| {
        let start = (0..height, 0..width).prop_map(|(row, col)| Cell { row, col });
        let starts = prop::collection::vec(start, 1..=max_robots);
        (Just((height, width)), starts, 0..=max_moves, any::<u64>())
    });
    sized.prop_map(|((height, width), starts, n_moves, seed)| {
        let shape = Shape::new(height, width).expect("valid sides");
        Field::new(shape, starts, n_moves, seed)
    })
}

pub fn objectives() -> impl Strategy<Value = Objective> {
    let targets = prop_oneof![
        Just(Target::State(0)),
        Just(Target::Entropy),
        Just(Target::Coverage),
    ];
    let objectives = (targets, 0.0..2.0_f32);
    objectives.prop_map(|(target, coverage_bonus)| Objective {
        coverage_bonus,
        ..Objective::new(target)
    })
}
