//! Classes of connection errors to which an agent reacts differently.

use emberwatch_protocol::channels::ChannelError;
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::message::Status;

/// Returns whether the server is absent or its lock is held, so that waiting may help.
pub fn is_away(error: &ConnectionError) -> bool {
    match error {
        ConnectionError::ServerGone { .. } | ConnectionError::Timeout { .. } => true,
        ConnectionError::Channel(channel) => matches!(
            channel,
            ChannelError::NoServer { .. } | ChannelError::Locked { .. }
        ),
        _ => false,
    }
}

/// Like [`is_away`], for any error.
pub fn is_outage(error: &anyhow::Error) -> bool {
    error.downcast_ref().is_some_and(is_away)
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

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn agents_keep_waiting_while_a_lock_is_held() {
        let locked = ChannelError::Locked {
            path: "lock".into(),
            limit: Duration::ZERO,
            holder: "pid 1".into(),
        };
        assert!(is_away(&locked.into()));
        assert!(!is_away(&ChannelError::InstanceName("a b".into()).into()));
    }
}
