//! A world's latest frames, from which an agent that takes over can compute its belief.

use super::outcome::{RobotOutcome, WorldOutcome};
use super::robot::Robot;
use emberwatch_model::{Cell, Coverage};
use std::collections::VecDeque;

/// Minimum capacity of a world's history, in bytes. It leaves space for frames with full coverage, which are larger.
pub const MIN_HISTORY_BYTES: usize = 1 << 20;

/// The frames of consecutive steps up to the current one, bounded in steps and in bytes.
#[derive(Debug, Clone)]
pub struct History {
    n_steps: usize,
    max_bytes: usize,
    n_bytes: usize,
    steps: VecDeque<PastStep>,
}

/// Returns the size in bytes of a history of `n_steps` steps. In each step, each of `n_robots` robots observes up to
/// `most_seen` cells.
pub fn bytes_of_history(n_steps: usize, n_robots: usize, most_seen: usize) -> usize {
    let of_robot = size_of::<PastRobot>() + 5 * most_seen;
    let of_step = size_of::<PastStep>() + n_robots * of_robot;
    n_steps.saturating_mul(of_step)
}

#[derive(Debug, Clone, Default, PartialEq)]
pub struct PastStep {
    pub outcome: WorldOutcome,
    pub robots: Vec<PastRobot>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct PastRobot {
    pub outcome: RobotOutcome,
    /// Row-major indices of the observed cells. Empty if all cells were observed.
    pub cells: Vec<u32>,
    /// The observations in these cells, or in all cells in row-major order.
    pub values: Vec<u8>,
}

impl History {
    /// Keeps at least one step.
    pub fn new(n_steps: usize, n_robots: usize, most_seen: usize) -> Self {
        let n_steps = n_steps.max(1);
        Self {
            n_steps,
            max_bytes: MIN_HISTORY_BYTES.max(bytes_of_history(n_steps, n_robots, most_seen)),
            n_bytes: 0,
            steps: VecDeque::new(),
        }
    }

    pub fn push(&mut self, outcome: &WorldOutcome, robots: &[Robot]) {
        let mut past = self.evict_if_full().unwrap_or_default();
        past.outcome = *outcome;
        past.robots.resize_with(robots.len(), PastRobot::blank);
        for (past, robot) in past.robots.iter_mut().zip(robots) {
            past.set(robot);
        }
        self.keep(past);
    }

    pub fn keep(&mut self, past: PastStep) {
        self.n_bytes += past.n_bytes();
        self.steps.push_back(past);
        while self.steps.len() > 1
            && (self.steps.len() > self.n_steps || self.n_bytes > self.max_bytes)
        {
            self.forget();
        }
    }

    /// If the history has its maximum number of steps, removes and returns the oldest step, whose buffers the caller
    /// reuses.
    fn evict_if_full(&mut self) -> Option<PastStep> {
        (self.steps.len() >= self.n_steps).then(|| self.forget())?
    }

    fn forget(&mut self) -> Option<PastStep> {
        let past = self.steps.pop_front()?;
        self.n_bytes -= past.n_bytes();
        Some(past)
    }

    pub fn n_bytes(&self) -> usize {
        self.n_bytes
    }

    pub fn all(&self) -> impl ExactSizeIterator<Item = &PastStep> {
        self.steps.iter()
    }

    pub fn step(&self, step: u64) -> Option<&PastStep> {
        let oldest = self.steps.front()?.outcome.step;
        self.steps
            .get(usize::try_from(step.checked_sub(oldest)?).ok()?)
    }
}

impl PastStep {
    fn n_bytes(&self) -> usize {
        let robots = self.robots.iter().map(PastRobot::n_bytes);
        size_of::<Self>() + robots.sum::<usize>()
    }
}

impl PastRobot {
    fn blank() -> Self {
        Self {
            outcome: RobotOutcome::at(Cell { row: 0, col: 0 }),
            cells: Vec::new(),
            values: Vec::new(),
        }
    }

    fn n_bytes(&self) -> usize {
        size_of::<Self>() + 4 * self.cells.len() + self.values.len()
    }

    fn set(&mut self, robot: &Robot) {
        let bytes = robot.frame.as_bytes();
        self.outcome = robot.outcome;
        self.cells.clear();
        self.values.clear();
        if robot.outcome.coverage == Coverage::Full {
            self.values.extend_from_slice(bytes);
            return;
        }
        let seen = robot.seen.iter();
        self.cells.extend(seen.clone().map(|&cell| cell as u32));
        self.values.extend(seen.map(|&cell| bytes[cell]));
    }

    /// Writes the observations into `frame`, one byte per cell. Cells that this robot did not observe keep their value.
    pub fn write_over(&self, frame: &mut [u8]) {
        if self.cells.is_empty() && !self.values.is_empty() {
            frame.copy_from_slice(&self.values);
            return;
        }
        for (&cell, &value) in self.cells.iter().zip(&self.values) {
            frame[cell as usize] = value;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::rules::Rules;
    use crate::world::{Episode, Flown};
    use emberwatch_model::frame::{Frame, UNOBSERVED};
    use emberwatch_model::settings::Start;
    use emberwatch_model::{Model, Move, Shape};

    #[test]
    fn the_last_frames_are_kept_unchanged() {
        let shape = Shape::new(4, 6).expect("test shape");
        let rules = Rules::new(&Model::wildfire(), shape, 100, 0, Start::Corner);
        let mut rules = rules.expect("valid model");
        (rules.history, rules.n_moves, rules.n_robots) = (3, 2, 3);
        let mut episode = Episode::new(&rules, 3);
        let mut frames = Vec::new();
        for step in 1..=5 {
            let flown = Flown {
                moves: &[Move::Down; 6],
                ready: 0b101,
                full: u64::from(step == 4),
                hovered: 0b010,
                late: 0,
            };
            episode.step(&rules, &flown);
            let robots = episode.robots().iter();
            frames.push(robots.map(|it| it.frame().clone()).collect::<Vec<Frame>>());
        }
        assert_eq!(episode.history().len(), 3);
        assert_eq!(episode.recall(2).err(), Some(3));
        assert_eq!(episode.recall(6).err(), Some(5));
        for step in 3..=5 {
            let past = episode.recall(step).expect("kept");
            assert_eq!(past.outcome.step, step);
            for (past, frame) in past.robots.iter().zip(&frames[step as usize - 1]) {
                let mut bytes = [UNOBSERVED; 24];
                past.write_over(&mut bytes);
                assert_eq!(bytes, frame.as_bytes());
            }
        }
        assert!(frames[4][1].observed().next().is_none(), "one hovers");
    }

    #[test]
    fn at_least_the_current_step_is_kept_and_no_more_than_the_capacity() {
        let present = (History::new(0, 1, 6), 6);
        for (mut history, n_values) in [present, (History::new(256, 1, 64), 1 << 19)] {
            for _ in 0..5 {
                let values = vec![0; n_values];
                let robot = PastRobot {
                    values,
                    ..PastRobot::blank()
                };
                history.keep(PastStep {
                    outcome: WorldOutcome::default(),
                    robots: vec![robot],
                });
            }
            assert_eq!(history.all().len(), 1);
            assert_eq!(history.n_bytes() >> 19, n_values >> 19);
        }
    }
}
