//! Worlds as bytes: everything that decides their future, in a versioned file with a checksum.
//!
//! A file is [`MAGIC`], the version, the CRC-32 of the rest, its length, and the rest: [`Settings`] and
//! worlds as bincode writes them. All of it is in the byte order of the host; a file of the other order
//! is one of an unknown version.

mod check;
pub mod folder;

use crate::config::Checked;
use crate::episode::{Episode, Rules};
use crate::history::Seen;
use bincode::config::{Configuration, Fixint, LittleEndian};
use bincode::error::DecodeError;
use bincode::{Decode, Encode};
use protocol::Cell;
use protocol::message::{RESULT_BYTES, StepResult};
use std::fmt::Display;
use thiserror::Error;

/// What every snapshot begins with.
pub const MAGIC: [u8; 8] = *b"EMBRSNAP";

/// The version of the file's form.
pub const VERSION: u32 = 1;

/// Magic, version, checksum and length.
const HEADER_BYTES: usize = 8 + 4 + 4 + 8;

/// Largest file: 4 GiB.
pub const MAX_BYTES: u64 = 1 << 32;

/// bincode's way of writing: integers of fixed size.
const FORM: Configuration<LittleEndian, Fixint> =
    bincode::config::standard().with_fixed_int_encoding();

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
    pub worlds: Vec<StoredWorld>,
}

/// A world in a file.
#[derive(Debug, Clone, PartialEq)]
pub enum StoredWorld {
    /// At some step.
    Ready(Box<WorldSnapshot>),
    /// In the burn-in of an episode.
    Beginning(Beginning),
}

/// A world that a server may go on with.
pub enum RestoredWorld {
    /// At some step.
    Ready(Box<Episode>),
    /// Before the burn-in of an episode.
    Beginning(Beginning),
}

/// A world to write.
#[derive(Debug, Clone, Copy)]
pub enum WorldToWrite<'a> {
    /// At some step.
    Ready(&'a Episode),
    /// In the burn-in of an episode.
    Beginning(Beginning),
}

/// An episode that is yet to be simulated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Beginning {
    /// Its seed.
    pub seed: u64,
    /// Its number.
    pub episode: u64,
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
    /// More than a file may hold.
    #[error("expected a snapshot of at most {MAX_BYTES} bytes, got worlds of {0}")]
    TooLarge(u64),
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
///
/// # Errors
/// [`SnapshotError::TooLarge`].
pub fn encode(settings: &Settings, worlds: &[WorldToWrite<'_>]) -> Result<Vec<u8>, SnapshotError> {
    let n_bytes: u64 = worlds.iter().map(WorldToWrite::n_bytes).sum();
    if n_bytes > MAX_BYTES {
        return Err(SnapshotError::TooLarge(n_bytes));
    }
    let worlds: Vec<_> = worlds.iter().map(WorldToWrite::written).collect();
    let mut bytes = Vec::with_capacity(n_bytes as usize + HEADER_BYTES + settings.model.len());
    bytes.resize(HEADER_BYTES, 0);
    // Only a writer can fail, and memory does not.
    let _ = bincode::encode_into_std_write((settings, worlds), &mut bytes, FORM);
    let body = &bytes[HEADER_BYTES..];
    let (checksum, length) = (crc32fast::hash(body), body.len() as u64);
    bytes[..8].copy_from_slice(&MAGIC);
    bytes[8..12].copy_from_slice(&VERSION.to_ne_bytes());
    bytes[12..16].copy_from_slice(&checksum.to_ne_bytes());
    bytes[16..24].copy_from_slice(&length.to_ne_bytes());
    Ok(bytes)
}

/// The worlds in the bytes of a file, whole or not at all.
///
/// # Errors
/// [`SnapshotError`]; whether the worlds can be is checked when they are restored.
pub fn decode(bytes: &[u8]) -> Result<Snapshot, SnapshotError> {
    let body = checked_body(bytes)?;
    let ((settings, worlds), length) =
        decode_body(body).map_err(|error| SnapshotError::Malformed(error.to_string()))?;
    if length != body.len() {
        let rest = body.len() - length;
        let problem = format!("{rest} bytes behind the last world");
        return Err(SnapshotError::Malformed(problem));
    }
    let stored = |(seed, episode, read): (u64, u64, Option<Read>)| match read {
        None => Ok(StoredWorld::Beginning(Beginning { seed, episode })),
        Some(read) => Ok(StoredWorld::Ready(Box::new(read.check()?))),
    };
    let worlds = worlds.into_iter().enumerate();
    let worlds = worlds
        .map(|(world, read)| stored(read).map_err(|misfit| SnapshotError::World { world, misfit }));
    Ok(Snapshot {
        settings,
        worlds: worlds.collect::<Result<_, _>>()?,
    })
}

/// What a file holds.
type Contents = (Settings, Vec<(u64, u64, Option<Read>)>);

/// Reads contents, and how many bytes they took. bincode believes lengths up to a limit, and limits are
/// part of its types: the least that will do, so that a small file cannot ask for much memory.
fn decode_body(body: &[u8]) -> Result<(Contents, usize), DecodeError> {
    match body.len() {
        0..0x1_0000 => bincode::decode_from_slice(body, FORM.with_limit::<0x10_0000>()),
        0x1_0000..0x100_0000 => bincode::decode_from_slice(body, FORM.with_limit::<0x1000_0000>()),
        _ => bincode::decode_from_slice(body, FORM.with_limit::<{ 8 * MAX_BYTES as usize }>()),
    }
}

fn checked_body(bytes: &[u8]) -> Result<&[u8], SnapshotError> {
    let (header, body) = bytes.split_at(HEADER_BYTES.min(bytes.len()));
    let expected = checked_length(header, body.len() as u64)?;
    let got = crc32fast::hash(body);
    if expected != got {
        return Err(SnapshotError::Checksum { expected, got });
    }
    Ok(body)
}

/// Checks a header, and that so many bytes behind it are as many as it says; returns their checksum.
fn checked_length(header: &[u8], got: u64) -> Result<u32, SnapshotError> {
    if header.len() < HEADER_BYTES || header[..8] != MAGIC {
        return Err(SnapshotError::Foreign);
    }
    let word = |from: usize| {
        let bytes = header[from..from + 4].try_into();
        u32::from_ne_bytes(bytes.expect("invariant: four bytes"))
    };
    if word(8) != VERSION {
        return Err(SnapshotError::Version(word(8)));
    }
    let length = header[16..24].try_into().expect("invariant: eight bytes");
    let expected = u64::from_ne_bytes(length);
    if expected != got {
        return Err(SnapshotError::Length { expected, got });
    }
    if got > MAX_BYTES {
        return Err(SnapshotError::TooLarge(got));
    }
    Ok(word(12))
}

impl<'a> WorldToWrite<'a> {
    fn n_bytes(&self) -> u64 {
        match self {
            Self::Ready(episode) => episode.n_bytes() as u64,
            Self::Beginning(_) => 24,
        }
    }

    fn written(&self) -> (u64, u64, Option<Written<'a>>) {
        match *self {
            Self::Beginning(Beginning { seed, episode }) => (seed, episode, None),
            Self::Ready(episode) => {
                let result = episode.result();
                (result.seed, result.episode, Some(episode.written()))
            }
        }
    }
}

impl Snapshot {
    /// Worlds that go on under a server's rules.
    ///
    /// # Errors
    /// [`SnapshotError`] if it was taken under other settings or holds a world that cannot be.
    pub fn restore(
        self,
        settings: &Settings,
        rules: &Rules,
    ) -> Result<Vec<RestoredWorld>, SnapshotError> {
        self.settings.check(settings)?;
        let restore = |stored| {
            Ok(match stored {
                StoredWorld::Beginning(beginning) => RestoredWorld::Beginning(beginning),
                StoredWorld::Ready(world) => {
                    RestoredWorld::Ready(Box::new(Episode::restore(rules, *world)?))
                }
            })
        };
        let worlds = self.worlds.into_iter().enumerate();
        let worlds = worlds.map(|(world, stored)| {
            restore(stored).map_err(|misfit| SnapshotError::World { world, misfit })
        });
        worlds.collect()
    }
}

impl Seen {
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
mod tests;
