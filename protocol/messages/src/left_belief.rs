//! Beliefs that an agent leaves with the server for a robot's next agent. They travel in parts.

use crate::backend::Backend;
use crate::control::{BeliefInfo, LeftPart, MAX_BELIEF_PART, Reply, Request};
use crate::errors::{ConnectionError, garbled, unexpected};
use crate::message::{Status, WorldResult};
use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use std::time::Duration;

/// A belief about the current step of a robot's world.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LeftBelief {
    pub info: BeliefInfo,
    pub bytes: Vec<u8>,
}

/// Leaves a belief with the server for the next agent of `robot`, which the lease with the number `lease` holds. `at`
/// is the result of the robot's last step.
///
/// # Errors
/// A refusal if the world has moved since `at`, or the server keeps no belief of this size. The timeout applies to each
/// part.
pub fn leave(
    backend: &mut dyn Backend,
    (lease, robot): (u64, u32),
    at: &WorldResult,
    kind: &str,
    bytes: &[u8],
    timeout: Duration,
) -> Result<(), ConnectionError> {
    let mut parts = bytes.chunks(MAX_BELIEF_PART);
    let mut part = parts.next().unwrap_or_default();
    let mut offset = 0;
    loop {
        let request = Request::LeaveBelief(LeftPart {
            lease,
            robot,
            episode: at.episode,
            step: at.step,
            kind: kind.into(),
            offset,
            length: bytes.len() as u64,
            data: BASE64.encode(part),
        });
        backend.control(&request, timeout)?;
        offset += part.len() as u64;
        match parts.next() {
            Some(next) => part = next,
            None => return Ok(()),
        }
    }
}

/// Loads the belief that was left for a robot about the current step of its world. Returns `None` if there is none, or
/// none of `kind`, if given.
///
/// # Errors
/// If the server has ended, refuses for another reason, or sends no valid answer in time.
pub fn load(
    backend: &mut dyn Backend,
    robot: u32,
    kind: Option<&str>,
    timeout: Duration,
) -> Result<Option<LeftBelief>, ConnectionError> {
    let (mut first, mut bytes) = (None, Vec::new());
    loop {
        let offset = bytes.len() as u64;
        let request = Request::Belief { robot, offset };
        let (info, data) = match backend.control(&request, timeout) {
            Ok(Reply::Belief { info, data, .. }) => (info, data),
            Ok(other) => return Err(unexpected("belief", &other)),
            Err(ConnectionError::Refused {
                status: Status::NotKept,
                ..
            }) => return Ok(None),
            Err(error) => return Err(error),
        };
        if kind.is_some_and(|kind| kind != info.kind) {
            return Ok(None);
        }
        let part = BASE64
            .decode(data)
            .map_err(|error| garbled("belief", error))?;
        if *first.get_or_insert_with(|| info.clone()) != info {
            (first, bytes) = (None, Vec::new()); // Another belief was left meanwhile: read from the start.
            continue;
        }
        bytes.extend_from_slice(&part);
        let (got, expected) = (bytes.len() as u64, info.length);
        if got == expected {
            return Ok(Some(LeftBelief { info, bytes }));
        }
        if part.is_empty() || got > expected {
            return Err(garbled(
                "belief",
                format!("expected {expected} bytes, got {got}"),
            ));
        }
    }
}
