//! The backend of a client, which answers its requests.

use crate::control::{Reply, Request, ServerInfo};
use crate::errors::{ConnectionError, garbled};
use crate::message::{StepReply, StepRequest, WorldResult};
use emberwatch_model::grid::Grid;
use std::ops::Range;
use std::time::Duration;

/// The answer to a step request: the header and the payload (results of worlds, results of robots, frames). The length
/// of the payload matches the header.
pub type StepAnswer = (StepReply, Vec<u8>);

/// A server, or worlds in this process.
pub trait Backend {
    fn info(&self) -> &ServerInfo;

    /// Answers a step request. Fills in the request's version, sequence number and listener, if the backend is a
    /// connection. A `Step` is answered only after the worlds have moved.
    ///
    /// # Errors
    /// If the server refuses, has ended, or sends no valid answer in time.
    fn step(
        &mut self,
        request: StepRequest,
        body: &[u8],
        timeout: Duration,
    ) -> Result<StepAnswer, ConnectionError>;

    /// Answers a control request in JSON with a reply in JSON.
    fn control_text(&mut self, text: &[u8], timeout: Duration) -> Result<Vec<u8>, ConnectionError>;

    fn control(&mut self, request: &Request, timeout: Duration) -> Result<Reply, ConnectionError> {
        let text = serde_json::to_vec(request).expect("invariant: requests serialise");
        let answer = self.control_text(&text, timeout)?;
        serde_json::from_slice(&answer).map_err(|error| garbled("a control request", error))
    }

    /// Copies the latest results and the hidden states of consecutive worlds in this process.
    ///
    /// # Errors
    /// [`ConnectionError::Invalid`] if the worlds are on a server, do not exist, are in a reset, or hide their states.
    fn truths(
        &mut self,
        _worlds: Range<u32>,
    ) -> Result<Vec<(WorldResult, Grid<u8>)>, ConnectionError> {
        Err(on_server("truths"))
    }

    /// Encodes all worlds in this process as the bytes of a snapshot.
    ///
    /// # Errors
    /// [`ConnectionError::Invalid`] if the worlds are on a server, in a reset, or too large for a snapshot.
    fn clone_state(&mut self) -> Result<Vec<u8>, ConnectionError> {
        Err(on_server("clone_state"))
    }

    /// Replaces all worlds in this process with the worlds that [`Self::clone_state`] returned. They continue exactly
    /// as the saved ones would have.
    ///
    /// # Errors
    /// [`ConnectionError::Invalid`] if the worlds are on a server or in a reset, or the bytes are damaged or of other
    /// worlds. No world has changed then.
    fn restore_state(&mut self, _bytes: &[u8]) -> Result<(), ConnectionError> {
        Err(on_server("restore_state"))
    }
}

fn on_server(what: &'static str) -> ConnectionError {
    ConnectionError::Invalid {
        what,
        problem: "expected worlds in this process, got worlds of a server".into(),
    }
}

/// Whoever holds a backend can lend it to a client, and use it again afterwards.
impl<B: Backend> Backend for &mut B {
    fn info(&self) -> &ServerInfo {
        (**self).info()
    }

    fn step(
        &mut self,
        request: StepRequest,
        body: &[u8],
        timeout: Duration,
    ) -> Result<StepAnswer, ConnectionError> {
        (**self).step(request, body, timeout)
    }

    fn control_text(&mut self, text: &[u8], timeout: Duration) -> Result<Vec<u8>, ConnectionError> {
        (**self).control_text(text, timeout)
    }

    fn truths(
        &mut self,
        worlds: Range<u32>,
    ) -> Result<Vec<(WorldResult, Grid<u8>)>, ConnectionError> {
        (**self).truths(worlds)
    }

    fn clone_state(&mut self) -> Result<Vec<u8>, ConnectionError> {
        (**self).clone_state()
    }

    fn restore_state(&mut self, bytes: &[u8]) -> Result<(), ConnectionError> {
        (**self).restore_state(bytes)
    }
}
