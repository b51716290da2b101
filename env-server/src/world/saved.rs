//! A world out of a file, and the checks that an episode relies on.

use super::history::PastStep;
use super::rules::Rules;
use protocol::message::StepResult;
use protocol::{Cell, Coverage};
use thiserror::Error;

/// Largest k and number of an episode: no sum can overflow.
const MAX_COUNT: u64 = 1 << 62;

/// One world: everything that decides its future, and its present frame.
#[derive(Debug, Clone, PartialEq)]
pub struct SavedWorld {
    /// The last result: seed, episode, k, robot.
    pub result: StepResult,
    /// Hidden states, row-major.
    pub states: Vec<u8>,
    /// Hidden states at k = 0.
    pub first_states: Vec<u8>,
    pub frame: Vec<u8>,
    pub path: Vec<u8>,
    /// The robot's cell before the last path.
    pub path_start: Cell,
    /// The last steps, the oldest first.
    pub history: Vec<PastStep>,
}

/// Why a saved world cannot continue: what was expected, and what is there.
#[derive(Debug, Error, PartialEq, Eq)]
#[error("{0}")]
pub struct InvalidWorld(pub String);

impl SavedWorld {
    /// Checks everything that an episode relies on.
    ///
    /// # Errors
    /// If something cannot be part of an episode under these rules; the error names the first such thing.
    pub fn check(&self, rules: &Rules) -> Result<(), InvalidWorld> {
        let n_cells = rules.shape.n_cells();
        let expect = |what: &str, holds: bool, expected: String, got: String| {
            let text = || InvalidWorld(format!("{what}: expected {expected}, got {got}"));
            if holds { Ok(()) } else { Err(text()) }
        };
        for (what, states) in [
            ("states", &self.states),
            ("first states", &self.first_states),
        ] {
            let got = states.len();
            expect(what, got == n_cells, n_cells.to_string(), got.to_string())?;
            let most = states.iter().copied().max().unwrap_or(0);
            let n_states = rules.n_states;
            let fine = usize::from(most) < n_states;
            expect(
                what,
                fine,
                format!("states below {n_states}"),
                most.to_string(),
            )?;
        }
        let robot = Cell {
            row: self.result.row as usize,
            col: self.result.col as usize,
        };
        for (what, cell) in [("robot", robot), ("start of the path", self.path_start)] {
            let fine = rules.shape.contains(cell);
            expect(
                what,
                fine,
                format!("a cell of {}", rules.shape),
                cell.to_string(),
            )?;
        }
        let StepResult { step, episode, .. } = self.result;
        for (what, got) in [("step", step), ("episode", episode)] {
            let expected = format!("at most {MAX_COUNT}");
            expect(what, got <= MAX_COUNT, expected, got.to_string())?;
        }
        let coverage = self.result.coverage;
        let fine = Coverage::try_from(coverage).is_ok();
        expect("coverage", fine, "0, 1 or 2".into(), coverage.to_string())?;
        let (n_moves, got) = (rules.n_moves, self.path.len());
        let fine = got == 0 || got == n_moves;
        expect(
            "path",
            fine,
            format!("0 or {n_moves} moves"),
            got.to_string(),
        )?;
        let reward = self.result.reward;
        expect(
            "reward",
            reward.is_finite(),
            "a number".into(),
            reward.to_string(),
        )?;
        let ends = [self.result.terminated, self.result.truncated];
        let expected = [0, u16::from(rules.max_steps > 0 && step >= rules.max_steps)];
        expect(
            "ends",
            ends == expected,
            format!("{expected:?}"),
            format!("{ends:?}"),
        )?;
        self.check_history(rules)
    }

    /// Checks that the history ends with the last result and has no gap.
    fn check_history(&self, rules: &Rules) -> Result<(), InvalidWorld> {
        let last = self.result.step;
        let n_kept = self.history.len() as u64;
        if n_kept == 0 || n_kept > last + 1 {
            let text = format!("history: expected 1 to {} steps, got {n_kept}", last + 1);
            return Err(InvalidWorld(text));
        }
        for (past, step) in self.history.iter().zip(last + 1 - n_kept..) {
            let expected = [self.result.seed, self.result.episode, step];
            let got = [past.result.seed, past.result.episode, past.result.step];
            if got != expected {
                let text =
                    format!("history: expected seed, episode and step {expected:?}, got {got:?}");
                return Err(InvalidWorld(text));
            }
            past.check(rules)?;
        }
        Ok(())
    }
}

impl PastStep {
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
