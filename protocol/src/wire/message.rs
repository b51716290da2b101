//! The binary messages: `#[repr(C)]` headers of every channel. PROTOCOL.md holds their byte tables.
//!
//! Headers hold integers and floats only, in the byte order of the host; everything with fewer
//! valid values than bit patterns is converted with `TryFrom` and checked. Variable parts travel
//! as the `[u8]` payload behind the header.

use bytemuck::{Pod, Zeroable};
use iceoryx2::prelude::ZeroCopySend;

pub use super::codes::{FLAG_FULL_COVERAGE, Operation, Status, UnknownCode, VERSION};

/// A header that can lie in shared memory.
pub trait Header: std::fmt::Debug + Default + Copy + ZeroCopySend {}

impl<T: std::fmt::Debug + Default + Copy + ZeroCopySend> Header for T {}

/// Header of a `step` request; the payload is `n_worlds` paths of `n_moves` bytes each.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable, ZeroCopySend)]
#[type_name("emberwatch.v1.StepRequest")]
pub struct StepRequest {
    /// [`VERSION`].
    pub version: u32,
    /// An [`Operation`].
    pub operation: u32,
    /// The lease from `acquire`; ignored by `Observe` and `Recall`.
    pub lease: u64,
    /// Chosen by the client, returned in the answer.
    pub sequence: u64,
    /// First world.
    pub first_world: u32,
    /// Number of consecutive worlds.
    pub n_worlds: u32,
    /// Moves in each path; 0 for `Observe` and `Recall`.
    pub n_moves: u32,
    /// [`FLAG_FULL_COVERAGE`] or 0.
    pub flags: u32,
    /// Low half of the id of the client's listener on `wake-client`; both halves 0: no wake-up.
    pub listener_low: u64,
    /// High half of that id.
    pub listener_high: u64,
    /// The step k to recall; 0 for other operations.
    pub step: u64,
}

/// Header of a `step` answer; the payload is `n_worlds` [`StepResult`]s, then `n_worlds` frames
/// of `height * width` bytes, both empty unless the status is `Ok`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable, ZeroCopySend)]
#[type_name("emberwatch.v1.StepReply")]
pub struct StepReply {
    /// [`VERSION`].
    pub version: u32,
    /// A [`Status`].
    pub status: u32,
    /// The request's sequence number.
    pub sequence: u64,
    /// First world, as asked.
    pub first_world: u32,
    /// Number of worlds in the payload; 0 unless the status is `Ok`.
    pub n_worlds: u32,
    /// Grid height H.
    pub height: u32,
    /// Grid width W.
    pub width: u32,
    /// Time that the server worked on the request, nanoseconds: checks, simulation, copying.
    pub simulation_nanos: u64,
    /// See [`Status`].
    pub detail: u64,
    /// 0.
    pub reserved: [u64; 2],
}

/// What one world's step gave; also the state of a world after a reset.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, ZeroCopySend)]
#[type_name("emberwatch.v1.StepResult")]
pub struct StepResult {
    /// Step index k after the step; 0 after a reset.
    pub step: u64,
    /// Seed of the episode.
    pub seed: u64,
    /// Number of resets of this world since the server started.
    pub episode: u64,
    /// Sum of rewards over the distinct visited cells in `X_{k+1}`.
    pub reward: f64,
    /// Cells of the whole grid in the state that pays most (burning cells).
    pub n_target_cells: u32,
    /// Distinct cells visited by the path.
    pub n_visited: u32,
    /// Distinct visited cells in the state that pays most.
    pub n_hits: u32,
    /// The robot's row.
    pub row: u32,
    /// The robot's column.
    pub col: u32,
    /// A [`crate::model::frame::Coverage`].
    pub coverage: u32,
    /// 1 if the episode ended by itself (never, in this model), else 0.
    pub terminated: u16,
    /// 1 if the episode reached the server's `max_steps`, else 0.
    pub truncated: u16,
    /// 0.
    pub reserved: u32,
}

/// Header of a `control` request; the payload is JSON, a [`crate::wire::control::Request`].
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable, ZeroCopySend)]
#[type_name("emberwatch.v1.ControlRequest")]
pub struct ControlRequest {
    /// [`VERSION`].
    pub version: u32,
    /// 0.
    pub reserved: u32,
    /// Chosen by the client, returned in the answer.
    pub sequence: u64,
    /// Low half of the id of the client's listener on `wake-client`; both halves 0: no wake-up.
    pub listener_low: u64,
    /// High half of that id.
    pub listener_high: u64,
}

/// Header of a `control` answer; the payload is JSON, a [`crate::wire::control::Reply`].
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable, ZeroCopySend)]
#[type_name("emberwatch.v1.ControlReply")]
pub struct ControlReply {
    /// [`VERSION`].
    pub version: u32,
    /// A [`Status`].
    pub status: u32,
    /// The request's sequence number.
    pub sequence: u64,
}

/// Header of a sample on `frames`; the payload is the frame (`height * width` bytes), then the
/// path that was flown (`n_moves` bytes).
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, ZeroCopySend)]
#[type_name("emberwatch.v1.FrameHeader")]
pub struct FrameHeader {
    /// [`VERSION`].
    pub version: u32,
    /// The world.
    pub world: u32,
    /// Number of samples published on this channel before this one: a gap is a loss.
    pub sequence: u64,
    /// Grid height H.
    pub height: u32,
    /// Grid width W.
    pub width: u32,
    /// Moves in the path; 0 after a reset.
    pub n_moves: u32,
    /// Row where the path began.
    pub start_row: u32,
    /// Column where the path began.
    pub start_col: u32,
    /// 0.
    pub reserved: u32,
    /// The step's result.
    pub result: StepResult,
}

/// Header of a sample on `truth`; the payload is the hidden state (`height * width` bytes).
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable, ZeroCopySend)]
#[type_name("emberwatch.v1.TruthHeader")]
pub struct TruthHeader {
    /// [`VERSION`].
    pub version: u32,
    /// The world.
    pub world: u32,
    /// Number of samples published on this channel before this one: a gap is a loss.
    pub sequence: u64,
    /// Number of resets of this world since the server started.
    pub episode: u64,
    /// Step index k of the state shown.
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
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable, ZeroCopySend)]
#[type_name("emberwatch.v1.AgentHeader")]
pub struct AgentHeader {
    /// [`VERSION`].
    pub version: u32,
    /// The world.
    pub world: u32,
    /// Number of samples that this agent published before this one: a gap is a loss.
    pub sequence: u64,
    /// Number of resets of this world since the server started.
    pub episode: u64,
    /// Step index k of the state that the belief is about.
    pub step: u64,
    /// Seed of the episode.
    pub seed: u64,
    /// Grid height H.
    pub height: u32,
    /// Grid width W.
    pub width: u32,
    /// Number of states S of the belief.
    pub n_states: u32,
    /// The agent's process.
    pub pid: u32,
}

/// Bytes of one [`StepResult`] in a payload.
pub const RESULT_BYTES: usize = size_of::<StepResult>();

/// The results and frames in the payload of a successful step answer.
///
/// # Errors
/// The number of bytes expected, if the payload is not as long as its header says.
pub fn split_step_payload<'a>(
    reply: &StepReply,
    payload: &'a [u8],
) -> Result<(Vec<StepResult>, &'a [u8]), usize> {
    let n_worlds = reply.n_worlds as usize;
    let n_cells = (reply.height as usize).saturating_mul(reply.width as usize);
    let expected = n_cells
        .saturating_add(RESULT_BYTES)
        .saturating_mul(n_worlds);
    if payload.len() != expected {
        return Err(expected);
    }
    let (results, frames) = payload.split_at(n_worlds * RESULT_BYTES);
    let results = results
        .chunks_exact(RESULT_BYTES)
        .map(bytemuck::pod_read_unaligned)
        .collect();
    Ok((results, frames))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_payload_of_the_wrong_length_is_refused() {
        let reply = StepReply {
            n_worlds: 2,
            height: 3,
            width: 5,
            ..StepReply::default()
        };
        let expected = 2 * (64 + 15);
        assert!(split_step_payload(&reply, &vec![0; expected]).is_ok());
        assert_eq!(split_step_payload(&reply, &[0; 3]), Err(expected));
        let huge = StepReply {
            n_worlds: u32::MAX,
            height: u32::MAX,
            width: u32::MAX,
            ..reply
        };
        assert!(split_step_payload(&huge, &[]).is_err());
    }
}
