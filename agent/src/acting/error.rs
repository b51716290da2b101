//! Why acting on a world ended early.

use crate::planning::policy::UnknownPolicy;
use crate::rollout::agent::AgentError;
use crate::server::client::is_away;
use crate::server::truth::TruthError;
use protocol::connection::ConnectionError;
use protocol::model::ModelError;
use thiserror::Error;

/// Why a mission ended early.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RunError {
    /// The server refused, or cannot be reached in the first place.
    #[error(transparent)]
    Connection(#[from] ConnectionError),
    #[error(transparent)]
    Agent(#[from] AgentError),
    #[error(transparent)]
    Policy(#[from] UnknownPolicy),
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The hidden states that an oracle needs.
    #[error(transparent)]
    Truth(#[from] TruthError),
    /// The server hides its model and none was given.
    #[error("instance {instance:?} does not reveal its model: expected --model FILE")]
    NoModel { instance: String },
    /// A model of other observations than the server's.
    #[error("model: expected the server's {expected} observations, got {got}")]
    OtherModel { expected: usize, got: usize },
    /// A model that contradicts the one that the server reveals.
    #[error(
        "model: expected the server's own, {expected:?}, as it reveals it, got another, {got:?}"
    )]
    RevealedModel { expected: String, got: String },
    /// A policy that only `compare` can feed.
    #[error("policy {policy:?} needs worlds that run one step ahead: only `compare` has them")]
    Clairvoyant { policy: String },
}

/// Whether the server is away and may come back.
pub fn is_outage(error: &RunError) -> bool {
    matches!(error, RunError::Connection(error) if is_away(error))
}
