//! The errors of channels and requests.

use crate::limits::memory::NoMemory;
use crate::message::{Status, VERSION};
use emberwatch_model::text::shortened;
use std::fmt::Debug;
use std::time::Duration;
use thiserror::Error;

/// The reason why a channel could not be opened or used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ChannelError {
    #[error(
        "instance name: expected 1 to 64 letters, digits, '-' or '_', got {:?}",
        shortened(_0)
    )]
    InstanceName(String),
    #[error("channel directory {path}: {problem}")]
    Directory { path: String, problem: String },
    /// Another process held the lock of the channels' directory for too long.
    #[error(
        "channel directory {path}: expected the lock within {limit:?}, but it is still held by {holder}"
    )]
    Locked {
        path: String,
        limit: Duration,
        holder: String,
    },
    #[error(
        "no server on instance {instance:?}: start one with `emberwatch-server --instance {instance}`{}",
        .others.as_ref().map(|others| format!("; {others}")).unwrap_or_default()
    )]
    NoServer {
        instance: String,
        /// A hint at servers of other users, which cannot be reached.
        others: Option<String>,
    },
    /// The operating system does not support channels.
    #[error(
        "instance {instance:?}: attaching to a server works only on Linux, got {}; without an instance, worlds run in this \
         process on every system",
        std::env::consts::OS
    )]
    OtherSystem { instance: String },
    #[error("{}", Status::version_mismatch(VERSION, u64::from(*.version)))]
    OtherVersion { version: u32 },
    /// The server is in another PID namespace, where process ids refer to other processes.
    #[error(
        "instance {instance:?} is served from another PID namespace: run both programs in one (docker: \
         --pid=container:NAME; Kubernetes: shareProcessNamespace: true), or give each container a separate /dev/shm \
         (docker: --ipc=private)"
    )]
    OtherPidNamespace { instance: String },
    #[error("shared memory: {problem}")]
    NoRoom {
        /// What was expected, what is available, and what to do.
        problem: String,
    },
    #[error("{what}: expected at most {most} at a time, got one more")]
    NoPlace {
        what: &'static str,
        /// The maximum number, with its unit.
        most: &'static str,
    },
    #[error(
        "{what}: expected {needed} free file descriptors, got fewer (the limit is {limit}); close some, or raise the limit \
         (`ulimit -n`; docker: --ulimit nofile)"
    )]
    NoDescriptors {
        what: &'static str,
        needed: usize,
        limit: String,
    },
    #[error(
        "{call}: expected the system to allow this call, got: {problem}; allow it in the seccomp profile of the container \
         (docker: --security-opt seccomp=PROFILE), or use a newer kernel if it lacks the call"
    )]
    RefusedCall { call: &'static str, problem: String },
    /// The check set with [`crate::interrupt::interrupt_when`] ended a wait.
    #[error("interrupted")]
    Interrupted,
    /// Another copy of this library has channels in this process.
    #[error(
        "channels: expected one copy of Emberwatch's library in this process, found another one with open channels: \
         close them first, or use one process for each copy"
    )]
    AnotherCopy,
    #[error("{what}: iceoryx2 reports {problem}")]
    Ipc { what: &'static str, problem: String },
}

/// The reason why a request failed.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConnectionError {
    /// The channel could not be used.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// An answer was received, but there is too little memory for it.
    #[error(transparent)]
    Memory(#[from] NoMemory),
    /// The server ended before or during the request.
    #[error("the server on instance {instance:?} is gone")]
    ServerGone { instance: String },
    /// No answer came in time. The step may still have been taken, so observe the worlds before the next step.
    #[error("no answer to {what} from instance {instance:?} within {timeout:.1?}")]
    Timeout {
        what: &'static str,
        instance: String,
        timeout: Duration,
    },
    /// The server refused the request, and changed nothing.
    #[error("{message}")]
    Refused {
        status: Status,
        detail: u64,
        message: String,
    },
    /// An argument is out of range, or these worlds cannot meet the request. Nothing was sent or changed.
    #[error("{what}: {problem}")]
    Invalid { what: &'static str, problem: String },
    /// The answer is invalid, because the client and the server are different releases.
    #[error("answer to {what}: {problem}")]
    Garbled { what: &'static str, problem: String },
}

/// What a caller can do about an error. Clients in other languages have one exception or code for each; the numbers are
/// the codes of the C interface.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(i32)]
pub enum ErrorClass {
    /// An argument is invalid, or the worlds cannot do this.
    Invalid = -1,
    /// No server runs on the instance. Waiting may help.
    NoServer = -2,
    /// The server ended. Connect again.
    ServerGone = -3,
    /// No answer or sample came in time.
    Timeout = -4,
    /// The check for interrupts ended a wait.
    Interrupted = -5,
    /// A channel in shared memory could not be opened or used.
    Channel = -6,
    /// There is too little memory, or no thread could be started.
    Memory = -7,
    /// An answer or a sample is invalid.
    BadAnswer = -8,
    /// The server speaks another version of the protocol.
    OtherVersion = -9,
    /// The server is in another PID namespace.
    OtherPidNamespace = -10,
    /// The server refused the request.
    Refused = -11,
}

impl ConnectionError {
    pub fn class(&self) -> ErrorClass {
        match self {
            Self::Channel(channel) => channel.class(),
            Self::Memory(_) => ErrorClass::Memory,
            Self::ServerGone { .. } => ErrorClass::ServerGone,
            Self::Timeout { .. } => ErrorClass::Timeout,
            Self::Refused { .. } => ErrorClass::Refused,
            Self::Invalid { .. } => ErrorClass::Invalid,
            Self::Garbled { .. } => ErrorClass::BadAnswer,
        }
    }

    /// Returns whether the server is absent or its lock is held, so that waiting may help.
    pub fn is_away(&self) -> bool {
        matches!(
            self.class(),
            ErrorClass::NoServer | ErrorClass::ServerGone | ErrorClass::Timeout
        ) || matches!(self, Self::Channel(ChannelError::Locked { .. }))
    }
}

impl ChannelError {
    fn class(&self) -> ErrorClass {
        match self {
            Self::Interrupted => ErrorClass::Interrupted,
            Self::InstanceName(_) => ErrorClass::Invalid,
            Self::NoServer { .. } => ErrorClass::NoServer,
            Self::OtherVersion { .. } => ErrorClass::OtherVersion,
            Self::OtherPidNamespace { .. } => ErrorClass::OtherPidNamespace,
            _ => ErrorClass::Channel,
        }
    }
}

/// Checks that the status of an answer to `what` is `Ok`. `message` is the server's reason for a refusal, if it sent
/// one.
///
/// # Errors
/// [`ConnectionError::Refused`], or [`ConnectionError::Garbled`] for an unknown status.
pub fn check_status(
    what: &'static str,
    code: u32,
    detail: u64,
    message: Option<String>,
) -> Result<(), ConnectionError> {
    match Status::try_from(code) {
        Ok(Status::Ok) => Ok(()),
        Ok(status) => {
            let message = match status {
                Status::Busy => format!(
                    "busy: held by pid {detail}; wait for its release, or take over (--takeover)"
                ),
                _ => message.unwrap_or_else(|| status.explain(detail)),
            };
            Err(ConnectionError::Refused {
                status,
                detail,
                message,
            })
        }
        Err(unknown) => Err(garbled(what, unknown)),
    }
}

/// Checks that an answer has our protocol version and belongs to our request. `(got, expected)` are the sequence
/// numbers of the answer and the request.
pub fn check_answer(
    what: &'static str,
    version: u32,
    (got, expected): (u64, u64),
) -> Result<(), ConnectionError> {
    let problem = if version != VERSION {
        format!("expected version {VERSION}, got {version}")
    } else if got != expected {
        format!("expected sequence number {expected}, got {got}")
    } else {
        return Ok(());
    };
    Err(garbled(what, problem))
}

pub fn refused(status: Status, detail: u64) -> ConnectionError {
    ConnectionError::Refused {
        status,
        detail,
        message: status.explain(detail),
    }
}

pub fn garbled(what: &'static str, problem: impl ToString) -> ConnectionError {
    ConnectionError::Garbled {
        what,
        problem: problem.to_string(),
    }
}

pub fn unexpected(what: &'static str, reply: &impl Debug) -> ConnectionError {
    garbled(what, format!("expected the matching reply, got {reply:?}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clients_keep_waiting_while_a_lock_is_held() {
        let locked = ChannelError::Locked {
            path: "lock".into(),
            limit: Duration::ZERO,
            holder: "pid 1".into(),
        };
        assert!(ConnectionError::from(locked).is_away());
        let named = ChannelError::InstanceName("a b".into());
        assert!(!ConnectionError::from(named).is_away());
    }
}
