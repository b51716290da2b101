//! Connections of this program, and requests that need no lease.

use emberwatch_acting::learned::{Learned, WorldNames};
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::client::STEP_TIMEOUT;
use emberwatch_protocol::connection::{ConnectionError, unexpected};
use emberwatch_protocol::control::{Reply, Request, ServerInfo};
use emberwatch_protocol::task::Task;
use emberwatch_protocol::{Connection, Model};
use std::time::Duration;

const NAME: &str = concat!("emberwatch-agent ", env!("CARGO_PKG_VERSION"));

/// Time between two attempts to reach an absent server.
pub const RETRY_INTERVAL: Duration = Duration::from_millis(200);

pub fn connect(instance: &Instance) -> Result<Connection, ConnectionError> {
    Connection::open(instance, NAME, STEP_TIMEOUT)
}

/// Waits up to `limit` until an instance has a server, and logs the wait once. Returns false once `is_over` is true.
pub fn wait_for_server(
    instance: &Instance,
    limit: Duration,
    is_over: impl Fn() -> bool,
) -> Result<bool, ConnectionError> {
    let mut is_logged = false;
    let opened = Connection::open_within(instance, NAME, (limit, STEP_TIMEOUT), |error| {
        if !is_logged {
            tracing::info!("{error}; waiting up to {limit:?}");
        }
        is_logged = true;
        !is_over()
    });
    match opened {
        Ok(_) => Ok(!is_over()),
        Err(_) if is_over() => Ok(false),
        Err(error) => Err(error),
    }
}

/// Returns whether a belief of this kind about the present step was left for a robot's next agent. Needs no lease.
pub fn is_belief_left(
    instance: &Instance,
    robot: u32,
    kind: &str,
) -> Result<bool, ConnectionError> {
    let mut connection = connect(instance)?;
    let request = Request::Belief { robot, offset: 0 };
    match connection.control(&request, STEP_TIMEOUT) {
        Ok(Reply::Belief { info, .. }) => Ok(info.kind == kind),
        Ok(other) => Err(unexpected("belief", &other)),
        Err(ConnectionError::Refused { .. }) => Ok(false),
        Err(error) => Err(error),
    }
}

/// Returns what the worlds of a server are called. Of a task's worlds, the model's name is known even if the server
/// hides the model. Recorded worlds are called as their description.
pub fn world_names(info: &ServerInfo) -> WorldNames {
    let task = info
        .task
        .as_deref()
        .filter(|_| info.recorded_world.is_none());
    let task = || task.and_then(|name| Task::named(name).ok());
    let of_task = || task().map(|task| task.world.model);
    let revealed = info.revealed_model().map(|it| it.name().into());
    WorldNames {
        model: revealed.or_else(|| of_task().filter(|name| Model::built_in(name).is_some())),
        observations: info.observations.clone(),
    }
}

/// Warns if a checkpoint was learned in other worlds than a server has.
pub fn warn_of_other_worlds(learned: &Learned, info: &ServerInfo) {
    if let Some(warning) = learned.warning_in(&world_names(info)) {
        tracing::warn!("{warning}");
    }
}
