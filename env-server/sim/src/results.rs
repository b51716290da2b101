//! Conversions between outcomes of steps and the results in messages. Snapshots store the same results.

use crate::world::{InvalidWorld, RobotOutcome, WorldOutcome};
use emberwatch_messages::message::{RobotResult, WorldResult};
use emberwatch_model::{Cell, Coverage};

pub fn world_result(outcome: &WorldOutcome) -> WorldResult {
    WorldResult {
        step: outcome.step,
        seed: outcome.seed,
        episode: outcome.episode,
        reward: outcome.reward,
        hovered: outcome.hovered,
        late: outcome.late,
        n_target_cells: outcome.n_target_cells,
        n_visited: outcome.n_visited,
        n_hits: outcome.n_hits,
        terminated: outcome.is_terminated.into(),
        truncated: outcome.is_truncated.into(),
    }
}

pub fn robot_result(outcome: &RobotOutcome) -> RobotResult {
    let (start, cell) = (outcome.start, outcome.cell);
    RobotResult {
        reward: outcome.reward,
        marginal: outcome.marginal,
        n_visited: outcome.n_visited,
        n_hits: outcome.n_hits,
        start_row: start.row as u32,
        start_col: start.col as u32,
        row: cell.row as u32,
        col: cell.col as u32,
        coverage: outcome.coverage as u32,
        n_moves: outcome.n_moves,
    }
}

pub fn world_outcome(result: &WorldResult) -> Result<WorldOutcome, InvalidWorld> {
    let flag = |flag: u16| match flag {
        0 | 1 => Ok(flag == 1),
        got => Err(InvalidWorld(format!(
            "terminated, truncated: expected 0 or 1, got {got}"
        ))),
    };
    Ok(WorldOutcome {
        step: result.step,
        seed: result.seed,
        episode: result.episode,
        reward: result.reward,
        hovered: result.hovered,
        late: result.late,
        n_target_cells: result.n_target_cells,
        n_visited: result.n_visited,
        n_hits: result.n_hits,
        is_terminated: flag(result.terminated)?,
        is_truncated: flag(result.truncated)?,
    })
}

pub fn robot_outcome(result: &RobotResult) -> Result<RobotOutcome, InvalidWorld> {
    let got = result.coverage;
    let coverage = Coverage::try_from(got)
        .map_err(|_| InvalidWorld(format!("coverage: expected 0, 1 or 2, got {got}")))?;
    let cell = |row: u32, col: u32| Cell {
        row: row as usize,
        col: col as usize,
    };
    Ok(RobotOutcome {
        reward: result.reward,
        marginal: result.marginal,
        n_visited: result.n_visited,
        n_hits: result.n_hits,
        start: cell(result.start_row, result.start_col),
        cell: cell(result.row, result.col),
        coverage,
        n_moves: result.n_moves,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_with_invalid_values_are_refused() {
        let (mut robot, mut world) = (RobotResult::default(), WorldResult::default());
        (robot.coverage, robot.start_col) = (2, 4);
        let outcome = robot_outcome(&robot).expect("full coverage");
        assert_eq!(robot_result(&outcome), robot);
        robot.coverage = 3;
        let error = robot_outcome(&robot).expect_err("no coverage").to_string();
        assert_eq!(error, "coverage: expected 0, 1 or 2, got 3");
        (world.truncated, world.seed) = (1, 7);
        let outcome = world_outcome(&world).expect("an end");
        assert_eq!(world_result(&outcome), world);
        world.terminated = 2;
        let error = world_outcome(&world).expect_err("no flag").to_string();
        assert_eq!(error, "terminated, truncated: expected 0 or 1, got 2");
    }
}
