//! What a server tells without a lease, from connections of their own.

use crate::server::client::{CLIENT_NAME, STEP_TIMEOUT};
use crate::server::errors::is_away;
use protocol::Connection;
use protocol::channels::Instance;
use protocol::connection::{ConnectionError, unexpected};
use protocol::control::{Reply, Request, ServerInfo};
use std::time::{Duration, Instant};

/// How long to wait between attempts to reach a server that is away.
pub const RETRY_INTERVAL: Duration = Duration::from_millis(200);

/// What a server says of itself, from a connection of its own.
pub fn server_info(instance: &Instance) -> Result<ServerInfo, ConnectionError> {
    let connection = Connection::open(instance, CLIENT_NAME, STEP_TIMEOUT)?;
    Ok(connection.info().clone())
}

/// Waits until an instance has a server, and says so once if that is not at once; returns whether it has
/// one: not once `is_over`.
pub fn wait_for_server(
    instance: &Instance,
    limit: Duration,
    is_over: impl Fn() -> bool,
) -> Result<bool, ConnectionError> {
    let (start, mut is_told) = (Instant::now(), false);
    while !is_over() {
        match server_info(instance) {
            Ok(_) => return Ok(true),
            Err(error) if is_away(&error) && start.elapsed() < limit => {
                if !is_told {
                    tracing::info!("{error}; waiting for it, {limit:?} at most");
                }
                is_told = true;
            }
            Err(error) => return Err(error),
        }
        let left = limit.saturating_sub(start.elapsed());
        std::thread::sleep(RETRY_INTERVAL.min(left));
    }
    Ok(false)
}

/// Whether a belief of a kind was left for a robot's agent about its world as it stands; needs no lease.
pub fn is_belief_left(
    instance: &Instance,
    robot: u32,
    kind: &str,
) -> Result<bool, ConnectionError> {
    let mut connection = Connection::open(instance, CLIENT_NAME, STEP_TIMEOUT)?;
    let request = Request::Belief { robot, offset: 0 };
    match connection.control(&request, STEP_TIMEOUT) {
        Ok(Reply::Belief { info, .. }) => Ok(info.kind == kind),
        Ok(other) => Err(unexpected("belief", &other)),
        Err(ConnectionError::Refused { .. }) => Ok(false),
        Err(error) => Err(error),
    }
}
