//! Classes of connection errors to which an agent reacts differently.

use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::message::Status;

/// Returns whether the server is absent or its lock is held, so that waiting may help.
pub fn is_outage(error: &anyhow::Error) -> bool {
    error.downcast_ref().is_some_and(ConnectionError::is_away)
}

/// Returns status, detail and message of a server's refusal; `None` for other errors.
pub fn refusal(error: &anyhow::Error) -> Option<(Status, u64, &str)> {
    match error.downcast_ref()? {
        ConnectionError::Refused {
            status,
            detail,
            message,
        } => Some((*status, *detail, message)),
        _ => None,
    }
}

/// Returns whether the server refused a path because its world had already stepped.
pub fn is_late(error: &anyhow::Error) -> bool {
    refusal(error).is_some_and(|(status, ..)| status == Status::Late)
}
