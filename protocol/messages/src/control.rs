//! The messages of the `control` channel: requests and replies as JSON text, for everything except steps.

use super::codes::{Status, VERSION};
use emberwatch_model::frame::Coverage;
use serde::{Deserialize, Serialize};

pub use super::hello::{AirspaceInfo, CoverageRule, RecordedWorld, ServerInfo};
pub use super::json::{MAX_CONTROL_BYTES, parse};

/// Maximum size of a part of a belief in one message, in bytes before the base64 encoding.
pub const MAX_BELIEF_PART: usize = 1 << 19;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "op", rename_all = "snake_case", deny_unknown_fields)]
pub enum Request {
    /// Start the handshake: ask for the server's settings and protocol version.
    Hello {
        protocol: u32,
        /// The client's name and version, for the server's log.
        client: String,
    },
    /// Acquire the right to fly consecutive robots.
    Acquire {
        first_robot: u32,
        n_robots: u32,
        #[serde(default)]
        takeover: bool,
        /// Time from the last use of the lease until it ends; `None` for the server's default.
        #[serde(default)]
        ttl_millis: Option<u64>,
    },
    /// Extend a lease without flying.
    Renew { lease: u64 },
    /// Return the robots of a lease.
    Release { lease: u64 },
    /// Start new episodes; the answer is sent when the burn-in is done. The client needs a lease on at least one robot
    /// of these worlds, and no other client may hold any of their robots. The same applies to `Restore` and `Fork`.
    Reset { lease: u64, worlds: Vec<WorldSeed> },
    /// Write worlds to a file on the server's machine.
    Snapshot {
        first_world: u32,
        n_worlds: u32,
        /// An absolute path.
        path: String,
    },
    /// Replace worlds of the lease with worlds from a snapshot file.
    Restore {
        lease: u64,
        first_world: u32,
        n_worlds: u32,
        /// The first world to read, as an index in the file.
        #[serde(default)]
        from: u32,
        /// An absolute path.
        path: String,
    },
    /// Replace a world of the lease with a copy of another world.
    Fork { lease: u64, from: u32, to: u32 },
    /// Store the next part of a belief about a robot's world, for the next client that flies the robot.
    LeaveBelief(LeftPart),
    /// Load the belief that was stored for a robot, if it is about the current step of the robot's world.
    Belief {
        robot: u32,
        #[serde(default)]
        offset: u64,
    },
    /// Ask for the state of the server and its worlds.
    // The braces make serde reject unknown keys, which it would accept in a unit variant.
    Status {},
    /// Stop the server.
    Shutdown {},
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WorldSeed {
    pub world: u32,
    /// The new seed; `None` lets the server derive one from the previous seed.
    #[serde(default)]
    pub seed: Option<u64>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "reply", rename_all = "snake_case")]
pub enum Reply {
    /// Answers `hello`.
    Hello(Box<ServerInfo>),
    /// Answers `acquire` and `renew`.
    Lease(LeaseInfo),
    /// Answers `release`, `leave_belief` and `shutdown`.
    Done,
    /// Answers `reset`: the worlds after the reset.
    Reset {
        /// One entry per reset world, in the order of the request.
        worlds: Vec<WorldInfo>,
    },
    /// Answers `snapshot`: the file was written.
    Snapshot {
        path: String,
        n_bytes: u64,
        /// The worlds in the file, at the steps that the file contains.
        worlds: Vec<WorldInfo>,
    },
    /// Answers `restore` and `fork`: the worlds after the replacement.
    Restored {
        worlds: Vec<WorldInfo>,
    },
    /// Answers `belief`.
    Belief {
        #[serde(flatten)]
        info: BeliefInfo,
        offset: u64,
        /// The part in base64; empty at the end of the belief.
        data: String,
    },
    Status(ServerStatus),
    /// Reports that a request was refused; nothing was changed.
    Error {
        status: Status,
        detail: u64,
        message: String,
    },
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LeaseInfo {
    /// The lease's number, which each step request contains.
    pub lease: u64,
    /// Time from the last use of the lease until it ends.
    pub ttl_millis: u64,
    /// Numbers of the robots that the lease still holds.
    pub robots: Vec<u32>,
    pub worlds: Vec<WorldInfo>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LeftPart {
    pub lease: u64,
    pub robot: u32,
    pub episode: u64,
    pub step: u64,
    /// The format of the bytes, in at most 256 bytes.
    pub kind: String,
    /// The offset of the part; 0 begins a new belief.
    pub offset: u64,
    /// Length of the whole belief in bytes.
    pub length: u64,
    /// The part in base64, at most [`MAX_BELIEF_PART`] bytes.
    pub data: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct BeliefInfo {
    pub kind: String,
    pub seed: u64,
    pub episode: u64,
    pub step: u64,
    pub length: u64,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WorldInfo {
    pub world: u32,
    /// Step index k.
    pub step: u64,
    pub seed: u64,
    pub episode: u64,
    /// `[row, col]` of each of the world's robots.
    pub robots: Vec<[u32; 2]>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ServerStatus {
    pub pid: u32,
    pub uptime_millis: u64,
    /// Number of world steps since the server started, over all worlds.
    pub n_steps: u64,
    /// World steps per second, over about the last second.
    pub steps_per_second: f64,
    pub n_refused: u64,
    pub n_clients: usize,
    pub n_observers: usize,
    pub worlds: Vec<WorldStatus>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WorldStatus {
    #[serde(flatten)]
    pub info: WorldInfo,
    /// The pid of the client that holds each robot, if any.
    pub holder_pids: Vec<Option<u32>>,
    /// Number of robots that have a path for the next step.
    pub n_paths: u32,
    pub resetting: bool,
}

impl Reply {
    pub fn refusal(status: Status, detail: u64) -> Self {
        Self::error(status, detail, status.explain(detail))
    }

    pub fn error(status: Status, detail: u64, message: String) -> Self {
        Self::Error {
            status,
            detail,
            message,
        }
    }

    pub fn version_mismatch(client: u32) -> Self {
        let (status, detail) = (Status::VersionMismatch, u64::from(VERSION));
        Self::error(status, detail, Status::version_mismatch(client, detail))
    }

    pub fn status(&self) -> Status {
        match self {
            Self::Error { status, .. } => *status,
            _ => Status::Ok,
        }
    }
}

impl CoverageRule {
    /// Returns the coverage of a step under this rule.
    ///
    /// # Errors
    /// [`Status::NotPermitted`] if the client asks for full frames and the rule does not allow them.
    pub fn coverage(self, asks_full: bool) -> Result<Coverage, Status> {
        match (self, asks_full) {
            (Self::Full, _) | (Self::Client, true) => Ok(Coverage::Full),
            (Self::Path | Self::Client, false) => Ok(Coverage::Path),
            (Self::Path, true) => Err(Status::NotPermitted),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coverage_follows_the_server_s_rule() {
        for (rule, asks, given) in [
            (CoverageRule::Path, false, Ok(Coverage::Path)),
            (CoverageRule::Path, true, Err(Status::NotPermitted)),
            (CoverageRule::Full, false, Ok(Coverage::Full)),
            (CoverageRule::Full, true, Ok(Coverage::Full)),
            (CoverageRule::Client, false, Ok(Coverage::Path)),
            (CoverageRule::Client, true, Ok(Coverage::Full)),
        ] {
            assert_eq!(rule.coverage(asks), given, "{rule:?} {asks}");
        }
    }
}
