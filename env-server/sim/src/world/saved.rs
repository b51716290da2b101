//! Worlds read from a file, and the checks that their values are valid for an episode.

use super::history::{PastRobot, PastStep};
use super::outcome::{RobotOutcome, WorldOutcome};
use super::rules::Rules;
use emberwatch_messages::capacity::MAX_ROBOTS;
use std::fmt::Display;
use thiserror::Error;

/// Maximum step index k and maximum episode number, small enough that no sum overflows.
const MAX_COUNT: u64 = 1 << 62;

/// A saved world: everything that determines its future, and the latest outcomes and frames.
#[derive(Debug, Clone, PartialEq)]
pub struct SavedWorld {
    /// The world's outcome of the last step, which contains the seed, the episode number and k.
    pub outcome: WorldOutcome,
    /// Hidden states, row-major.
    pub states: Vec<u8>,
    /// Hidden states at k = 0, row-major.
    pub first_states: Vec<u8>,
    pub robots: Vec<SavedRobot>,
    pub history: Vec<PastStep>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct SavedRobot {
    /// The robot's outcome of the last step, which contains its position.
    pub outcome: RobotOutcome,
    pub frame: Vec<u8>,
    pub path: Vec<u8>,
}

#[derive(Debug, Error, PartialEq, Eq)]
#[error("{0}")]
pub struct InvalidWorld(pub String);

impl SavedWorld {
    pub fn check(&self, rules: &Rules) -> Result<(), InvalidWorld> {
        let n_cells = rules.shape.n_cells();
        for (what, states) in [
            ("states", &self.states),
            ("first states", &self.first_states),
        ] {
            let expected = format!("{n_cells} cells");
            expect(what, states.len() == n_cells, &expected, &states.len())?;
            let most = states.iter().copied().max().unwrap_or(0);
            let n_states = rules.n_states;
            let fine = usize::from(most) < n_states;
            expect(what, fine, &format!("states below {n_states}"), &most)?;
        }
        let WorldOutcome {
            step,
            episode,
            seed,
            ..
        } = self.outcome;
        for (what, got) in [("step", step), ("episode", episode)] {
            let expected = format!("at most {MAX_COUNT}");
            expect(what, got <= MAX_COUNT, &expected, &got)?;
        }
        let reward = self.outcome.reward;
        expect("reward", reward.is_finite(), &"a finite number", &reward)?;
        let (stayed, n_robots) = (self.outcome.hovered | self.outcome.late, rules.n_robots);
        let fine = stayed <= u64::MAX >> (MAX_ROBOTS - n_robots);
        let expected = format!("bits below {n_robots}");
        expect("robots that stayed", fine, &expected, &stayed)?;
        let ends = [self.outcome.is_terminated, self.outcome.is_truncated].map(u16::from);
        let expected = [0, u16::from(rules.truncates(seed, step))];
        let (expected, got) = (format!("{expected:?}"), format!("{ends:?}"));
        expect("terminated, truncated", expected == got, &expected, &got)?;
        let got = self.robots.len();
        expect("robots", got == n_robots, &n_robots, &got)?;
        self.robots
            .iter()
            .try_for_each(|robot| robot.check(rules))?;
        self.check_history(rules)
    }

    /// Checks that the history ends with the current step and has no gap.
    fn check_history(&self, rules: &Rules) -> Result<(), InvalidWorld> {
        let last = self.outcome.step;
        let n_kept = self.history.len() as u64;
        if n_kept == 0 || n_kept > last + 1 {
            let text = format!("history: expected 1 to {} steps, got {n_kept}", last + 1);
            return Err(InvalidWorld(text));
        }
        for (past, step) in self.history.iter().zip(last + 1 - n_kept..) {
            let expected = [self.outcome.seed, self.outcome.episode, step];
            let got = [past.outcome.seed, past.outcome.episode, past.outcome.step];
            if got != expected {
                let text =
                    format!("history: expected seed, episode and step {expected:?}, got {got:?}");
                return Err(InvalidWorld(text));
            }
            let (n_robots, got) = (rules.n_robots, past.robots.len());
            expect("history: robots", got == n_robots, &n_robots, &got)?;
            past.robots
                .iter()
                .try_for_each(|robot| robot.check(rules))?;
        }
        Ok(())
    }
}

impl SavedRobot {
    fn check(&self, rules: &Rules) -> Result<(), InvalidWorld> {
        let outcome = &self.outcome;
        for (what, cell) in [
            ("robot", outcome.cell),
            ("start of the path", outcome.start),
        ] {
            let expected = format!("a cell of {}", rules.shape);
            expect(what, rules.shape.contains(cell), &expected, &cell)?;
            let is_free = rules.airspace.is_free(cell);
            expect(what, is_free, &"a cell where robots may be", &cell)?;
        }
        let (n_moves, got) = (rules.n_moves, self.path.len());
        let expected = format!("0 or {n_moves} moves");
        expect("path", got == 0 || got == n_moves, &expected, &got)?;
        let fine = outcome.n_moves as usize == got;
        expect("moves of the path", fine, &got, &outcome.n_moves)?;
        for reward in [outcome.reward, outcome.marginal] {
            expect("reward", reward.is_finite(), &"a finite number", &reward)?;
        }
        Ok(())
    }
}

fn expect(
    what: &str,
    holds: bool,
    expected: &dyn Display,
    got: &dyn Display,
) -> Result<(), InvalidWorld> {
    if holds {
        return Ok(());
    }
    Err(InvalidWorld(format!(
        "{what}: expected {expected}, got {got}"
    )))
}

impl PastRobot {
    fn check(&self, rules: &Rules) -> Result<(), InvalidWorld> {
        let n_cells = rules.shape.n_cells();
        let is_whole = self.cells.is_empty() && self.values.len() == n_cells;
        if !is_whole && self.cells.len() != self.values.len() {
            let (expected, got) = (self.cells.len(), self.values.len());
            return Err(InvalidWorld(format!(
                "history: expected {expected} values, got {got}"
            )));
        }
        if let Some(cell) = self.cells.iter().find(|&&cell| cell as usize >= n_cells) {
            let text = format!("history: expected cells below {n_cells}, got {cell}");
            return Err(InvalidWorld(text));
        }
        let most = rules.n_observations;
        if let Some(value) = self
            .values
            .iter()
            .find(|&&value| usize::from(value) >= most)
        {
            let text = format!("history: expected observations below {most}, got {value}");
            return Err(InvalidWorld(text));
        }
        Ok(())
    }
}
