//! A world's last frames, kept so that the next agent can compute its belief from them.

use super::outcome::{RobotOutcome, WorldOutcome};
use super::robot::Robot;
use emberwatch_model::{Cell, Coverage};
use std::collections::VecDeque;

/// Minimum capacity for a world's frames, bytes: whole frames share it, however many steps are to be kept.
pub const LEAST_ROOM: usize = 1 << 20;

/// The frames of consecutive steps, the last one the world's present; bounded in steps and in bytes.
#[derive(Debug, Clone)]
pub struct History {
    n_steps: usize,
    /// Bytes that the frames may take.
    room: usize,
    n_bytes: usize,
    steps: VecDeque<PastStep>,
}

/// The memory of the frames of `n_steps` steps of `n_robots` paths each, from which so many cells are seen.
pub fn bytes_of_history(n_steps: usize, n_robots: usize, most_seen: usize) -> usize {
    let of_robot = size_of::<PastRobot>() + 5 * most_seen;
    let of_step = size_of::<PastStep>() + n_robots * of_robot;
    n_steps.saturating_mul(of_step)
}

/// What one step showed.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PastStep {
    /// What the step gave the world.
    pub outcome: WorldOutcome,
    /// What its robots saw.
    pub robots: Vec<PastRobot>,
}

/// What one robot saw in a step.
#[derive(Debug, Clone, PartialEq)]
pub struct PastRobot {
    /// What the step gave the robot.
    pub outcome: RobotOutcome,
    /// The observed cells, row-major indices; empty where every cell was observed.
    pub cells: Vec<u32>,
    /// What was observed there.
    pub values: Vec<u8>,
}

impl History {
    /// Room for the frames of `n_steps` steps of `n_robots` paths each, from which so many cells are seen; at least for
    /// the present one.
    pub fn new(n_steps: usize, n_robots: usize, most_seen: usize) -> Self {
        let n_steps = n_steps.max(1);
        Self {
            n_steps,
            room: LEAST_ROOM.max(bytes_of_history(n_steps, n_robots, most_seen)),
            n_bytes: 0,
            steps: VecDeque::new(),
        }
    }

    /// Keeps a step; forgets the oldest if there is no room.
    pub fn push(&mut self, outcome: &WorldOutcome, robots: &[Robot]) {
        let mut past = self.make_room().unwrap_or_default();
        past.outcome = *outcome;
        past.robots.resize_with(robots.len(), PastRobot::blank);
        for (past, robot) in past.robots.iter_mut().zip(robots) {
            past.set(robot);
        }
        self.keep(past);
    }

    /// Keeps a step, and as many before it as there is room for.
    pub fn keep(&mut self, past: PastStep) {
        self.n_bytes += past.n_bytes();
        self.steps.push_back(past);
        while self.steps.len() > 1 && (self.steps.len() > self.n_steps || self.n_bytes > self.room)
        {
            self.forget();
        }
    }

    /// Removes the oldest step if another one would be too many.
    fn make_room(&mut self) -> Option<PastStep> {
        (self.steps.len() >= self.n_steps).then(|| self.forget())?
    }

    fn forget(&mut self) -> Option<PastStep> {
        let past = self.steps.pop_front()?;
        self.n_bytes -= past.n_bytes();
        Some(past)
    }

    /// Bytes of all frames.
    pub fn n_bytes(&self) -> usize {
        self.n_bytes
    }

    /// The steps that are kept, the oldest first.
    pub fn all(&self) -> impl ExactSizeIterator<Item = &PastStep> {
        self.steps.iter()
    }

    /// What step k showed, if it is kept.
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
    /// Room for what a robot saw.
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
        self.cells.extend(seen.clone().map(|it| it.cell as u32));
        self.values.extend(seen.map(|it| bytes[it.cell]));
    }

    /// Writes what was observed over `frame`, one byte per cell; leaves the other cells as they are, and those that
    /// another robot saw from a ring further in.
    pub fn write_over(&self, frame: &mut [u8]) {
        if self.cells.is_empty() && !self.values.is_empty() {
            frame.copy_from_slice(&self.values);
            return;
        }
        for (&cell, &value) in self.cells.iter().zip(&self.values) {
            let frame = &mut frame[cell as usize];
            *frame = value.min(*frame);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::rules::Rules;
    use crate::world::{Episode, Flown};
    use emberwatch_model::frame::{Frame, UNOBSERVED};
    use emberwatch_model::task::Start;
    use emberwatch_model::{Model, Move, Shape};

    #[test]
    fn the_last_frames_are_kept_as_they_were() {
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
    fn at_least_the_present_is_kept_and_no_more_than_there_is_room_for() {
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
