//! A joint plan for several robots. A cell that one robot visits is worth nothing to its teammates.
//!
//! The robots plan one after the other, each on the values that remain after the paths before it. Then each robot
//! plans again, given all other paths (best response), and keeps the better of its two paths. The team's value
//! therefore never decreases.

use crate::planning::objective::CellValues;
use crate::planning::planner::{Plan, Planner, PlanningProblem};
use emberwatch_model::Cell;
use emberwatch_model::randomness::split_mix;

/// Default number of best-response rounds.
pub const ROUNDS: usize = 2;

/// Plans a path for each robot. The score of each plan counts only cells that no teammate's path visited when the plan
/// was made.
///
/// `seed` and `step` select the planner's random numbers. Each round omits the robot that planned last, because it
/// already knew all other paths. A single robot therefore plans only once, whatever `rounds` is.
pub fn plan_team(
    planner: &mut dyn Planner,
    values: &CellValues,
    starts: &[Cell],
    n_moves: usize,
    (seed, step): (u64, u64),
    rounds: usize,
) -> Vec<Plan> {
    let n_robots = starts.len();
    let mut plans: Vec<Plan> = Vec::with_capacity(n_robots);
    let mut visited: Vec<Vec<usize>> = Vec::with_capacity(n_robots);
    let mut n_unchanged = 0;
    for turn in 0..n_robots + rounds * n_robots.saturating_sub(1) {
        // Stop when no robot can improve its path.
        if turn >= n_robots && n_unchanged + 1 >= n_robots {
            break;
        }
        let robot = turn % n_robots;
        let others = visited.iter().enumerate().filter(|it| it.0 != robot);
        let others: Vec<usize> = others.flat_map(|it| it.1.iter().copied()).collect();
        let free = values.without(&others);
        let plan = planner.plan(&PlanningProblem {
            start: starts[robot],
            n_moves,
            values: &free,
            seed: robot_seed(seed, robot),
            step,
        });
        let score = |plan: &Plan| free.score(starts[robot], &plan.moves);
        if turn >= n_robots && score(&plan) <= score(&plans[robot]) {
            n_unchanged += 1;
            continue;
        }
        n_unchanged = 0;
        let cells = values.airspace().fly(starts[robot], &plan.moves).visited;
        if turn < n_robots {
            plans.push(plan);
            visited.push(cells);
        } else {
            (plans[robot], visited[robot]) = (plan, cells);
        }
    }
    plans
}

/// Returns the seed of a robot's random numbers. The first robot uses the world's seed.
pub fn robot_seed(seed: u64, robot: usize) -> u64 {
    match robot {
        0 => seed,
        _ => split_mix(seed, robot as u64),
    }
}
