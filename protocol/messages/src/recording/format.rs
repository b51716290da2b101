//! The binary format of a recording: headers of files and records, contents of records, and errors.

use crate::capacity::{MAX_ROBOTS, MAX_TEAM_CELLS};
use crate::control::{MAX_CONTROL_BYTES, ServerInfo};
use crate::message::{FrameHeader, TruthHeader, VERSION};
use crate::payload::ROBOT_BYTES;
use crate::sample::Sample;
use bytemuck::{Pod, Zeroable};
use emberwatch_model::path::MAX_MOVES;
use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;
use thiserror::Error;

/// The first bytes of every recording.
pub const MAGIC: [u8; 8] = *b"EMBERREC";

/// Versions of the format that can be read, each the protocol version of the samples. The last one is written. A file
/// in the other byte order has a different value here, and is rejected.
pub const VERSIONS: RangeInclusive<u32> = 2..=VERSION;

/// Maximum size of a body before compression in bytes, enough for the largest team with the largest frames and the
/// longest paths.
pub const MAX_BODY_BYTES: usize =
    size_of::<FrameHeader>() + MAX_TEAM_CELLS + MAX_ROBOTS * (ROBOT_BYTES + MAX_MOVES);

/// Maximum size of a stored body in bytes. It exceeds [`MAX_BODY_BYTES`], because deflate may enlarge a body that it
/// cannot compress.
pub const MAX_STORED_BYTES: usize = MAX_BODY_BYTES + MAX_BODY_BYTES / 1024 + 64;

#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct FileHeader {
    pub magic: [u8; 8],
    pub version: u32,
    /// Reserved; always 0.
    pub reserved: u32,
}

/// The header of a record, before its body.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct RecordHeader {
    /// Time in nanoseconds since the recording began; never less than in the previous record.
    pub nanos: u64,
    pub kind: u32,
    /// Size of the stored body in bytes.
    pub length: u32,
    /// Number of samples of the same channel that the recorder missed directly before this record.
    pub n_lost: u32,
    /// CRC-32 of the first 20 bytes of this header and the stored body.
    pub checksum: u32,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum Kind {
    /// The server that published the following samples: its [`ServerInfo`] in JSON.
    Server = 1,
    /// A sample of `frames`: header and payload.
    Frame = 2,
    /// A sample of `truth`: header and payload.
    Truth = 3,
    /// The end of the recording: [`Totals`] in JSON.
    End = 4,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Record {
    /// Time in nanoseconds since the recording began; never less than in the previous record.
    pub nanos: u64,
    /// Number of samples of the same channel that the recorder missed directly before this record; 0 if the record is a
    /// server.
    pub n_lost: u32,
    pub event: Event,
}

#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    Server(Box<ServerInfo>),
    /// The frames of a world's robots, and the paths that they flew.
    Frame(Sample<FrameHeader>),
    /// Hidden states, for evaluation and pictures, never for learners.
    Truth(Sample<TruthHeader>),
}

/// Counts of the records in a recording, and of the samples that its recorder missed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Totals {
    pub n_servers: u64,
    pub n_frames: u64,
    pub n_truths: u64,
    /// Number of frames that the recorder missed.
    pub n_lost_frames: u64,
    /// Number of hidden states that the recorder missed.
    pub n_lost_truths: u64,
}

/// The reason why a recording cannot be written, or cannot be read any further.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RecordingError {
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// The file is not a recording, or its format has another version or byte order.
    #[error("{0}")]
    Foreign(String),
    /// The file has no end record, because its recorder was killed or bytes are missing. All records up to `offset` are
    /// complete.
    #[error(
        "the recording was cut short: expected a whole record at byte {offset}, got {got} bytes; good before it: \
         {n_steps} steps"
    )]
    Cut {
        /// Offset in the file where the last complete record ends, in bytes.
        offset: u64,
        /// Number of bytes after the last complete record.
        got: u64,
        n_steps: u64,
    },
    /// The file contains bytes that no recorder wrote. All records up to `offset` are complete.
    #[error(
        "the recording is damaged at byte {offset}: {problem}; good before it: {n_steps} steps"
    )]
    Damaged {
        /// Offset in the file where the damaged record begins, in bytes.
        offset: u64,
        problem: String,
        n_steps: u64,
    },
    /// A record does not fit the previous records, so it was not written.
    #[error("not recorded: {0}")]
    Refused(String),
}

pub(super) fn checksum(header: &RecordHeader, stored: &[u8]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    let bytes = bytemuck::bytes_of(header);
    hasher.update(&bytes[..bytes.len() - size_of::<u32>()]);
    hasher.update(stored);
    hasher.finalize()
}

const _: () = assert!(MAX_CONTROL_BYTES < MAX_BODY_BYTES);
