//! What a world of a file must be like, so that an episode may take it for granted.

use super::{Misfit, WorldSnapshot};
use crate::episode::Rules;
use crate::history::Seen;
use protocol::message::StepResult;
use protocol::{Cell, Coverage};

/// Largest k and number of an episode: no sum can overflow.
const MAX_COUNT: u64 = 1 << 62;

impl WorldSnapshot {
    /// Checks everything that an episode takes for granted.
    ///
    /// # Errors
    /// [`Misfit`] names the first thing that is wrong.
    pub fn check(&self, rules: &Rules) -> Result<(), Misfit> {
        let n_cells = rules.shape.n_cells();
        let expect = |what: &str, holds: bool, expected: String, got: String| {
            let text = || Misfit(format!("{what}: expected {expected}, got {got}"));
            if holds { Ok(()) } else { Err(text()) }
        };
        for (what, states) in [("states", &self.states), ("first states", &self.beginning)] {
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
    fn check_history(&self, rules: &Rules) -> Result<(), Misfit> {
        let last = self.result.step;
        let n_kept = self.history.len() as u64;
        if n_kept == 0 || n_kept > last + 1 {
            let text = format!("history: expected 1 to {} steps, got {n_kept}", last + 1);
            return Err(Misfit(text));
        }
        for (seen, step) in self.history.iter().zip(last + 1 - n_kept..) {
            let expected = [self.result.seed, self.result.episode, step];
            let got = [seen.result.seed, seen.result.episode, seen.result.step];
            if got != expected {
                let text =
                    format!("history: expected seed, episode and step {expected:?}, got {got:?}");
                return Err(Misfit(text));
            }
            seen.check(rules)?;
        }
        Ok(())
    }
}

impl Seen {
    fn check(&self, rules: &Rules) -> Result<(), Misfit> {
        let n_cells = rules.shape.n_cells();
        let is_whole = self.cells.is_empty() && self.values.len() == n_cells;
        if !is_whole && self.cells.len() != self.values.len() {
            let (expected, got) = (self.cells.len(), self.values.len());
            return Err(Misfit(format!(
                "history: expected {expected} values, got {got}"
            )));
        }
        if let Some(cell) = self.cells.iter().find(|&&cell| cell as usize >= n_cells) {
            let text = format!("history: expected cells below {n_cells}, got {cell}");
            return Err(Misfit(text));
        }
        let most = rules.n_observations;
        if let Some(value) = self
            .values
            .iter()
            .find(|&&value| usize::from(value) >= most)
        {
            let text = format!("history: expected observations below {most}, got {value}");
            return Err(Misfit(text));
        }
        Ok(())
    }
}
