//! The rewards of a step. Visited cells yield rewards, and a cell that several robots visit counts once.

use super::outcome::WorldOutcome;
use super::robot::Robot;
use super::rules::Rules;

/// Flag in a cell's count. It is set when the cell's reward has been added to the team's total.
const PAID: u8 = 0x80;

/// Computes the rewards of a step from `states`, X_{k+1}: each robot's share and marginal reward, and the team's total.
/// All `counts` must be 0, and they are 0 again on return.
pub(super) fn pay(
    rules: &Rules,
    states: &[u8],
    robots: &mut [Robot],
    counts: &mut [u8],
    team: &mut WorldOutcome,
) {
    (team.reward, team.n_visited, team.n_hits) = (0.0, 0, 0);
    for robot in &*robots {
        robot.visited.iter().for_each(|&cell| counts[cell] += 1);
    }
    for Robot {
        visited, outcome, ..
    } in &mut *robots
    {
        for &cell in &*visited {
            let reward = rules.reward[usize::from(states[cell])];
            let is_hit = u32::from(states[cell] == rules.target_state);
            let n_visitors = counts[cell] & !PAID;
            outcome.n_hits += is_hit;
            outcome.reward += reward / f64::from(n_visitors);
            if n_visitors == 1 {
                outcome.marginal += reward;
            }
            if counts[cell] & PAID == 0 {
                counts[cell] |= PAID;
                team.reward += reward;
                team.n_visited += 1;
                team.n_hits += is_hit;
            }
        }
    }
    for robot in &*robots {
        robot.visited.iter().for_each(|&cell| counts[cell] = 0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::robot::Scratch;
    use emberwatch_model::randomness::split_mix;
    use emberwatch_model::settings::Start;
    use emberwatch_model::{Coverage, Model, Move, Shape};
    use std::collections::BTreeSet;

    #[test]
    fn shares_and_marginal_rewards_match_sums_over_sets_of_cells() {
        let shape = Shape::new(4, 5).expect("shape");
        let rules = Rules::new(&Model::wildfire(), shape, 0, 0, Start::Random);
        let mut rules = rules.expect("valid model");
        rules.reward = vec![-0.5, 0.25, 1.0];
        let mut counts = vec![0; shape.n_cells()];
        for case in 0..500 {
            let draw = |index: usize| split_mix(case, index as u64) as usize;
            let states: Vec<u8> = (0..20).map(|cell| (draw(cell) % 3) as u8).collect();
            let fly = |r: usize| {
                let mut robot = Robot::at(&rules.airspace, shape.cell(draw(100 + r) % 20));
                let n_moves = draw(200 + r) % 8; // 0: the robot stays.
                let moves =
                    (0..n_moves).map(|t| Move::from_low_bits(draw(300 + 10 * r + t) as u64 >> 9));
                let moves: Vec<Move> = moves.collect();
                robot.follow(
                    &rules.airspace,
                    &moves,
                    Coverage::Path,
                    &mut Scratch::default(),
                );
                robot
            };
            let mut robots: Vec<Robot> = (0..1 + case as usize % 6).map(fly).collect();
            let mut team = WorldOutcome::default();
            pay(&rules, &states, &mut robots, &mut counts, &mut team);
            assert!(counts.iter().all(|&count| count == 0));

            // The number of distinct cells of all robots but one, and their total reward.
            let of_cell = |cell: &usize| rules.reward[usize::from(states[*cell])];
            let without = |one: usize| {
                let others = robots.iter().enumerate().filter(|(robot, _)| *robot != one);
                let cells: BTreeSet<usize> = others
                    .flat_map(|(_, robot)| robot.visited.clone())
                    .collect();
                (cells.len(), cells.iter().map(of_cell).sum::<f64>())
            };
            let (n_visited, expected) = without(usize::MAX);
            let shares: f64 = robots.iter().map(|robot| robot.outcome.reward).sum();
            assert_eq!(team.n_visited as usize, n_visited);
            assert!((team.reward - expected).abs() < 1e-12);
            assert!((shares - expected).abs() < 1e-12);
            for (r, robot) in robots.iter().enumerate() {
                let marginal = expected - without(r).1;
                assert!((robot.outcome.marginal - marginal).abs() < 1e-12);
                let visitors = |cell| robots.iter().filter(|o| o.visited.contains(cell)).count();
                let share_of_cell = |cell| of_cell(cell) / visitors(cell) as f64;
                let share: f64 = robot.visited.iter().map(share_of_cell).sum();
                assert!((robot.outcome.reward - share).abs() < 1e-12);
            }
        }
    }
}
