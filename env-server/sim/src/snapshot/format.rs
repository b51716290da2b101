//! The format of snapshots: everything that determines the worlds' future, with a version and a checksum.
//!
//! A file consists of [`MAGIC`], the version, the CRC-32 of the body, the length of the body, and the body:
//! [`Settings`] and worlds, encoded by bincode. The byte order is the host's. If a file has the other byte order, its
//! version number is unknown, so it is refused.

use super::error::SnapshotError;
use super::settings::{Settings, WorldSpec};
use crate::results::{robot_outcome, robot_result, world_outcome, world_result};
use crate::world::{Episode, InvalidWorld, PastRobot, PastStep, Robot, SavedRobot, SavedWorld};
use bincode::config::{Configuration, Fixint, LittleEndian};
use bincode::error::DecodeError;
use bincode::{Decode, Encode};
use bytemuck::{AnyBitPattern, NoUninit};
use emberwatch_messages::limits::memory::in_words;
use emberwatch_model::Grid;
use emberwatch_model::path::path_to_bytes;

pub const MAGIC: [u8; 8] = *b"EMBRSNAP";

pub const VERSION: u32 = 2;

/// Length of the header: magic, version, checksum and body length.
pub(super) const HEADER_BYTES: usize = 8 + 4 + 4 + 8;

pub const MAX_BYTES: u64 = 1 << 32;

const FORM: Configuration<LittleEndian, Fixint> =
    bincode::config::standard().with_fixed_int_encoding();

#[derive(Debug, Clone, PartialEq)]
pub struct Snapshot {
    pub settings: Settings,
    pub worlds: Vec<SnapshotWorld<Box<SavedWorld>>>,
}

/// A saved world: either its state at some step, or only the seed and number of an episode whose burn-in had not
/// finished.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum SnapshotWorld<T> {
    Ready(T),
    New(NewEpisode),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NewEpisode {
    pub seed: u64,
    pub episode: u64,
}

#[derive(Encode)]
struct EncodedWorld<'a> {
    result: Vec<u8>,
    states: &'a [u8],
    first_states: &'a [u8],
    /// Result, frame and path of each robot, in order.
    robots: Vec<(Vec<u8>, &'a [u8], Vec<u8>)>,
    history: Vec<Past<&'a [u8]>>,
}

/// A past step: the world's result, and for each robot its result, the observed cells and the observations.
type Past<B> = (Vec<u8>, Vec<(Vec<u8>, B, B)>);

#[derive(Decode)]
struct DecodedWorld {
    result: Vec<u8>,
    states: Vec<u8>,
    first_states: Vec<u8>,
    robots: Vec<(Vec<u8>, Vec<u8>, Vec<u8>)>,
    history: Vec<Past<Vec<u8>>>,
}

pub fn encode(
    settings: &Settings,
    worlds: &[SnapshotWorld<&Episode>],
) -> Result<Vec<u8>, SnapshotError> {
    let n_bytes: u64 = worlds.iter().map(SnapshotWorld::n_bytes).sum();
    check_size(n_bytes)?;
    let worlds: Vec<_> = worlds.iter().map(SnapshotWorld::encoded).collect();
    let mut bytes = Vec::new();
    let reserved = bytes.try_reserve(n_bytes as usize + HEADER_BYTES + settings.model.len());
    reserved.map_err(|_| {
        SnapshotError::Unfit(format!(
            "expected memory for {}, got less",
            in_words(n_bytes)
        ))
    })?;
    bytes.resize(HEADER_BYTES, 0);
    // Encoding can fail only if the writer fails, and writing to memory does not.
    let _ = bincode::encode_into_std_write((settings, worlds), &mut bytes, FORM);
    let body = &bytes[HEADER_BYTES..];
    let (checksum, length) = (crc32fast::hash(body), body.len() as u64);
    bytes[..8].copy_from_slice(&MAGIC);
    bytes[8..12].copy_from_slice(&VERSION.to_ne_bytes());
    bytes[12..16].copy_from_slice(&checksum.to_ne_bytes());
    bytes[16..24].copy_from_slice(&length.to_ne_bytes());
    Ok(bytes)
}

/// Checks length and checksum, and decodes the worlds. [`Snapshot::restore`] checks their values.
pub fn decode(bytes: &[u8]) -> Result<Snapshot, SnapshotError> {
    let malformed = |problem: String| SnapshotError::Unfit(format!("malformed: {problem}"));
    let body = checked_body(bytes)?;
    let ((settings, worlds), length) =
        decode_body(body).map_err(|error| malformed(error.to_string()))?;
    if length != body.len() {
        let rest = body.len() - length;
        return Err(malformed(format!("{rest} bytes after the last world")));
    }
    let decoded = |(seed, episode, world): (u64, u64, Option<DecodedWorld>)| {
        Ok(match world {
            None => SnapshotWorld::New(NewEpisode { seed, episode }),
            Some(world) => SnapshotWorld::Ready(Box::new(world.into_saved()?)),
        })
    };
    Ok(Snapshot {
        settings,
        worlds: each_world(worlds, decoded)?,
    })
}

/// Converts every world of a file. The error names the first invalid world.
fn each_world<T, U>(
    worlds: Vec<T>,
    convert: impl Fn(T) -> Result<U, InvalidWorld>,
) -> Result<Vec<U>, SnapshotError> {
    let worlds = worlds.into_iter().enumerate().map(|(index, world)| {
        let invalid = |error| SnapshotError::Unfit(format!("world {index} of the file: {error}"));
        convert(world).map_err(invalid)
    });
    worlds.collect()
}

fn check_size(n_bytes: u64) -> Result<(), SnapshotError> {
    if n_bytes <= MAX_BYTES {
        return Ok(());
    }
    Err(SnapshotError::Unfit(format!(
        "expected a snapshot of at most {MAX_BYTES} bytes, got {n_bytes}"
    )))
}

/// The body of a file: settings, and the seed and episode number of each world, followed by its state if its burn-in is
/// finished.
type Contents = (Settings, Vec<(u64, u64, Option<DecodedWorld>)>);

/// Decodes a body, and returns the contents and the number of bytes read. Limits bincode's allocations, so that a small
/// file cannot claim much memory. In bincode the limit is a const generic, so this function chooses the smallest of
/// three limits that suffices.
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
        return Err(SnapshotError::Damaged(format!(
            "damaged: expected the checksum {expected:08x}, got {got:08x}"
        )));
    }
    Ok(body)
}

pub(super) fn checked_length(header: &[u8], got: u64) -> Result<u32, SnapshotError> {
    if header.len() < HEADER_BYTES || header[..8] != MAGIC {
        let problem =
            "expected a snapshot, which begins with \"EMBRSNAP\", got another kind of file";
        return Err(SnapshotError::Damaged(problem.into()));
    }
    let word = |from: usize| {
        let bytes = header[from..from + 4].try_into();
        u32::from_ne_bytes(bytes.expect("invariant: four bytes"))
    };
    if word(8) != VERSION {
        let got = word(8);
        return Err(SnapshotError::Unfit(format!(
            "expected a snapshot of version {VERSION}, got version {got}"
        )));
    }
    let length = header[16..24].try_into().expect("invariant: eight bytes");
    let expected = u64::from_ne_bytes(length);
    if expected != got {
        return Err(SnapshotError::Damaged(format!(
            "damaged: expected {expected} bytes, got {got}"
        )));
    }
    check_size(got)?;
    Ok(word(12))
}

impl<'a> SnapshotWorld<&'a Episode> {
    fn n_bytes(&self) -> u64 {
        match self {
            Self::Ready(episode) => episode.n_bytes() as u64,
            Self::New(_) => 24,
        }
    }

    fn encoded(&self) -> (u64, u64, Option<EncodedWorld<'a>>) {
        match *self {
            Self::New(NewEpisode { seed, episode }) => (seed, episode, None),
            Self::Ready(episode) => {
                let outcome = episode.outcome();
                let world = EncodedWorld::of(episode);
                (outcome.seed, outcome.episode, Some(world))
            }
        }
    }
}

impl<'a> EncodedWorld<'a> {
    fn of(episode: &'a Episode) -> Self {
        fn bytes(states: &Grid<u8>) -> &[u8] {
            states.as_slice().expect("invariant: states are row-major")
        }
        let robot = |robot: &'a Robot| {
            (
                bytes_of(&robot_result(robot.outcome())),
                robot.frame().as_bytes(),
                path_to_bytes(robot.path()),
            )
        };
        let past_robot = |past: &'a PastRobot| {
            let cells = bytemuck::cast_slice(&past.cells);
            let result = bytes_of(&robot_result(&past.outcome));
            (result, cells, &past.values[..])
        };
        let past = |past: &'a PastStep| {
            let robots = past.robots.iter().map(past_robot);
            (bytes_of(&world_result(&past.outcome)), robots.collect())
        };
        Self {
            result: bytes_of(&world_result(episode.outcome())),
            states: bytes(episode.states()),
            first_states: bytes(episode.first_states()),
            robots: episode.robots().iter().map(robot).collect(),
            history: episode.history().map(past).collect(),
        }
    }
}

impl Snapshot {
    /// Checks the settings and all values, and converts the saved worlds to worlds that can continue on a server.
    pub fn restore(
        self,
        spec: &WorldSpec,
    ) -> Result<Vec<SnapshotWorld<Box<Episode>>>, SnapshotError> {
        self.settings.check(&spec.settings)?;
        each_world(self.worlds, |world| {
            Ok(match world {
                SnapshotWorld::New(new) => SnapshotWorld::New(new),
                SnapshotWorld::Ready(saved) => {
                    SnapshotWorld::Ready(Box::new(Episode::restore(&spec.rules, *saved)?))
                }
            })
        })
    }
}

impl DecodedWorld {
    fn into_saved(self) -> Result<SavedWorld, InvalidWorld> {
        let robots = self.robots.into_iter().map(|(result, frame, path)| {
            Ok(SavedRobot {
                outcome: robot_outcome(&read(&result)?)?,
                frame,
                path,
            })
        });
        let history = self.history.into_iter().map(|(result, robots)| {
            let robots = robots.into_iter().map(|(result, cells, values)| {
                Ok(PastRobot {
                    outcome: robot_outcome(&read(&result)?)?,
                    cells: read_cells(&cells)?,
                    values,
                })
            });
            Ok(PastStep {
                outcome: world_outcome(&read(&result)?)?,
                robots: robots.collect::<Result<_, _>>()?,
            })
        });
        Ok(SavedWorld {
            outcome: world_outcome(&read(&self.result)?)?,
            states: self.states,
            first_states: self.first_states,
            robots: robots.collect::<Result<_, _>>()?,
            history: history.collect::<Result<_, _>>()?,
        })
    }
}

fn bytes_of<T: NoUninit>(result: &T) -> Vec<u8> {
    bytemuck::bytes_of(result).to_vec()
}

fn read<T: AnyBitPattern>(bytes: &[u8]) -> Result<T, InvalidWorld> {
    let result = bytemuck::try_pod_read_unaligned(bytes);
    result.map_err(|_| {
        let (expected, got) = (size_of::<T>(), bytes.len());
        InvalidWorld(format!("result: expected {expected} bytes, got {got}"))
    })
}

fn read_cells(bytes: &[u8]) -> Result<Vec<u32>, InvalidWorld> {
    let (cells, rest) = bytes.as_chunks::<4>();
    if rest.is_empty() {
        return Ok(cells.iter().map(|&cell| u32::from_ne_bytes(cell)).collect());
    }
    let got = bytes.len();
    Err(InvalidWorld(format!(
        "history: expected cells of 4 bytes, got {got} bytes"
    )))
}
