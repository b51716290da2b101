//! Beliefs that an agent leaves with the server for a robot's next agent.

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use emberwatch_protocol::Client;
use emberwatch_protocol::client::STEP_TIMEOUT;
use emberwatch_protocol::connection::{ConnectionError, unexpected};
use emberwatch_protocol::control::{LeftPart, MAX_BELIEF_PART, Reply, Request};
use emberwatch_protocol::message::WorldResult;

/// Leaves a belief with the server for a robot's next agent. `at` is the result of the last step.
pub fn leave_belief(
    client: &mut Client,
    robot: u32,
    at: &WorldResult,
    kind: &str,
    bytes: &[u8],
) -> Result<(), ConnectionError> {
    for (index, part) in bytes.chunks(MAX_BELIEF_PART).enumerate() {
        let request = Request::LeaveBelief(LeftPart {
            lease: client.lease(),
            robot,
            episode: at.episode,
            step: at.step,
            kind: kind.into(),
            offset: (index * MAX_BELIEF_PART) as u64,
            length: bytes.len() as u64,
            data: BASE64.encode(part),
        });
        client.backend().control(&request, STEP_TIMEOUT)?;
    }
    Ok(())
}

/// Returns the belief of this kind that was left for a robot's next agent about the world's present step, if any.
pub fn left_belief(
    client: &mut Client,
    robot: u32,
    kind: &str,
) -> Result<Option<Vec<u8>>, ConnectionError> {
    let (mut first, mut bytes) = (None, Vec::new());
    loop {
        let offset = bytes.len() as u64;
        let request = Request::Belief { robot, offset };
        match client.backend().control(&request, STEP_TIMEOUT) {
            Ok(Reply::Belief { info, data, .. }) if info.kind == kind => {
                let part = BASE64.decode(data).map_err(|error| {
                    let (what, problem) = ("belief", error.to_string());
                    ConnectionError::Garbled { what, problem }
                })?;
                bytes.extend_from_slice(&part);
                let (is_last, is_whole) = (part.is_empty(), bytes.len() as u64 == info.length);
                if *first.get_or_insert_with(|| info.clone()) != info {
                    return Ok(None); // Another belief was left in the meantime.
                }
                if is_last || is_whole {
                    return Ok(is_whole.then_some(bytes));
                }
            }
            // The belief is of another kind, there is none, or the server does not know this request.
            Ok(Reply::Belief { .. }) | Err(ConnectionError::Refused { .. }) => return Ok(None),
            Ok(other) => return Err(unexpected("belief", &other)),
            Err(error) => return Err(error),
        }
    }
}
