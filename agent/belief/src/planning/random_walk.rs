//! The random walk, which is the paper's baseline and the robot's path in sections III.B and III.C.

use crate::planning::planner::{Plan, Planner, PlanningProblem};
use emberwatch_model::path::Move;
use emberwatch_model::randomness::{Purpose, stream};
use rand_chacha::rand_core::Rng;

/// A planner that draws moves uniformly and independently, and avoids no-fly cells.
#[derive(Debug, Clone, Copy, Default)]
pub struct RandomWalk;

impl Planner for RandomWalk {
    fn plan(&mut self, problem: &PlanningProblem<'_>) -> Plan {
        let mut rng = stream(problem.seed, Purpose::Planner, problem.step);
        let random_move = |_| Move::from_low_bits(rng.next_u64() >> 62);
        let mut moves: Vec<Move> = (0..problem.n_moves).map(random_move).collect();
        problem
            .values
            .airspace()
            .fly_around(problem.start, &mut moves);
        let score = problem.values.score(problem.start, &moves);
        Plan { moves, score }
    }
}
