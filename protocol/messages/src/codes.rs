//! The codes in binary messages: version, operations, flags and statuses.

use crate::limits::memory::in_words;
use thiserror::Error;

pub const VERSION: u32 = 3;

/// Flag in [`crate::message::StepRequest::flags`]: observe every cell, not only the path. Allowed only if the server's
/// coverage is `client` or `full`.
pub const FLAG_FULL_COVERAGE: u32 = 1;

/// Flag in [`crate::message::StepRequest::flags`]: return one frame per world, with everything that its robots saw,
/// instead of one per robot.
pub const FLAG_TEAM_FRAMES: u32 = 2;

/// The operation of a step request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum Operation {
    /// Fly a path with each robot. A world moves from k to k + 1 as soon as all its held robots have a path. Needs a
    /// lease.
    Step = 1,
    /// Return the last results and frames again, without changing anything. Needs no lease.
    Observe = 2,
    /// Return the results and frames of an earlier step k of each world. Needs no lease.
    Recall = 3,
}

#[derive(Debug, Error, PartialEq, Eq)]
#[error("{what}: {value} is not a known code")]
pub struct UnknownCode {
    /// `status` or `operation`.
    pub what: &'static str,
    pub value: u32,
}

/// The status of an answer. Every rejection has a separate code and changes nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u32)]
pub enum Status {
    Ok = 0,
    /// The request's protocol version differs from the server's; detail: the server's version.
    VersionMismatch = 1,
    /// No such operation; detail: the operation received.
    UnknownOperation = 2,
    /// Not a well-formed control message.
    Malformed = 3,
    /// The server has no such world; detail: number of worlds.
    NoSuchWorld = 4,
    /// The length of the payload does not fit the header; detail: bytes expected.
    WrongLength = 5,
    /// The path does not have the server's number of moves; detail: moves expected.
    WrongPathLength = 6,
    /// A byte is not a move; detail: its position in the payload.
    BadMove = 7,
    /// The lease does not cover these robots, or was never granted; detail: the first such robot.
    NoLease = 8,
    /// The lease was taken over, expired or released; detail: pid of the client that took over the robot or holds it
    /// now, or 0 if there is no such client.
    LeaseLost = 9,
    /// Another client holds a robot; detail: its pid. For a step: a path of the robot is already waiting; detail: the
    /// client's own pid.
    Busy = 10,
    /// A world is being reset; detail: the world.
    Resetting = 11,
    /// The episode of a world was truncated, so the world must be reset first; detail: the world.
    EpisodeOver = 12,
    /// The request asks for full frames from a server that does not provide them; detail: 0.
    NotPermitted = 13,
    /// An unknown flag; detail: the flags received.
    UnknownFlags = 14,
    /// The file cannot be read or written, or its contents are rejected; detail: 0.
    BadFile = 17,
    /// The server does not keep the frame or belief; detail: for a frame, the nearest step that is kept, and for a
    /// belief, the current step.
    NotKept = 18,
    /// A path is for a step k that its world has already passed; detail: the world's current step. `Observe` shows
    /// whether the path was flown.
    Late = 19,
    /// A path is for a step k that its world has not reached yet; detail: the world's current step.
    Early = 20,
    /// A step request omits a robot that the client holds in the same world, or covers several worlds although another
    /// client holds a robot in one of them; detail: the first such robot.
    Incomplete = 21,
    /// The server has no such robot; detail: number of robots of all worlds.
    NoSuchRobot = 22,
    /// There is too little memory for the answer; detail: size of the step's answer in bytes, or 0 if shared memory is
    /// short.
    NoMemory = 23,
}

impl Status {
    pub const ALL: [Self; 22] = [
        Self::Ok,
        Self::VersionMismatch,
        Self::UnknownOperation,
        Self::Malformed,
        Self::NoSuchWorld,
        Self::WrongLength,
        Self::WrongPathLength,
        Self::BadMove,
        Self::NoLease,
        Self::LeaseLost,
        Self::Busy,
        Self::Resetting,
        Self::EpisodeOver,
        Self::NotPermitted,
        Self::UnknownFlags,
        Self::BadFile,
        Self::NotKept,
        Self::Late,
        Self::Early,
        Self::Incomplete,
        Self::NoSuchRobot,
        Self::NoMemory,
    ];

    /// Returns the message for a client with another protocol version.
    pub fn version_mismatch(client: u32, server: u64) -> String {
        format!(
            "protocol version mismatch: the client speaks {client}, the server {server}; \
             use a client and a server of the same release"
        )
    }

    /// Explains the status and its detail in one sentence, with advice on what to do.
    pub fn explain(self, detail: u64) -> String {
        match self {
            Self::Ok => "ok".into(),
            Self::VersionMismatch => Self::version_mismatch(VERSION, detail),
            Self::UnknownOperation => {
                format!("operation: expected 1 (step), 2 (observe) or 3 (recall), got {detail}")
            }
            Self::Malformed => "malformed control message".into(),
            Self::NoSuchWorld => format!(
                "no such world: there are worlds 0 to {}; for more, set worlds (--worlds N of a server)",
                detail.saturating_sub(1)
            ),
            Self::WrongLength => format!("wrong payload length: expected {detail} bytes"),
            Self::WrongPathLength => {
                format!("wrong path length: expected {detail} moves per step")
            }
            Self::BadMove => format!("byte {detail} of the payload: expected a move in 0..=3"),
            Self::NoLease => format!("no lease on robot {detail}: acquire it first"),
            Self::LeaseLost if detail == 0 => {
                "lease lost: it expired or was released; acquire the robots again".into()
            }
            Self::LeaseLost => format!(
                "lease lost to pid {detail}, which took over the robot or acquired it later"
            ),
            Self::Busy => format!(
                "busy: held by pid {detail}; wait for its release, or acquire with \"takeover\": true"
            ),
            Self::Resetting => {
                format!("world {detail} is being reset; wait for the answer to the reset")
            }
            Self::EpisodeOver => format!("world {detail} was truncated: reset it first"),
            Self::NotPermitted => {
                "not permitted: full frames need a server with coverage \"client\" or \"full\""
                    .into()
            }
            Self::UnknownFlags => {
                format!(
                    "flags: expected 1 (full coverage), 2 (team frames), both or 0, got {detail}"
                )
            }
            Self::BadFile => "the file cannot be used".into(),
            Self::NotKept => format!("not kept: the nearest step that is kept is {detail}"),
            Self::Late => format!(
                "late: the world is already at step {detail}; observe it, and send a path for that step"
            ),
            Self::Early => format!("early: the world is only at step {detail}"),
            Self::Incomplete => format!(
                "incomplete: robot {detail} is missing; a step must name all robots that its client holds in a world, \
                 and a step of several worlds must name all their robots"
            ),
            Self::NoMemory if detail == 0 => {
                "shared memory is full: free some, and try again".into()
            }
            Self::NoMemory => format!(
                "memory: expected {} for the answer, got less; ask for fewer robots at a time",
                in_words(detail)
            ),
            Self::NoSuchRobot => format!(
                "no such robot: there are robots 0 to {}; for more, set worlds or robots (--worlds N or --robots N of a \
                 server)",
                detail.saturating_sub(1)
            ),
        }
    }
}

impl TryFrom<u32> for Status {
    type Error = UnknownCode;

    fn try_from(value: u32) -> Result<Self, UnknownCode> {
        let known = Self::ALL.into_iter().find(|&it| it as u32 == value);
        known.ok_or(UnknownCode {
            what: "status",
            value,
        })
    }
}

impl TryFrom<u32> for Operation {
    type Error = UnknownCode;

    fn try_from(value: u32) -> Result<Self, UnknownCode> {
        match value {
            1 => Ok(Self::Step),
            2 => Ok(Self::Observe),
            3 => Ok(Self::Recall),
            _ => Err(UnknownCode {
                what: "operation",
                value,
            }),
        }
    }
}
