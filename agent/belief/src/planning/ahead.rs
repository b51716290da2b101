//! Beam search over several consecutive paths. The robot flies only the first path, but can thus head for cells that a
//! single path cannot reach. If no planned path reaches a valuable cell, the robot heads for the nearest one.

use crate::planning::beam::BeamSearch;
use crate::planning::objective::{BEAM_BONUS, CellValues};
use crate::planning::planner::{Plan, Planner, PlanningProblem};
use emberwatch_model::{Cell, Grid};

/// Number of paths per plan. With T = 12 moves each, they reach most cells of a 64 x 64 grid.
const N_PATHS: usize = 6;

/// Discount from each path to the next, because cells may have burnt out by the time a later path reaches them.
const DISCOUNT: f32 = 0.8;

/// A planner that plans six consecutive paths and returns the first.
#[derive(Debug)]
pub struct Ahead(BeamSearch);

impl Ahead {
    /// Creates a planner with a beam of `width` states.
    ///
    /// # Panics
    /// If `width` is 0.
    pub fn new(width: usize) -> Self {
        Self(BeamSearch::new(width))
    }
}

impl Planner for Ahead {
    fn plan(&mut self, problem: &PlanningProblem<'_>) -> Plan {
        let n_moves = problem.n_moves;
        let discount = DISCOUNT.powf(1.0 / n_moves.max(1) as f32);
        let mut values = problem.values.clone();
        values.add(BEAM_BONUS, &promise(problem.values, discount));
        self.0.set_discount(discount);
        let all = self.0.plan(&PlanningProblem {
            n_moves: N_PATHS * n_moves,
            values: &values,
            ..*problem
        });
        let mut moves = all.moves;
        moves.truncate(n_moves);
        let score = problem.values.score(problem.start, &moves);
        Plan { moves, score }
    }
}

/// Each move towards a cell multiplies its value by `kept_per_move`. Guides the search where all values are equal.
fn promise(values: &CellValues, kept_per_move: f32) -> Grid<f32> {
    let mut promise = values.worth().mapv(|value| value.max(0.0));
    let airspace = values.airspace();
    let is_free = |(row, col): (usize, usize)| airspace.is_free(Cell { row, col });
    // No-fly cells have no value, and no path leads through them.
    let all = promise.indexed_iter_mut();
    all.filter(|(at, _)| !is_free(*at))
        .for_each(|(_, promise)| *promise = 0.0);
    let (height, width) = promise.dim();
    let cells = (0..height).flat_map(|row| (0..width).map(move |col| (row, col)));
    let mut spread = |(row, col): (usize, usize), from: [(usize, usize); 2]| {
        for near in from.into_iter().filter(|_| is_free((row, col))) {
            let passed_on = promise.get(near).map_or(0.0, |near| near * kept_per_move);
            promise[[row, col]] = promise[[row, col]].max(passed_on);
        }
    };
    // One pass down and to the right, then one pass back. On an open grid, they cover a shortest path between any
    // two cells.
    for (row, col) in cells.clone() {
        spread(
            (row, col),
            [(row.wrapping_sub(1), col), (row, col.wrapping_sub(1))],
        );
    }
    for (row, col) in cells.collect::<Vec<_>>().into_iter().rev() {
        spread((row, col), [(row + 1, col), (row, col + 1)]);
    }
    promise
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_promise_fades_with_distance() {
        let best = [((2, 1), 1.0_f32), ((6, 7), 0.9)];
        let mut value = Grid::zeros((8, 9));
        best.iter().for_each(|&(at, worth)| value[at] = worth);
        let promise = promise(&CellValues::new(value, 0.02), 0.9);
        for ((row, col), &got) in promise.indexed_iter() {
            let of = |&((r, c), worth): &((usize, usize), f32)| {
                worth * 0.9_f32.powi((row.abs_diff(r) + col.abs_diff(c)) as i32)
            };
            let expected = best.iter().map(of).fold(0.0, f32::max);
            assert!((got - expected).abs() < 1e-6, "{row} {col}");
        }
    }

    #[test]
    fn values_out_of_reach_still_attract_the_robot() {
        let mut value = Grid::zeros((64, 64));
        value[(60, 5)] = 1.0;
        let values = CellValues::new(value, BEAM_BONUS);
        let plan = Ahead::new(50).plan(&PlanningProblem {
            start: Cell { row: 5, col: 5 },
            n_moves: 4,
            values: &values,
            seed: 0,
            step: 0,
        });
        assert_eq!(plan.moves, [emberwatch_model::Move::Down; 4]);
    }
}
