//! How an agent takes over from a former agent: from the belief that the former agent left with the server, or
//! otherwise from the frames that the server keeps.

use anyhow::Result;
use emberwatch_acting::beliefs::Input;
use emberwatch_acting::rollout::{ActingAgent, AgentObservation};
use emberwatch_protocol::Client;
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::message::Status;

/// Number of frames to recall before the lease is renewed. Recalling them takes much less time than any lease lasts.
const RENEW_AFTER: u64 = 500;

/// Restores an agent's belief from the belief or the frames that the server keeps. Returns true if the belief already
/// includes the present frame, so that it describes X_{k+1}. `number` is the server's number of the agent's first
/// robot.
pub fn resume(client: &mut Client, number: u32, acting: &mut ActingAgent) -> Result<bool> {
    if take_over_left(client, number, acting)? {
        return Ok(true);
    }
    let step = acting.step();
    if acting.agent.policy().belief.input != Input::Frames {
        return Ok(false);
    }
    let first = first_kept(client, number, step)?;
    for past in first..step {
        if (past - first) % RENEW_AFTER == 0 {
            client.renew()?; // Recalling does not renew the lease.
        }
        if !recall(client, number, acting, past)? {
            client.renew()?; // Fails if another client has taken the robot.
            break;
        }
    }
    if first < step {
        tracing::info!(
            robot = number,
            first,
            step,
            "the belief was restored from the frames that the server keeps"
        );
    }
    Ok(false)
}

/// Updates the belief of an agent with the frames that it missed and the present one, to the posterior.
pub fn catch_up(
    client: &mut Client,
    number: u32,
    acting: &mut ActingAgent,
    seen: AgentObservation,
) -> Result<()> {
    let missed = acting.step() + 1..seen.observation.world.step;
    if acting.agent.policy().belief.input == Input::Frames {
        for past in missed {
            if !recall(client, number, acting, past)? {
                acting.agent.predict(); // The server has not kept the step's frame.
            }
        }
    }
    acting.see(seen)?;
    Ok(())
}

/// Updates an agent's belief with the frame of an earlier step. Returns false if the server has not kept the frame.
fn recall(client: &mut Client, number: u32, acting: &mut ActingAgent, step: u64) -> Result<bool> {
    let Ok(seen) = client.recall(number..number + 1, step) else {
        return Ok(false);
    };
    acting.agent.correct(&seen[0].frame, None)?;
    if step > 0 {
        acting.agent.earn(seen[0].robot.reward);
    }
    acting.agent.predict();
    Ok(true)
}

/// Replaces an agent's belief with the belief that was left for it. Returns false if no suitable belief was left.
pub fn take_over_left(
    client: &mut Client,
    number: u32,
    acting: &mut ActingAgent,
) -> Result<bool, ConnectionError> {
    let step = acting.step();
    let Some(kind) = acting.agent.handover_kind() else {
        return Ok(false);
    };
    let left = match client.left_belief(number, &kind) {
        Ok(Some(left)) => left,
        Ok(None) | Err(ConnectionError::Refused { .. }) => return Ok(false),
        Err(error) => return Err(error),
    };
    let is_taken = acting.agent.take_over(&left);
    if is_taken {
        tracing::info!(
            robot = number,
            step,
            "the belief was taken over from the former agent"
        );
    }
    Ok(is_taken)
}

/// Leaves an agent's belief, a prediction of X_{k+1}, for the robot's next agent.
pub fn leave(
    client: &mut Client,
    number: u32,
    acting: &ActingAgent,
) -> Result<(), ConnectionError> {
    let present = acting.observation().world;
    let agent = &acting.agent;
    let Some((kind, bytes)) = agent.handover_kind().zip(agent.handover()) else {
        return Ok(());
    };
    match client.leave_belief(number, &present, &kind, &bytes) {
        // The server keeps no beliefs, or the belief is too long for it.
        Err(ConnectionError::Refused {
            status: Status::Malformed,
            message,
            ..
        }) => {
            tracing::debug!("the server does not keep the belief: {message}");
            Ok(())
        }
        left => left,
    }
}

/// Returns the first step from which the server keeps all frames, or the present step if it keeps none.
fn first_kept(client: &mut Client, number: u32, step: u64) -> Result<u64, ConnectionError> {
    match client.recall(number..number + 1, 0) {
        Ok(_) => Ok(0),
        Err(ConnectionError::Refused { status, detail, .. }) => match status {
            Status::NotKept => Ok(detail.min(step)),
            _ => Ok(step),
        },
        Err(error) => Err(error),
    }
}
