//! What answers a client's requests.

use crate::control::{Reply, Request, ServerInfo};
use crate::errors::{ConnectionError, garbled};
use crate::message::{StepReply, StepRequest};
use std::time::Duration;

/// The answer to a step request: its header, and its payload, which fits the header: results of the worlds, results of
/// the robots, frames.
pub type StepAnswer = (StepReply, Vec<u8>);

/// A server, or worlds in this process.
pub trait Backend {
    /// What the server said of itself.
    fn info(&self) -> &ServerInfo;

    /// Answers a step request; fills in what the way to the server needs: version, sequence, listener. The answer to a
    /// `Step` waits until the worlds have moved.
    ///
    /// # Errors
    /// If the server refuses, has ended, or gives no good answer in time.
    fn step(
        &mut self,
        request: StepRequest,
        body: &[u8],
        timeout: Duration,
    ) -> Result<StepAnswer, ConnectionError>;

    /// Answers a control request, JSON with JSON.
    ///
    /// # Errors
    /// As [`Self::step`].
    fn control_text(&mut self, text: &[u8], timeout: Duration) -> Result<Vec<u8>, ConnectionError>;

    /// Answers a control request.
    ///
    /// # Errors
    /// As [`Self::step`].
    fn control(&mut self, request: &Request, timeout: Duration) -> Result<Reply, ConnectionError> {
        let text = serde_json::to_vec(request).expect("invariant: requests serialise");
        let answer = self.control_text(&text, timeout)?;
        serde_json::from_slice(&answer).map_err(|error| garbled("a control request", error))
    }
}
