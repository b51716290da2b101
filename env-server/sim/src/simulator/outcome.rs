//! What a control request leads to.

use super::lease::{ClientId, Refusal};
use super::state::ResetJob;
use crate::snapshot::Job;
use emberwatch_messages::control::{Reply, WorldInfo};
use emberwatch_messages::message::Status;
use std::ops::Range;
use std::time::Duration;

/// What a control request leads to.
pub enum Outcome {
    /// An answer now.
    Answer(Reply),
    /// Resets to run, and an answer when the worlds it names are ready.
    Pending(Vec<ResetJob>, PendingReply),
    /// Worlds to publish, and an answer now.
    Changed(Range<usize>, Reply),
    /// Work on a file, and an answer when it is done.
    File(Job, PendingFile),
    /// An answer now, then the end of the server.
    Shutdown,
}

/// An answer that waits until worlds have been reset.
pub struct PendingReply {
    pub(super) worlds: Vec<usize>,
    pub(super) lease: u64,
    pub(super) client: ClientId,
    /// Whether the reply describes the lease, or the worlds only.
    pub(super) tells_lease: bool,
}

/// The part of a status reply that only the server knows.
#[derive(Debug, Clone, Copy, Default)]
pub struct ServerStats {
    pub uptime: Duration,
    /// World steps a second, over the last second or so.
    pub steps_per_second: f64,
    /// Clients on the step channel.
    pub n_clients: usize,
    /// Observers of frames.
    pub n_observers: usize,
}

/// A reply that waits for a file.
#[derive(Debug)]
pub enum PendingFile {
    /// Worlds that are written.
    Saved(Vec<WorldInfo>),
    /// Worlds that will replace those of a lease.
    Restored {
        lease: u64,
        client: ClientId,
        worlds: Range<usize>,
    },
}

/// The reply to a malformed request.
pub(super) fn malformed(problem: &str) -> Reply {
    let message = format!("{}: {problem}", Status::Malformed.explain(0));
    Reply::error(Status::Malformed, 0, message)
}

pub(super) fn refusal(refusal: Refusal) -> Reply {
    Reply::refusal(refusal.status, refusal.detail)
}
