//! What the errors of connections mean to an agent.

use emberwatch_protocol::channels::ChannelError;
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::message::Status;

/// Whether a server is away, or the way to it is busy, and it may come.
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

/// Whether something failed because a server is away that may come back.
pub fn is_outage(error: &anyhow::Error) -> bool {
    error.downcast_ref().is_some_and(is_away)
}

/// Status, detail and message, if something failed because a server refused.
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

/// Whether something failed because a world moved on before a path for it came.
pub fn is_late(error: &anyhow::Error) -> bool {
    refusal(error).is_some_and(|(status, ..)| status == Status::Late)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn agents_wait_on_while_a_lock_is_held() {
        let locked = ChannelError::Locked {
            path: "lock".into(),
            limit: Duration::ZERO,
            holder: "pid 1".into(),
        };
        assert!(is_away(&locked.into()));
        assert!(!is_away(&ChannelError::InstanceName("a b".into()).into()));
    }
}
