//! The messages of the `control` channel: JSON text both ways, rare and readable.

use super::codes::{Status, VERSION};
use emberwatch_model::frame::Coverage;
use serde::{Deserialize, Serialize};

pub use super::hello::{AirspaceInfo, CoverageRule, RecordedWorld, ServerInfo, ZonesInfo};
pub use super::json::{MAX_CONTROL_BYTES, parse};

/// Most bytes of a belief in one message, before they are written in base64.
pub const MAX_BELIEF_PART: usize = 1 << 19;

/// What a client asks on the control channel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "op", rename_all = "snake_case", deny_unknown_fields)]
pub enum Request {
    /// Handshake: which server is this, and which protocol version does it speak?
    Hello {
        /// The client's protocol version.
        protocol: u32,
        /// The client's name and version, for the server's log.
        client: String,
    },
    /// Acquire the right to fly consecutive robots.
    Acquire {
        /// Number of the first robot.
        first_robot: u32,
        /// Number of robots, at least 1.
        n_robots: u32,
        /// Whether to take the robots from their holders.
        #[serde(default)]
        takeover: bool,
        /// The lease ends this long after its last use; `None` asks for the server's default.
        #[serde(default)]
        ttl_millis: Option<u64>,
    },
    /// Extend a lease without acting.
    Renew {
        /// The lease.
        lease: u64,
    },
    /// Give the robots of a lease back.
    Release {
        /// The lease.
        lease: u64,
    },
    /// Start new episodes; answered when burn-in is done. Like `Restore` and `Fork` it needs a lease on all robots of
    /// these worlds that are held, and on at least one.
    Reset {
        /// The lease.
        lease: u64,
        /// The worlds and their seeds.
        worlds: Vec<WorldSeed>,
    },
    /// Write worlds to a file on the server's host.
    Snapshot {
        /// First world.
        first_world: u32,
        /// Number of worlds, at least 1.
        n_worlds: u32,
        /// The file, an absolute path.
        path: String,
    },
    /// Replace worlds of one's lease by those of such a file.
    Restore {
        /// The lease.
        lease: u64,
        /// First world.
        first_world: u32,
        /// Number of worlds, at least 1.
        n_worlds: u32,
        /// The first of the file's worlds that is read.
        #[serde(default)]
        from: u32,
        /// The file, an absolute path.
        path: String,
    },
    /// Replace a world of one's lease by a copy of another.
    Fork {
        /// The lease, of the world that is replaced.
        lease: u64,
        /// The world that is copied.
        from: u32,
        /// The world that is replaced.
        to: u32,
    },
    /// Leave the next part of a belief about a robot's world to the next client that flies the robot.
    LeaveBelief(LeftPart),
    /// What belief was left for who flies a robot in its world as it is now?
    Belief {
        /// Number of the robot.
        robot: u32,
        /// Where the part asked for begins.
        #[serde(default)]
        offset: u64,
    },
    /// What is the state of the server and its worlds?
    // A variant with braces: serde refuses unknown keys of it, but not of a unit variant.
    Status {},
    /// Stop the server.
    Shutdown {},
}

/// A world to reset.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WorldSeed {
    /// The world.
    pub world: u32,
    /// Its new seed; `None` lets the server derive one from the world's last.
    #[serde(default)]
    pub seed: Option<u64>,
}

/// What the server answers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "reply", rename_all = "snake_case")]
pub enum Reply {
    /// To `hello`.
    Hello(Box<ServerInfo>),
    /// To `acquire` and `renew`.
    Lease(LeaseInfo),
    /// To `release`, `leave_belief` and `shutdown`.
    Done,
    /// To `reset`: the worlds as they are now.
    Reset {
        /// One entry per world that was reset, in the order asked.
        worlds: Vec<WorldInfo>,
    },
    /// To `snapshot`: the file was written.
    Snapshot {
        /// The file.
        path: String,
        /// Its length.
        n_bytes: u64,
        /// The worlds in it, as they were.
        worlds: Vec<WorldInfo>,
    },
    /// To `restore` and `fork`: the worlds as they are now.
    Restored {
        /// One entry per world that was replaced.
        worlds: Vec<WorldInfo>,
    },
    /// To `belief`.
    Belief {
        /// What it is, and about which step.
        #[serde(flatten)]
        info: BeliefInfo,
        /// Where the part begins.
        offset: u64,
        /// The part in base64; empty at the end.
        data: String,
    },
    /// To `status`.
    Status(ServerStatus),
    /// To anything that was refused; nothing was changed.
    Error {
        /// Reason for programs.
        status: Status,
        /// See [`Status`].
        detail: u64,
        /// Reason for people.
        message: String,
    },
}

/// A lease that was given or extended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LeaseInfo {
    /// The lease: goes into each step request.
    pub lease: u64,
    /// It ends this long after its last use.
    pub ttl_millis: u64,
    /// Numbers of the robots that it still holds.
    pub robots: Vec<u32>,
    /// The worlds of these, as they are now.
    pub worlds: Vec<WorldInfo>,
}

/// A part of a belief that is left, and the step of its world.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LeftPart {
    /// The lease.
    pub lease: u64,
    /// Number of the robot.
    pub robot: u32,
    /// The episode.
    pub episode: u64,
    /// Its present step.
    pub step: u64,
    /// What the bytes are; at most 256 bytes.
    pub kind: String,
    /// Where the part begins: 0 begins a new belief.
    pub offset: u64,
    /// Length of the whole.
    pub length: u64,
    /// The part in base64, at most [`MAX_BELIEF_PART`] bytes.
    pub data: String,
}

/// A belief that was left.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct BeliefInfo {
    /// What the bytes are.
    pub kind: String,
    /// Seed of the episode it is about.
    pub seed: u64,
    /// That episode.
    pub episode: u64,
    /// The step at which it was left.
    pub step: u64,
    /// Its length in bytes.
    pub length: u64,
}

/// The present step of a world.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WorldInfo {
    /// The world.
    pub world: u32,
    /// Step index k.
    pub step: u64,
    /// Seed of its episode.
    pub seed: u64,
    /// Number of its resets since the server started.
    pub episode: u64,
    /// `[row, col]` of each of its robots.
    pub robots: Vec<[u32; 2]>,
}

/// The answer to `status`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ServerStatus {
    /// The server's process.
    pub pid: u32,
    /// Time since the server started.
    pub uptime_millis: u64,
    /// World steps since the server started, over all worlds.
    pub n_steps: u64,
    /// World steps a second, over the last second or so.
    pub steps_per_second: f64,
    /// Requests refused since the server started.
    pub n_refused: u64,
    /// Clients connected to the step channel.
    pub n_clients: usize,
    /// Observers of the frames channel.
    pub n_observers: usize,
    /// Every world.
    pub worlds: Vec<WorldStatus>,
}

/// One world in the answer to `status`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WorldStatus {
    /// Where it stands.
    #[serde(flatten)]
    pub info: WorldInfo,
    /// The process that holds each of its robots.
    pub holder_pids: Vec<Option<u32>>,
    /// Robots that have a path for the next step.
    pub n_paths: u32,
    /// Whether it is being reset.
    pub resetting: bool,
}

impl Reply {
    /// A refusal with its standard sentence.
    pub fn refusal(status: Status, detail: u64) -> Self {
        Self::error(status, detail, status.explain(detail))
    }

    /// A refusal with a sentence of its own.
    pub fn error(status: Status, detail: u64, message: String) -> Self {
        Self::Error {
            status,
            detail,
            message,
        }
    }

    /// The refusal of a client that speaks another version.
    pub fn version_mismatch(client: u32) -> Self {
        let (status, detail) = (Status::VersionMismatch, u64::from(VERSION));
        Self::error(status, detail, Status::version_mismatch(client, detail))
    }

    /// The status for the binary header.
    pub fn status(&self) -> Status {
        match self {
            Self::Error { status, .. } => *status,
            _ => Status::Ok,
        }
    }
}

impl CoverageRule {
    /// The coverage of a step under this rule.
    ///
    /// # Errors
    /// [`Status::NotPermitted`] if the client asks for full frames that the rule does not give.
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
    fn requests_read_as_protocol_md_shows_them() {
        let read = |text: &str| serde_json::from_str::<Request>(text).ok();
        let text = r#"{"op":"acquire","first_robot":0,"n_robots":4}"#;
        let expected = Request::Acquire {
            first_robot: 0,
            n_robots: 4,
            takeover: false,
            ttl_millis: None,
        };
        assert_eq!(read(text), Some(expected));
        assert_eq!(read(r#"{"op":"status"}"#), Some(Request::Status {}));
        assert_eq!(read(r#"{"op":"renew","lease":1,"extra":2}"#), None);
    }

    #[test]
    fn coverage_is_what_the_server_says() {
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
