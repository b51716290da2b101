//! The state of a recording while it is written or read, and the checks of the next record.

use super::format::{Event, Record, Totals};
use crate::capacity::{MAX_ROBOTS, MAX_TEAM_CELLS};
use crate::control::ServerInfo;
use crate::payload::{RobotSample, split_frame_payload};
use crate::sample::Sample;
use emberwatch_model::path::MAX_MOVES;
use std::collections::HashMap;
use std::fmt::Display;

/// The state after the records so far. The writer and the reader both track it, so that neither accepts a record that
/// the other would reject.
#[derive(Debug, Default)]
pub(super) struct Progress {
    pub(super) version: u32,
    pub(super) nanos: u64,
    server: Option<Limits>,
    pub(super) totals: Totals,
    /// Episode and step of each world's last frame. A frame may be published more than once.
    last: HashMap<u32, (u64, u64)>,
    pub(super) n_steps: u64,
}

#[derive(Debug, Clone)]
struct Limits {
    n_worlds: u32,
    n_robots: u32,
    height: usize,
    width: usize,
    n_moves: usize,
}

impl Progress {
    pub(super) fn new(version: u32) -> Self {
        Self {
            version,
            ..Self::default()
        }
    }

    pub(super) fn accept(&mut self, record: &Record) -> Result<(), String> {
        if record.nanos < self.nanos {
            let (expected, got) = (self.nanos, record.nanos);
            return Err(format!("time: expected at least {expected} ns, got {got}"));
        }
        let (totals, n_lost) = (&mut self.totals, u64::from(record.n_lost));
        match &record.event {
            Event::Server(info) => {
                self.server = Some(Limits::of(info)?);
                self.last.clear();
                totals.n_servers += 1;
            }
            Event::Frame(Sample { header, payload }) => {
                let limits = limits(self.server.as_ref())?;
                expect("sample version", &self.version, &header.version)?;
                limits.check(header.world, (header.height, header.width))?;
                let robots = split_frame_payload(header, payload)?;
                limits.check_robots(header.world, header.first_robot, &robots)?;
                totals.n_frames += 1;
                totals.n_lost_frames += n_lost;
                let now = (header.result.episode, header.result.step);
                let is_new = self.last.insert(header.world, now) != Some(now);
                self.n_steps += u64::from(is_new && header.result.step > 0);
            }
            Event::Truth(Sample { header, payload }) => {
                let grid = (header.height, header.width);
                let limits = limits(self.server.as_ref())?;
                expect("sample version", &self.version, &header.version)?;
                limits.check(header.world, grid)?;
                let n_cells = limits.height * limits.width;
                expect("payload bytes", &n_cells, &payload.len())?;
                totals.n_truths += 1;
                totals.n_lost_truths += n_lost;
            }
        }
        self.nanos = record.nanos;
        Ok(())
    }
}

fn limits(server: Option<&Limits>) -> Result<&Limits, String> {
    server.ok_or_else(|| "expected a server before its samples, got a sample".into())
}

impl Limits {
    fn of(info: &ServerInfo) -> Result<Self, String> {
        let shape = info.shape().map_err(|error| error.to_string())?;
        let n_robots = info.n_robots as usize;
        if !(1..=MAX_ROBOTS).contains(&n_robots) || n_robots * shape.n_cells() > MAX_TEAM_CELLS {
            return Err(format!(
                "robots: expected 1 to {MAX_ROBOTS}, with at most {MAX_TEAM_CELLS} cells in all their frames, \
                 got {n_robots}"
            ));
        }
        if info.n_moves > MAX_MOVES {
            let got = info.n_moves;
            return Err(format!(
                "moves in a path: expected at most {MAX_MOVES}, got {got}"
            ));
        }
        Ok(Self {
            n_worlds: info.n_worlds,
            n_robots: info.n_robots,
            height: info.height,
            width: info.width,
            n_moves: info.n_moves,
        })
    }

    fn check(&self, world: u32, (height, width): (u32, u32)) -> Result<(), String> {
        expect(
            "grid",
            &format!("{} x {}", self.height, self.width),
            &format!("{height} x {width}"),
        )?;
        if world >= self.n_worlds {
            return Err(format!(
                "world: expected a number below {}, got {world}",
                self.n_worlds
            ));
        }
        Ok(())
    }

    /// Checks that the robots belong to the world, and that each flew a complete path or none.
    fn check_robots(
        &self,
        world: u32,
        first_robot: u32,
        robots: &[RobotSample<'_>],
    ) -> Result<(), String> {
        expect("robots", &self.n_robots, &(robots.len() as u32))?;
        let first = u64::from(world) * u64::from(self.n_robots);
        expect("first robot", &first, &u64::from(first_robot))?;
        let wrong = |robot: &&RobotSample<'_>| ![0, self.n_moves].contains(&robot.path.len());
        match robots.iter().find(wrong) {
            None => Ok(()),
            Some(robot) => Err(format!(
                "path: expected 0 or {} moves, got {}",
                self.n_moves,
                robot.path.len()
            )),
        }
    }
}

fn expect<T: PartialEq + Display>(what: &str, expected: &T, got: &T) -> Result<(), String> {
    if expected == got {
        return Ok(());
    }
    Err(format!("{what}: expected {expected}, got {got}"))
}
