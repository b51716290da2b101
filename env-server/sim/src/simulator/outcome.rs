//! Outcomes of control requests.

use super::lease::{ClientId, Refusal};
use super::state::ResetJob;
use crate::snapshot::Job;
use emberwatch_messages::control::{Reply, WorldInfo};
use emberwatch_messages::message::Status;
use std::ops::Range;
use std::time::Duration;

pub enum Outcome {
    Answer(Reply),
    /// Resets to run, and an answer that follows when the requested worlds are ready.
    Pending(Vec<ResetJob>, PendingReply),
    /// Worlds to publish to observers, and an immediate answer.
    Changed(Range<usize>, Reply),
    /// A file to read or write, and an answer that follows when this is done.
    File(Job, PendingFile),
    /// An immediate answer, after which the server ends.
    Shutdown,
}

pub struct PendingReply {
    pub(super) worlds: Vec<usize>,
    pub(super) lease: u64,
    pub(super) client: ClientId,
    /// Whether the reply describes the lease and the worlds, or only the worlds.
    pub(super) describes_lease: bool,
}

#[derive(Debug, Clone, Copy, Default)]
pub struct ServerStats {
    pub uptime: Duration,
    /// World steps per second, measured over about the last second.
    pub steps_per_second: f64,
    pub n_clients: usize,
    pub n_observers: usize,
}

#[derive(Debug)]
pub enum PendingFile {
    /// A snapshot is being written; contains the worlds in it.
    Saved(Vec<WorldInfo>),
    /// A restore: the worlds that will be replaced, and the lease under which the client requested it.
    Restored {
        lease: u64,
        client: ClientId,
        worlds: Range<usize>,
    },
}

pub(super) fn malformed(problem: &str) -> Reply {
    let message = format!("{}: {problem}", Status::Malformed.explain(0));
    Reply::error(Status::Malformed, 0, message)
}

pub(super) fn refusal(refusal: Refusal) -> Reply {
    Reply::refusal(refusal.status, refusal.detail)
}
