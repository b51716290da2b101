//! The binary messages: `#[repr(C)]` headers of every channel, with byte tables in PROTOCOL.md.
//!
//! Headers contain only integers and floats, in the byte order of the host. Conversions with `TryFrom` reject invalid
//! values, such as unknown codes. Parts of variable length follow the header as a `[u8]` payload.

use bytemuck::{Pod, Zeroable};
use emberwatch_model::grid::Cell;
use std::ops::Range;

pub use super::codes::{
    FLAG_FULL_COVERAGE, FLAG_TEAM_FRAMES, Operation, Status, UnknownCode, VERSION,
};

/// A header of plain bytes, which can be stored in shared memory.
pub trait Header: std::fmt::Debug + Default + Pod + Send + Sync {
    /// The type name by which iceoryx2 checks that both ends of a channel use the same header.
    const TYPE_NAME: &'static str;
}

/// Implements [`Header`] with the names in PROTOCOL.md.
macro_rules! headers {
    ($($header:ident),* $(,)?) => {$(
        impl Header for $header {
            const TYPE_NAME: &'static str = concat!("emberwatch.v3.", stringify!($header));
        }
    )*};
}

headers!(
    StepRequest,
    StepReply,
    WorldResult,
    RobotResult,
    ControlRequest,
    ControlReply,
    FrameHeader,
    TruthHeader,
    AgentHeader,
);

/// A header of samples that a server or an agent publishes.
pub trait Published: Header {
    fn version(&self) -> u32;

    fn world(&self) -> u32;

    /// Returns the number of earlier samples of the same sender. A gap means lost samples.
    fn sequence(&self) -> u64;
}

macro_rules! published {
    ($($header:ident),*) => {$(
        impl Published for $header {
            fn version(&self) -> u32 {
                self.version
            }

            fn world(&self) -> u32 {
                self.world
            }

            fn sequence(&self) -> u64 {
                self.sequence
            }
        }
    )*};
}

published!(FrameHeader, TruthHeader, AgentHeader);

/// Header of a `step` request. The payload of `Step` is the current step k of each world (`u64`), then a path of
/// `n_moves` bytes for each robot. The payload of `Recall` is the step of each world; `Observe` has no payload.
///
/// Robots are numbered across all worlds of a server: robot r of world w has the number `w * R + r`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct StepRequest {
    /// [`VERSION`].
    pub version: u32,
    /// An [`Operation`].
    pub operation: u32,
    /// The lease from `acquire`; ignored by `Observe` and `Recall`.
    pub lease: u64,
    pub sequence: u64,
    /// Number of the first robot.
    pub first_robot: u32,
    /// Number of consecutive robots, at least 1.
    pub n_robots: u32,
    /// Number of moves in each path; 0 for `Observe` and `Recall`.
    pub n_moves: u32,
    /// [`FLAG_FULL_COVERAGE`], [`FLAG_TEAM_FRAMES`], both or 0.
    pub flags: u32,
    /// Low half of the id of the client's listener on `wake-client`. If both halves are 0, the server sends no wake-up.
    pub listener_low: u64,
    /// High half of the listener's id.
    pub listener_high: u64,
}

/// Header of a `step` answer. The payload is `n_worlds` [`WorldResult`]s, `n_robots` [`RobotResult`]s, then frames of
/// `height * width` bytes: one for each robot, or with [`FLAG_TEAM_FRAMES`] one for each world. The payload is empty
/// unless the status is `Ok`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct StepReply {
    /// [`VERSION`].
    pub version: u32,
    /// A [`Status`].
    pub status: u32,
    /// The request's sequence number.
    pub sequence: u64,
    /// Number of the first robot, from the request.
    pub first_robot: u32,
    /// Number of robots in the payload; 0 unless the status is `Ok`.
    pub n_robots: u32,
    /// Number of worlds of these robots; 0 unless the status is `Ok`.
    pub n_worlds: u32,
    /// The request's flags.
    pub flags: u32,
    /// Grid height H.
    pub height: u32,
    /// Grid width W.
    pub width: u32,
    /// Time in nanoseconds that the server spent on checks, simulation and copying for this request. The wait for other
    /// clients' paths is not included.
    pub simulation_nanos: u64,
    /// The detail of the status; see [`Status`].
    pub detail: u64,
}

/// The state of a world after a step or a reset, and the combined results of its robots in the step.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
pub struct WorldResult {
    /// Step index k after the step; 0 after a reset.
    pub step: u64,
    /// Seed of the episode.
    pub seed: u64,
    /// Number of resets of this world since the server started.
    pub episode: u64,
    /// Sum of the rewards of the distinct cells that any robot visited, each in its state in `X_{k+1}`.
    pub reward: f64,
    /// Bit r is set if no client held robot r of the world. A robot that nobody holds stays in its cell and sees
    /// nothing.
    pub hovered: u64,
    /// Bit r is set if robot r was held, but its path was not received by the deadline. A late robot stays in its cell
    /// and sees nothing.
    pub late: u64,
    /// Number of cells of the whole grid in the state with the highest reward (burning cells).
    pub n_target_cells: u32,
    /// Number of distinct cells that any robot visited.
    pub n_visited: u32,
    /// Number of distinct rewarded cells in the state with the highest reward.
    pub n_hits: u32,
    /// 1 if the episode ended by itself (never, in this model), otherwise 0.
    pub terminated: u16,
    /// 1 if the episode reached the server's `max_steps` or the last recorded step, otherwise 0.
    pub truncated: u16,
}

/// The result of a step for one robot, or its position after a reset.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
pub struct RobotResult {
    /// The robot's share of the team's reward: a cell that v robots visited pays 1/v of its reward to each.
    pub reward: f64,
    /// The robot's marginal contribution: the team's reward minus the team's reward without this robot.
    pub marginal: f64,
    /// Number of distinct cells that the robot visited.
    pub n_visited: u32,
    /// Number of the robot's distinct rewarded cells in the state with the highest reward.
    pub n_hits: u32,
    /// Row where the path began, or where the robot stays.
    pub start_row: u32,
    /// Column where the path began, or where the robot stays.
    pub start_col: u32,
    /// The robot's row.
    pub row: u32,
    /// The robot's column.
    pub col: u32,
    /// What the robot's frame shows: 0 nothing, 1 the path, 2 every cell (see [`emberwatch_model::frame::Coverage`]).
    pub coverage: u32,
    /// Number of moves flown; 0 after a reset, and in a step in which the robot hovered or was late.
    pub n_moves: u32,
}

impl RobotResult {
    pub fn cell(&self) -> Cell {
        Cell {
            row: self.row as usize,
            col: self.col as usize,
        }
    }

    /// Returns the cell where the path began, or where the robot stays.
    pub fn start(&self) -> Cell {
        Cell {
            row: self.start_row as usize,
            col: self.start_col as usize,
        }
    }
}

/// Header of a `control` request; the payload is JSON, a [`crate::control::Request`].
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct ControlRequest {
    /// [`VERSION`].
    pub version: u32,
    /// Reserved; always 0.
    pub reserved: u32,
    pub sequence: u64,
    /// Low half of the id of the client's listener on `wake-client`. If both halves are 0, the server sends no wake-up.
    pub listener_low: u64,
    /// High half of the listener's id.
    pub listener_high: u64,
}

/// Header of a `control` answer; the payload is JSON, a [`crate::control::Reply`].
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct ControlReply {
    /// [`VERSION`].
    pub version: u32,
    /// A [`Status`].
    pub status: u32,
    /// The request's sequence number.
    pub sequence: u64,
}

/// Header of a sample on `frames`: one step of one world. The payload is `n_robots` [`RobotResult`]s, one frame of
/// `height * width` bytes per robot, then each robot's path of [`RobotResult::n_moves`] bytes.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
pub struct FrameHeader {
    /// [`VERSION`].
    pub version: u32,
    /// The world.
    pub world: u32,
    /// Number of earlier samples on this channel. A gap means lost samples.
    pub sequence: u64,
    /// Number of the world's first robot.
    pub first_robot: u32,
    /// Number of robots R of the world.
    pub n_robots: u32,
    /// Grid height H.
    pub height: u32,
    /// Grid width W.
    pub width: u32,
    /// The world's result.
    pub result: WorldResult,
}

/// Header of a sample on `truth`; the payload is the hidden state (`height * width` bytes).
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct TruthHeader {
    /// [`VERSION`].
    pub version: u32,
    /// The world.
    pub world: u32,
    /// Number of earlier samples on this channel. A gap means lost samples.
    pub sequence: u64,
    /// Number of resets of this world since the server started.
    pub episode: u64,
    /// Step index k of the state.
    pub step: u64,
    /// Seed of the episode.
    pub seed: u64,
    /// Grid height H.
    pub height: u32,
    /// Grid width W.
    pub width: u32,
}

/// Header of a sample on `agent`; the payload is a belief (`n_states * height * width` floats), then
/// JSON, an [`super::agent_belief::Intent`].
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct AgentHeader {
    /// [`VERSION`].
    pub version: u32,
    /// The world.
    pub world: u32,
    /// Number of earlier samples of this agent. A gap means lost samples.
    pub sequence: u64,
    /// Number of resets of this world since the server started.
    pub episode: u64,
    /// Step index k of the state that the belief describes.
    pub step: u64,
    /// Seed of the episode.
    pub seed: u64,
    /// Grid height H.
    pub height: u32,
    /// Grid width W.
    pub width: u32,
    /// Number of states S of the belief.
    pub n_states: u32,
    /// The agent's process id.
    pub pid: u32,
    /// Number of the first robot that the agent flies.
    pub first_robot: u32,
    /// Number of consecutive robots that the agent flies, at least 1.
    pub n_robots: u32,
}

/// Returns the worlds of consecutive robots, with `team` robots in each world.
pub fn worlds_of(first_robot: u32, n_robots: u32, team: u32) -> Range<u32> {
    let (team, end) = (team.max(1), first_robot.saturating_add(n_robots));
    first_robot / team..end.div_ceil(team)
}
