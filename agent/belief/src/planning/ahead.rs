//! Beam search over several paths, of which the first is flown: it sets out for what one path cannot reach.

use crate::planning::beam::BeamSearch;
use crate::planning::planner::{Plan, Planner, PlanningProblem};

/// Paths that are planned at once. On the true states of wildfire-sparse and wildfire-latent (T = 12) a
/// plan of six paths sees most of the grid.
const N_PATHS: usize = 6;

/// Worth of a path's cells beside those of the path before it: what a later path finds may have burnt out by then.
const DISCOUNT: f32 = 0.8;

/// Plans [`N_PATHS`] paths and gives the first.
#[derive(Debug)]
pub struct Ahead(BeamSearch);

impl Ahead {
    /// A search that keeps `width` states, at least one.
    pub fn new(width: usize) -> Self {
        Self(BeamSearch::new(width))
    }
}

impl Planner for Ahead {
    fn plan(&mut self, problem: &PlanningProblem<'_>) -> Plan {
        let n_moves = problem.n_moves;
        self.0
            .set_discount(DISCOUNT.powf(1.0 / n_moves.max(1) as f32));
        let all = self.0.plan(&PlanningProblem {
            n_moves: N_PATHS * n_moves,
            ..*problem
        });
        let mut moves = all.moves;
        moves.truncate(n_moves);
        let score = problem.values.score(problem.start, &moves);
        Plan { moves, score }
    }
}
