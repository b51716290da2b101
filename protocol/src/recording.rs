//! A recording: what a server published, in a file. PROTOCOL.md section 14 has its byte tables.
//!
//! A file begins with a [`FileHeader`]; records follow, each a [`RecordHeader`] and a compressed body,
//! and the last one says how many there are. So a file tells by itself what it lacks: samples that the
//! recorder missed, records that are damaged, an end that never came.

mod reader;
mod writer;

pub use reader::{Position, Reader};
pub use writer::Writer;

use crate::control::{MAX_CONTROL_BYTES, ServerInfo};
use crate::grid::{MAX_SIDE, Shape};
use crate::message::{self, FrameHeader, TruthHeader};
use crate::observer::Sample;
use crate::path::MAX_MOVES;
use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use thiserror::Error;

/// The first bytes of every recording.
pub const MAGIC: [u8; 8] = *b"EMBERREC";

/// Version of the format. The other byte order's is another number, so such a file is refused.
pub const VERSION: u32 = 1;

/// Longest body before compression, bytes: a frame of the largest grid with the longest path.
pub const MAX_BODY_BYTES: usize = size_of::<FrameHeader>() + MAX_SIDE * MAX_SIDE + MAX_MOVES;

/// Longest body in the file, bytes: what deflate may add to one that it cannot compress.
pub const MAX_STORED_BYTES: usize = MAX_BODY_BYTES + MAX_BODY_BYTES / 1024 + 64;

/// The beginning of a file.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct FileHeader {
    /// [`MAGIC`].
    pub magic: [u8; 8],
    /// [`VERSION`].
    pub version: u32,
    /// 0.
    pub reserved: u32,
}

/// In front of each record's body.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct RecordHeader {
    /// Time since the recording began, nanoseconds; never less than in the record before.
    pub nanos: u64,
    /// A [`Kind`].
    pub kind: u32,
    /// Bytes of the body as it is stored.
    pub length: u32,
    /// Samples of the channel that the recorder missed right before this one.
    pub n_lost: u32,
    /// CRC-32 of the 20 bytes before it and the stored body.
    pub checksum: u32,
}

/// What a record is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum Kind {
    /// A server that the samples behind it are from: its [`ServerInfo`] in JSON.
    Server = 1,
    /// A sample of `frames`: header and payload.
    Frame = 2,
    /// A sample of `truth`: header and payload.
    Truth = 3,
    /// The end: [`Totals`] in JSON.
    End = 4,
}

/// A record, checked.
#[derive(Debug, Clone, PartialEq)]
pub struct Record {
    /// Time since the recording began, nanoseconds; never less than in the record before.
    pub nanos: u64,
    /// Samples of the channel that the recorder missed right before this one; 0 for a server.
    pub n_lost: u32,
    /// What happened.
    pub event: Event,
}

/// What a record tells.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// The samples from here on are from this server.
    Server(Box<ServerInfo>),
    /// A frame and the path that was flown.
    Frame(Sample<FrameHeader>),
    /// Hidden states; for evaluation and pictures, never for learners.
    Truth(Sample<TruthHeader>),
}

/// How much a recording holds, and how much of it was lost while recording.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Totals {
    /// Servers.
    pub n_servers: u64,
    /// Frames.
    pub n_frames: u64,
    /// Hidden states.
    pub n_truths: u64,
    /// Frames that the recorder missed.
    pub n_lost_frames: u64,
    /// Hidden states that the recorder missed.
    pub n_lost_truths: u64,
}

/// Why a recording could not be written, or was not read on.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// The system refused.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// Some other file.
    #[error(
        "not a recording: expected it to begin with {:?}, got {:?}",
        MAGIC.escape_ascii().to_string(),
        .0.escape_ascii().to_string()
    )]
    Foreign(Vec<u8>),
    /// A format of another release, or of a host of the other byte order.
    #[error("recording version: expected {VERSION}, got {0}")]
    Version(u32),
    /// A reserved field with a meaning that this release does not know.
    #[error("recording: expected 0 in byte 12 to 15, got {0}")]
    Reserved(u32),
    /// The file ends without an end: its recorder was killed, or bytes are missing. Everything before
    /// is whole.
    #[error(
        "the recording was cut short: expected a whole record at byte {offset}, got {got} bytes; good before it: \
         {n_steps} steps"
    )]
    Cut {
        /// Where the last whole record ends, bytes from the start of the file.
        offset: u64,
        /// Bytes behind it.
        got: u64,
        /// World steps before it.
        n_steps: u64,
    },
    /// Bytes that no recorder wrote. Everything before is whole.
    #[error(
        "the recording is damaged at byte {offset}: {problem}; good before it: {n_steps} steps"
    )]
    Damaged {
        /// Where the record begins.
        offset: u64,
        /// What was expected, and what is there.
        problem: String,
        /// World steps before it.
        n_steps: u64,
    },
    /// A record that does not belong here, so that it was not written.
    #[error("not recorded: {0}")]
    Refused(String),
}

impl RecordingError {
    /// Whether everything before is whole, so that it can be used.
    pub fn leaves_good_records(&self) -> bool {
        matches!(self, Self::Cut { .. } | Self::Damaged { .. })
    }
}

/// What has passed so far; writer and reader keep it alike, so that neither lets a record through that
/// the other would refuse.
#[derive(Debug, Clone, Default)]
struct Course {
    nanos: u64,
    server: Option<Limits>,
    totals: Totals,
    /// Episode and step of each world's last frame: a frame may be published again.
    last: HashMap<u32, (u64, u64)>,
    /// World steps.
    n_steps: u64,
}

/// What the samples of a server must fit.
#[derive(Debug, Clone)]
struct Limits {
    n_worlds: u32,
    height: usize,
    width: usize,
    n_moves: usize,
}

impl Course {
    /// Takes note of a record, or says what is wrong with it.
    fn admit(&mut self, record: &Record) -> Result<(), String> {
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
        expect(
            "sample version",
            message::VERSION.to_string(),
            version.to_string(),
        )?;
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

/// The checksum of a record.
fn checksum(header: &RecordHeader, stored: &[u8]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    let bytes = bytemuck::bytes_of(header);
    hasher.update(&bytes[..bytes.len() - size_of::<u32>()]);
    hasher.update(stored);
    hasher.finalize()
}

const _: () = assert!(MAX_CONTROL_BYTES < MAX_BODY_BYTES);
