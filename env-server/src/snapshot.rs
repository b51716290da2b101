//! Worlds as bytes: everything that decides their future, in a versioned file with a checksum.
//!
//! A file is [`MAGIC`], the version, the CRC-32 of the rest, its length, and the rest: [`Settings`] and
//! worlds as bincode writes them. All of it is in the byte order of the host; a file of the other order
//! is one of an unknown version.

pub mod folder;

use crate::config::Checked;
use crate::episode::{Episode, Rules};
use crate::history::Seen;
use bincode::config::{Configuration, Fixint, Limit, LittleEndian};
use bincode::{Decode, Encode};
use protocol::message::{RESULT_BYTES, StepResult};
use protocol::{Cell, Coverage};
use std::fmt::Display;
use thiserror::Error;

/// What every snapshot begins with.
pub const MAGIC: [u8; 8] = *b"EMBRSNAP";

/// The version of the file's form.
pub const VERSION: u32 = 1;

/// Magic, version, checksum and length.
const HEADER_BYTES: usize = 8 + 4 + 4 + 8;

/// Largest file that is read: 4 GiB, more than a thousand worlds of 512 x 512 cells need.
pub const MAX_BYTES: u64 = 1 << 32;

/// Largest k in a file: no absolute step can overflow.
const MAX_STEP: u64 = 1 << 62;

/// bincode's way of writing: integers of fixed size, and no more memory than the file is long.
const FORM: Configuration<LittleEndian, Fixint, Limit<{ MAX_BYTES as usize }>> =
    bincode::config::standard()
        .with_fixed_int_encoding()
        .with_limit::<{ MAX_BYTES as usize }>();

/// The settings of a server that its worlds depend on.
#[derive(Debug, Clone, PartialEq, Eq, Encode, Decode)]
pub struct Settings {
    /// The model file as TOML.
    pub model: String,
    /// Every other setting by name.
    pub others: Vec<(String, String)>,
}

/// Worlds of a server, and the settings that they follow.
#[derive(Debug, Clone, PartialEq)]
pub struct Snapshot {
    /// The settings.
    pub settings: Settings,
    /// The worlds.
    pub worlds: Vec<WorldSnapshot>,
}

/// One world: all that decides its future, and what it shows now.
#[derive(Debug, Clone, PartialEq)]
pub struct WorldSnapshot {
    /// The last result: seed, episode, k, robot.
    pub result: StepResult,
    /// Hidden states, row-major.
    pub states: Vec<u8>,
    /// Hidden states at k = 0.
    pub beginning: Vec<u8>,
    /// The last frame.
    pub frame: Vec<u8>,
    /// The last path.
    pub path: Vec<u8>,
    /// Where it began.
    pub path_start: Cell,
    /// The last frames, the oldest first.
    pub history: Vec<Seen>,
}

/// A world as it is written.
#[derive(Encode)]
pub struct Written<'a> {
    /// See [`WorldSnapshot::result`].
    pub result: &'a [u8],
    /// See [`WorldSnapshot::states`].
    pub states: &'a [u8],
    /// See [`WorldSnapshot::beginning`].
    pub beginning: &'a [u8],
    /// See [`WorldSnapshot::frame`].
    pub frame: &'a [u8],
    /// See [`WorldSnapshot::path`].
    pub path: Vec<u8>,
    /// Row and column of [`WorldSnapshot::path_start`].
    pub path_start: [u32; 2],
    /// Result, cells and values of each.
    pub history: Vec<(&'a [u8], &'a [u8], &'a [u8])>,
}

/// The same as it is read.
#[derive(Decode)]
struct Read {
    result: Vec<u8>,
    states: Vec<u8>,
    beginning: Vec<u8>,
    frame: Vec<u8>,
    path: Vec<u8>,
    path_start: [u32; 2],
    history: Vec<(Vec<u8>, Vec<u8>, Vec<u8>)>,
}

/// Why a file is no snapshot, or not one of this server's.
#[derive(Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
pub enum SnapshotError {
    /// Another kind of file.
    #[error("expected a snapshot, which begins with \"EMBRSNAP\", got another kind of file")]
    Foreign,
    /// A form of another release.
    #[error("expected a snapshot of version {VERSION}, got version {0}")]
    Version(u32),
    /// A file that is too short or too long.
    #[error("damaged: expected {expected} bytes, got {got}")]
    Length {
        /// As its header says.
        expected: u64,
        /// As it is.
        got: u64,
    },
    /// A file that has changed since it was written.
    #[error("damaged: expected the checksum {expected:08x}, got {got:08x}")]
    Checksum {
        /// As its header says.
        expected: u32,
        /// As it is.
        got: u32,
    },
    /// A file whose checksum holds and whose contents are none.
    #[error("malformed: {0}")]
    Malformed(String),
    /// A file of a server with another setting.
    #[error("{setting}: expected {expected} as this server's, got {got}")]
    OtherSetting {
        /// Which.
        setting: String,
        /// This server's.
        expected: String,
        /// The file's.
        got: String,
    },
    /// More or fewer worlds than there is room for.
    #[error("worlds: expected {expected}, got {got}")]
    Worlds {
        /// How many there can be.
        expected: String,
        /// How many there are.
        got: usize,
    },
    /// A world that cannot be.
    #[error("world {world} of the file: {misfit}")]
    World {
        /// Its position.
        world: usize,
        /// What is wrong.
        misfit: Misfit,
    },
}

/// What cannot be part of a world under some rules: what was expected, what was got.
#[derive(Debug, Error, PartialEq, Eq)]
#[error("{0}")]
pub struct Misfit(pub String);

impl Settings {
    /// Those of a server.
    pub fn of(checked: &Checked) -> Self {
        let config = &checked.config;
        let model = toml::to_string(checked.model.file());
        let text = |value: &dyn Display| value.to_string();
        let others: [(&str, String); 7] = [
            ("height", text(&checked.shape.height())),
            ("width", text(&checked.shape.width())),
            ("moves", text(&config.moves)),
            ("burn_in", text(&config.burn_in)),
            ("max_steps", text(&config.max_steps)),
            ("coverage", format!("{:?}", config.coverage).to_lowercase()),
            ("start", format!("{:?}", config.start).to_lowercase()),
        ];
        Self {
            model: model.expect("invariant: a model was read from TOML"),
            others: others.map(|(name, value)| (name.into(), value)).to_vec(),
        }
    }

    /// Checks that these, a file's, are a server's own.
    ///
    /// # Errors
    /// [`SnapshotError::OtherSetting`] names the first that is not.
    pub fn check(&self, server: &Self) -> Result<(), SnapshotError> {
        let other = |setting: &str, expected: &str, got: &str| SnapshotError::OtherSetting {
            setting: setting.into(),
            expected: expected.into(),
            got: got.into(),
        };
        if self.model != server.model {
            let pairs = server.model.lines().zip(self.model.lines());
            let line = pairs.into_iter().find(|(expected, got)| expected != got);
            let (expected, got) = line.unwrap_or(("its model", "a longer or shorter one"));
            return Err(other(
                "model",
                &format!("{expected:?}"),
                &format!("{got:?}"),
            ));
        }
        for (index, (setting, expected)) in server.others.iter().enumerate() {
            let got = self.others.get(index).filter(|(name, _)| name == setting);
            let got = got.map_or("nothing", |(_, value)| value);
            if got != expected {
                return Err(other(setting, expected, got));
            }
        }
        Ok(())
    }
}

/// Worlds as the bytes of a file.
pub fn encode<'a>(settings: &Settings, worlds: impl Iterator<Item = &'a Episode>) -> Vec<u8> {
    let worlds: Vec<Written<'_>> = worlds.map(Episode::written).collect();
    let mut bytes = vec![0; HEADER_BYTES];
    // Only a writer can fail, and memory does not.
    let _ = bincode::encode_into_std_write((settings, worlds), &mut bytes, FORM);
    let body = &bytes[HEADER_BYTES..];
    let (checksum, length) = (crc32fast::hash(body), body.len() as u64);
    bytes[..8].copy_from_slice(&MAGIC);
    bytes[8..12].copy_from_slice(&VERSION.to_ne_bytes());
    bytes[12..16].copy_from_slice(&checksum.to_ne_bytes());
    bytes[16..24].copy_from_slice(&length.to_ne_bytes());
    bytes
}

/// The worlds in the bytes of a file, whole or not at all.
///
/// # Errors
/// [`SnapshotError`]; whether the worlds can be is checked when they are restored.
pub fn decode(bytes: &[u8]) -> Result<Snapshot, SnapshotError> {
    let body = checked_body(bytes)?;
    let malformed = |error: &dyn Display| SnapshotError::Malformed(error.to_string());
    type Contents = (Settings, Vec<Read>);
    let (contents, length): (Contents, usize) =
        bincode::decode_from_slice(body, FORM).map_err(|error| malformed(&error))?;
    if length != body.len() {
        let rest = body.len() - length;
        return Err(malformed(&format!("{rest} bytes behind the last world")));
    }
    let (settings, worlds) = contents;
    let worlds = worlds.into_iter().enumerate().map(|(world, read)| {
        let snapshot = read.check();
        snapshot.map_err(|misfit| SnapshotError::World { world, misfit })
    });
    Ok(Snapshot {
        settings,
        worlds: worlds.collect::<Result<_, _>>()?,
    })
}

fn checked_body(bytes: &[u8]) -> Result<&[u8], SnapshotError> {
    if bytes.len() < HEADER_BYTES || bytes[..8] != MAGIC {
        return Err(SnapshotError::Foreign);
    }
    let (header, body) = bytes.split_at(HEADER_BYTES);
    let word = |from: usize| {
        let bytes = header[from..from + 4].try_into();
        u32::from_ne_bytes(bytes.expect("invariant: four bytes"))
    };
    if word(8) != VERSION {
        return Err(SnapshotError::Version(word(8)));
    }
    let length = header[16..24].try_into().expect("invariant: eight bytes");
    let (expected, got) = (u64::from_ne_bytes(length), body.len() as u64);
    if expected != got {
        return Err(SnapshotError::Length { expected, got });
    }
    let (expected, got) = (word(12), crc32fast::hash(body));
    if expected != got {
        return Err(SnapshotError::Checksum { expected, got });
    }
    Ok(body)
}

impl Snapshot {
    /// Episodes of some of the worlds under a server's rules.
    ///
    /// # Errors
    /// [`SnapshotError`] if it was taken under other settings or holds a world that cannot be.
    pub fn restore(
        self,
        settings: &Settings,
        rules: &Rules,
        n_moves: usize,
    ) -> Result<Vec<Box<Episode>>, SnapshotError> {
        self.settings.check(settings)?;
        let worlds = self.worlds.into_iter().enumerate();
        let restore = |(world, snapshot): (usize, WorldSnapshot)| {
            let episode = match snapshot.path.len() {
                0 => Episode::restore(rules, snapshot),
                got if got == n_moves => Episode::restore(rules, snapshot),
                got => Err(Misfit(format!(
                    "path: expected 0 or {n_moves} moves, got {got}"
                ))),
            };
            let episode = episode.map_err(|misfit| SnapshotError::World { world, misfit });
            episode.map(Box::new)
        };
        worlds.map(restore).collect()
    }
}

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
        let step = self.result.step;
        expect(
            "step",
            step <= MAX_STEP,
            format!("at most {MAX_STEP}"),
            step.to_string(),
        )?;
        let coverage = self.result.coverage;
        let fine = Coverage::try_from(coverage).is_ok();
        expect("coverage", fine, "0, 1 or 2".into(), coverage.to_string())?;
        let first = (step + 1).saturating_sub(self.history.len() as u64);
        for (index, seen) in self.history.iter().enumerate() {
            let (expected, got) = (first + index as u64, seen.result.step);
            expect(
                "history",
                got == expected,
                format!("step {expected}"),
                got.to_string(),
            )?;
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

    /// Result, cells and values, as they are written.
    pub fn written(&self) -> (&[u8], &[u8], &[u8]) {
        let cells = bytemuck::cast_slice(&self.cells);
        (bytemuck::bytes_of(&self.result), cells, &self.values)
    }
}

impl Read {
    /// What was written.
    fn check(self) -> Result<WorldSnapshot, Misfit> {
        let [row, col] = self.path_start.map(|side| side as usize);
        let history = self.history.into_iter().map(|(result, cells, values)| {
            Ok(Seen {
                result: read_result(&result)?,
                cells: read_cells(&cells)?,
                values,
            })
        });
        Ok(WorldSnapshot {
            result: read_result(&self.result)?,
            states: self.states,
            beginning: self.beginning,
            frame: self.frame,
            path: self.path,
            path_start: Cell { row, col },
            history: history.collect::<Result<_, _>>()?,
        })
    }
}

fn read_result(bytes: &[u8]) -> Result<StepResult, Misfit> {
    let result = bytemuck::try_pod_read_unaligned(bytes);
    result.map_err(|_| {
        let got = bytes.len();
        Misfit(format!("result: expected {RESULT_BYTES} bytes, got {got}"))
    })
}

fn read_cells(bytes: &[u8]) -> Result<Vec<u32>, Misfit> {
    let (cells, rest) = bytes.as_chunks::<4>();
    if rest.is_empty() {
        return Ok(cells.iter().map(|&cell| u32::from_ne_bytes(cell)).collect());
    }
    let got = bytes.len();
    Err(Misfit(format!(
        "history: expected cells of 4 bytes, got {got} bytes"
    )))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::ServerConfig;
    use protocol::Move;

    fn settings() -> (Settings, Rules) {
        let config = ServerConfig {
            height: 3,
            width: 5,
            moves: 2,
            burn_in: 300,
            ..ServerConfig::default()
        };
        let checked = config.check().expect("valid settings");
        let mut rules = Rules::new(&checked.model, checked.shape, 300, 0, checked.config.start)
            .expect("valid model");
        rules.history = 4;
        (Settings::of(&checked), rules)
    }

    fn episodes(rules: &Rules) -> Vec<Episode> {
        let mut episodes = vec![Episode::new(rules, 1), Episode::new(rules, 2)];
        for _ in 0..6 {
            episodes[1].step(rules, &[Move::Right, Move::Down], Coverage::Path);
        }
        episodes[1].step(rules, &[Move::Right, Move::Left], Coverage::Full);
        episodes
    }

    #[test]
    fn what_is_read_is_what_was_written() {
        let (settings, rules) = settings();
        let episodes = episodes(&rules);
        let bytes = encode(&settings, episodes.iter());
        let snapshot = decode(&bytes).expect("a snapshot");
        let restored = snapshot.restore(&settings, &rules, 2).expect("a fit");
        assert_eq!(restored.len(), 2);
        let again = encode(&settings, restored.iter().map(|episode| &**episode));
        assert_eq!(again, bytes);
    }

    #[test]
    fn every_cut_and_every_flipped_bit_is_noticed() {
        let (settings, rules) = settings();
        let bytes = encode(&settings, episodes(&rules).iter());
        for length in 0..bytes.len() {
            assert!(decode(&bytes[..length]).is_err(), "cut to {length}");
        }
        for bit in 0..8 * bytes.len() {
            let mut damaged = bytes.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            assert!(decode(&damaged).is_err(), "bit {bit}");
        }
        let mut longer = bytes.clone();
        longer.push(0);
        assert!(matches!(decode(&longer), Err(SnapshotError::Length { .. })));
    }

    /// A change to the world of an otherwise good file.
    fn misfit(change: impl FnOnce(&mut WorldSnapshot), words: &str) {
        let (settings, rules) = settings();
        let bytes = encode(&settings, episodes(&rules).iter());
        let mut snapshot = decode(&bytes).expect("a snapshot");
        change(&mut snapshot.worlds[1]);
        let error = snapshot.restore(&settings, &rules, 2).err();
        let error = error.expect("a misfit").to_string();
        assert!(error.starts_with("world 1 of the file"), "{error}");
        assert!(error.contains(words), "{words:?}: {error}");
    }

    #[test]
    fn a_world_that_cannot_be_is_refused() {
        misfit(
            |world| world.states[3] = 3,
            "states: expected states below 3, got 3",
        );
        misfit(
            |world| world.beginning.truncate(14),
            "first states: expected 15, got 14",
        );
        misfit(
            |world| world.frame[0] = 3,
            "expected an observation below 3 or 255",
        );
        misfit(|world| world.path = vec![4, 0], "move");
        misfit(
            |world| world.path = vec![0],
            "path: expected 0 or 2 moves, got 1",
        );
        misfit(
            |world| world.result.row = 3,
            "robot: expected a cell of 3 x 5, got (3, ",
        );
        misfit(|world| world.path_start.col = 5, "start of the path");
        misfit(
            |world| world.result.step = u64::MAX,
            "step: expected at most",
        );
        misfit(|world| world.result.coverage = 3, "coverage");
        misfit(
            |world| world.history[0].result.step = 9,
            "history: expected step 4, got 9",
        );
        misfit(
            |world| world.history[1].cells[0] = 15,
            "cells below 15, got 15",
        );
        misfit(
            |world| world.history[1].values[0] = 3,
            "observations below 3, got 3",
        );
        misfit(|world| world.history[1].values.push(0), "values");
    }

    #[test]
    fn the_first_other_setting_is_named() {
        let (ours, _) = settings();
        let mut theirs = ours.clone();
        theirs.others[3].1 = "9".into();
        let error = theirs.check(&ours).expect_err("another burn-in");
        let expected = "burn_in: expected 300 as this server's, got 9";
        assert_eq!(error.to_string(), expected);
        theirs.model = theirs.model.replace("0.1", "0.2");
        assert!(
            theirs
                .check(&ours)
                .expect_err("a model")
                .to_string()
                .starts_with("model: ")
        );
    }
}
