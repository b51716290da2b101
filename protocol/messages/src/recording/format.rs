//! The bytes of a recording: file and record headers, what records hold, and the errors.

use crate::capacity::{MAX_ROBOTS, MAX_TEAM_CELLS};
use crate::control::{MAX_CONTROL_BYTES, ServerInfo};
use crate::message::{FrameHeader, TruthHeader};
use crate::payload::ROBOT_BYTES;
use crate::sample::Sample;
use bytemuck::{Pod, Zeroable};
use emberwatch_model::path::MAX_MOVES;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// The first bytes of every recording.
pub const MAGIC: [u8; 8] = *b"EMBERREC";

/// Version of the format. The other byte order's is another number, so such a file is refused.
pub const VERSION: u32 = 2;

/// Longest body before compression, bytes: the largest frames and the longest paths of the most robots.
pub const MAX_BODY_BYTES: usize =
    size_of::<FrameHeader>() + MAX_TEAM_CELLS + MAX_ROBOTS * (ROBOT_BYTES + MAX_MOVES);

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

/// What a record holds.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// The samples from here on are from this server.
    Server(Box<ServerInfo>),
    /// What the robots of a world saw, and the paths that they flew.
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

/// Why a recording could not be written, or not be read further.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// The system refused.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// Another kind of file, or a format of another release or byte order.
    #[error("{0}")]
    Foreign(String),
    /// The file has no end record: its recorder was killed, or bytes are missing. Everything before is whole.
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

/// The checksum of a record.
pub(super) fn checksum(header: &RecordHeader, stored: &[u8]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    let bytes = bytemuck::bytes_of(header);
    hasher.update(&bytes[..bytes.len() - size_of::<u32>()]);
    hasher.update(stored);
    hasher.finalize()
}

const _: () = assert!(MAX_CONTROL_BYTES < MAX_BODY_BYTES);
