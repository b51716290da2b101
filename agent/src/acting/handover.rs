//! How an agent goes on with what another believed: from the belief that it left with the server, or
//! else from the frames that the server keeps.

use crate::client::left_belief::{leave_belief, left_belief};
use anyhow::Result;
use emberwatch_learning::beliefs::Input;
use emberwatch_learning::rollout::{Rollout, Seen};
use emberwatch_protocol::Client;
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::message::Status;

/// Frames that are recalled before the lease is renewed: much less than the shortest lease takes.
const RENEW_AFTER: u64 = 500;

/// Gives an agent what is known of its world before the present frame; returns whether that frame is in it already,
/// and the belief about X_{k+1}. `number`: that of its first robot.
pub fn resume(client: &mut Client, number: u32, rollout: &mut Rollout) -> Result<bool> {
    if take_over_left(client, number, rollout)? {
        return Ok(true);
    }
    let step = rollout.step();
    if rollout.agent.policy().belief.input != Input::Frames {
        return Ok(false);
    }
    let first = first_kept(client, number, step)?;
    for past in first..step {
        if (past - first) % RENEW_AFTER == 0 {
            client.renew()?; // Recalling is no use of the lease.
        }
        if !recall(client, number, rollout, past)? {
            client.renew()?; // Says so if the robot is another's by now.
            break;
        }
    }
    if first < step {
        tracing::info!(
            robot = number,
            first,
            step,
            "going on from the frames that were kept"
        );
    }
    Ok(false)
}

/// Brings an agent that missed steps to what its world shows now; its belief is then the posterior.
pub fn catch_up(client: &mut Client, number: u32, rollout: &mut Rollout, seen: Seen) -> Result<()> {
    let missed = rollout.step() + 1..seen.observation.world.step;
    if rollout.agent.policy().belief.input == Input::Frames {
        for past in missed {
            if !recall(client, number, rollout, past)? {
                rollout.agent.predict(); // Nothing is known of what it saw, if anything.
            }
        }
    }
    rollout.see(seen)?;
    Ok(())
}

/// Gives an agent the frame of an earlier step; returns whether it is kept.
fn recall(client: &mut Client, number: u32, rollout: &mut Rollout, step: u64) -> Result<bool> {
    let Ok(seen) = client.recall(number..number + 1, step) else {
        return Ok(false);
    };
    rollout.agent.correct(&seen[0].frame, None)?;
    if step > 0 {
        rollout.agent.earn(seen[0].robot.reward);
    }
    rollout.agent.predict();
    Ok(true)
}

/// Gives an agent the belief that was left for it, if there is one; whatever it believed before is
/// forgotten.
pub fn take_over_left(
    client: &mut Client,
    number: u32,
    rollout: &mut Rollout,
) -> Result<bool, ConnectionError> {
    let step = rollout.step();
    let Some(kind) = rollout.agent.handover_kind() else {
        return Ok(false);
    };
    let Some(left) = left_belief(client, number, &kind)? else {
        return Ok(false);
    };
    let is_taken = rollout.agent.take_over(&left);
    if is_taken {
        tracing::info!(
            robot = number,
            step,
            "going on from the belief that was left"
        );
    }
    Ok(is_taken)
}

/// Leaves an agent's belief about X_{k+1}, after its last observation, to the next one of a robot.
pub fn leave(client: &mut Client, number: u32, rollout: &Rollout) -> Result<(), ConnectionError> {
    let present = rollout.observation().world;
    let agent = &rollout.agent;
    let Some((kind, bytes)) = agent.handover_kind().zip(agent.handover()) else {
        return Ok(());
    };
    match leave_belief(client, number, &present, &kind, &bytes) {
        // A server that keeps no beliefs, or none that is so long.
        Err(ConnectionError::Refused {
            status: Status::Malformed,
            message,
            ..
        }) => {
            tracing::debug!("the belief is not left: {message}");
            Ok(())
        }
        left => left,
    }
}

/// The first step from which on all frames are kept; the present one where a server keeps none.
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
