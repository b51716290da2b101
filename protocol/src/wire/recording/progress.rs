//! How far a recording has come, and which record may follow.

use super::format::{Event, Record, Totals};
use crate::model::grid::Shape;
use crate::model::path::MAX_MOVES;
use crate::wire::control::ServerInfo;
use crate::wire::message::VERSION;
use crate::wire::observer::Sample;
use std::collections::HashMap;

/// What the records so far hold. Writer and reader both keep it, so that neither accepts a record that the other
/// would refuse.
#[derive(Debug, Default)]
pub(super) struct Progress {
    pub(super) nanos: u64,
    server: Option<Limits>,
    pub(super) totals: Totals,
    /// Episode and step of each world's last frame: a frame may be published again.
    last: HashMap<u32, (u64, u64)>,
    /// World steps.
    pub(super) n_steps: u64,
}

/// What the samples of a server must fit.
#[derive(Debug, Clone)]
struct Limits {
    n_worlds: u32,
    height: usize,
    width: usize,
    n_moves: usize,
}

impl Progress {
    /// Counts a record.
    ///
    /// # Errors
    /// If it cannot follow the records before it; the error says what was expected.
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
                let grid = (header.height, header.width);
                let limits = limits(self.server.as_ref())?;
                let path = header.n_moves as usize;
                if path != 0 && path != limits.n_moves {
                    let expected = limits.n_moves;
                    return Err(format!("path: expected 0 or {expected} moves, got {path}"));
                }
                limits.check(header.version, header.world, grid, payload.len(), path)?;
                totals.n_frames += 1;
                totals.n_lost_frames += n_lost;
                let now = (header.result.episode, header.result.step);
                let is_new = self.last.insert(header.world, now) != Some(now);
                self.n_steps += u64::from(is_new && path > 0);
            }
            Event::Truth(Sample { header, payload }) => {
                let grid = (header.height, header.width);
                let limits = limits(self.server.as_ref())?;
                limits.check(header.version, header.world, grid, payload.len(), 0)?;
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
        Shape::new(info.height, info.width).map_err(|error| error.to_string())?;
        if info.n_moves > MAX_MOVES {
            let got = info.n_moves;
            return Err(format!(
                "moves in a path: expected at most {MAX_MOVES}, got {got}"
            ));
        }
        Ok(Self {
            n_worlds: info.n_worlds,
            height: info.height,
            width: info.width,
            n_moves: info.n_moves,
        })
    }

    fn check(
        &self,
        version: u32,
        world: u32,
        (height, width): (u32, u32),
        length: usize,
        path: usize,
    ) -> Result<(), String> {
        let expect = |what: &str, expected: String, got: String| {
            if expected == got {
                Ok(())
            } else {
                Err(format!("{what}: expected {expected}, got {got}"))
            }
        };
        expect("sample version", VERSION.to_string(), version.to_string())?;
        expect(
            "grid",
            format!("{} x {}", self.height, self.width),
            format!("{height} x {width}"),
        )?;
        expect(
            "payload bytes",
            (self.height * self.width + path).to_string(),
            length.to_string(),
        )?;
        if world >= self.n_worlds {
            return Err(format!(
                "world: expected one below {}, got {world}",
                self.n_worlds
            ));
        }
        Ok(())
    }
}
