//! How an agent goes on with what another believed: from the belief that it left with the server, or
//! else from the frames that the server keeps.

use crate::rollout::Robot;
use crate::server::client::Client;
use anyhow::Result;
use protocol::connection::ConnectionError;
use protocol::message::Status;

/// Frames that are recalled before the lease is renewed: much less than the shortest lease takes.
const RENEW_AFTER: u64 = 500;

/// Gives a robot's agent what is known of its world before the present frame; returns whether that frame is in
/// it already, and the belief about X_{k+1}.
pub fn resume(client: &mut Client, world: u32, robot: &mut Robot) -> Result<bool> {
    if take_over_left(client, world, robot)? {
        return Ok(true);
    }
    let step = robot.observation().result.step;
    let agent = &mut robot.agent;
    if !agent.estimator().sees_frames() {
        return Ok(false);
    }
    let first = first_kept(client, world, step)?;
    for past in first..step {
        if (past - first) % RENEW_AFTER == 0 {
            client.renew()?; // Recalling is no use of the lease.
        }
        let Ok(mut seen) = client.recall(world..world + 1, past) else {
            client.renew()?; // Says so if the world is another's by now.
            break;
        };
        let seen = seen.remove(0);
        agent.correct(&seen.frame, None)?;
        agent.predict();
    }
    if first < step {
        tracing::info!(
            world,
            first,
            step,
            "going on from the frames that were kept"
        );
    }
    Ok(false)
}

/// Gives an agent the belief that was left for it, if there is one; whatever it believed before is
/// forgotten.
pub fn take_over_left(
    client: &mut Client,
    world: u32,
    robot: &mut Robot,
) -> Result<bool, ConnectionError> {
    let step = robot.observation().result.step;
    let estimator = robot.agent.estimator_mut();
    let Some(kind) = estimator.kind() else {
        return Ok(false);
    };
    let Some(memory) = client.belief(world, &kind)? else {
        return Ok(false);
    };
    let is_taken = estimator.remember(&memory);
    if is_taken {
        tracing::info!(world, step, "going on from the belief that was left");
    }
    Ok(is_taken)
}

/// Leaves an agent's belief about X_{k+1}, after its last observation, to the next one.
pub fn leave(client: &mut Client, world: u32, robot: &Robot) -> Result<(), ConnectionError> {
    let (agent, present) = (&robot.agent, robot.observation());
    let Some(kind) = agent.estimator().kind() else {
        return Ok(());
    };
    match client.leave_belief(world, &present.result, &kind, &agent.estimator().memory()) {
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
fn first_kept(client: &mut Client, world: u32, step: u64) -> Result<u64, ConnectionError> {
    match client.recall(world..world + 1, 0) {
        Ok(_) => Ok(0),
        Err(ConnectionError::Refused { status, detail, .. }) => match status {
            Status::NotKept => Ok(detail.min(step)),
            _ => Ok(step),
        },
        Err(error) => Err(error),
    }
}
