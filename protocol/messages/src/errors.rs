//! Why a channel could not be opened or used, and why a request got no good answer.

use crate::limits::memory::NoMemory;
use crate::message::{Status, VERSION};
use std::fmt::Debug;
use std::time::Duration;
use thiserror::Error;

/// Why a channel could not be opened or used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ChannelError {
    /// A name that cannot be an instance's.
    #[error("instance name: expected 1 to 64 letters, digits, '-' or '_', got {0:?}")]
    InstanceName(String),
    /// The directory for the channels' files cannot be used.
    #[error("channel directory {path}: {problem}")]
    Directory {
        /// The directory, or the file in it.
        path: String,
        /// What was expected, and what is there.
        problem: String,
    },
    /// Another process had the lock of the channels' directory for too long.
    #[error(
        "channel directory {path}: expected the lock within {limit:?}, got it held by {holder}"
    )]
    Locked {
        /// The lock's file.
        path: String,
        /// How long it was waited for.
        limit: Duration,
        /// Who has it.
        holder: String,
    },
    /// No server runs on the instance.
    #[error(
        "no server on instance {instance:?}: start one with `emberwatch-server --instance {instance}`"
    )]
    NoServer {
        /// Name of the instance.
        instance: String,
    },
    /// This system has no channels.
    #[error(
        "instance {instance:?}: servers are attached to on Linux only, got {}; without an instance, worlds run in this \
         process on every system",
        std::env::consts::OS
    )]
    OtherSystem {
        /// Name of the instance.
        instance: String,
    },
    /// A server runs on the instance, but it speaks another version of the protocol.
    #[error(
        "protocol version mismatch: the client speaks {VERSION}, the server {version}; use a client and a server of one \
         release"
    )]
    OtherVersion {
        /// What the server speaks.
        version: u32,
    },
    /// Its server is in another PID namespace, where process ids mean other processes.
    #[error(
        "instance {instance:?} is served from another PID namespace: run both programs in one (docker: \
         --pid=container:NAME; Kubernetes: shareProcessNamespace: true), or give each container a /dev/shm of its own \
         (docker: --ipc=private)"
    )]
    OtherPidNamespace {
        /// Name of the instance.
        instance: String,
    },
    /// There is too little shared memory.
    #[error("shared memory: {problem}")]
    NoRoom {
        /// What was expected, what there is, and what to do.
        problem: String,
    },
    /// All places that a channel has are taken.
    #[error("{what}: expected at most {most} at a time, got one more")]
    NoPlace {
        /// What was attempted.
        what: &'static str,
        /// How many there may be of whom.
        most: &'static str,
    },
    /// The process may open no more files.
    #[error(
        "{what}: expected {needed} file descriptors, got fewer of the limit of {limit}; close some, or raise the limit \
         (`ulimit -n`; docker: --ulimit nofile)"
    )]
    NoDescriptors {
        /// What was attempted.
        what: &'static str,
        /// How many it takes.
        needed: usize,
        /// How many the process may have.
        limit: String,
    },
    /// The system refuses a call that channels need, as a container's seccomp profile does.
    #[error(
        "{call}: expected the system to allow this call, got: {problem}; allow it in the seccomp profile of the container \
         (docker: --security-opt seccomp=PROFILE), or use a newer kernel if it lacks the call"
    )]
    RefusedCall {
        /// The system call.
        call: &'static str,
        /// The system's words.
        problem: String,
    },
    /// The check of [`crate::interrupt::interrupt_when`] ended a wait.
    #[error("interrupted")]
    Interrupted,
    /// iceoryx2 refused.
    #[error("{what}: iceoryx2 says {problem}")]
    Ipc {
        /// What was attempted.
        what: &'static str,
        /// iceoryx2's reason.
        problem: String,
    },
}

/// Why a request got no good answer.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConnectionError {
    /// The channel could not be used.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// There is too little memory for the answer, which has come.
    #[error(transparent)]
    Memory(#[from] NoMemory),
    /// The server ended while, or before, it was asked.
    #[error("the server on instance {instance:?} is gone")]
    ServerGone {
        /// Name of the instance.
        instance: String,
    },
    /// No answer in time. A step may have been made nevertheless: observe before the next one.
    #[error("no answer to {what} from instance {instance:?} within {timeout:.1?}")]
    Timeout {
        /// Kind of the request.
        what: &'static str,
        /// Name of the instance.
        instance: String,
        /// How long the client waited.
        timeout: Duration,
    },
    /// The server refused, and changed nothing.
    #[error("{message}")]
    Refused {
        /// Reason for programs.
        status: Status,
        /// See [`Status`].
        detail: u64,
        /// Reason for people.
        message: String,
    },
    /// The answer makes no sense: client and server are not of one release.
    #[error("answer to {what}: {problem}")]
    Garbled {
        /// Kind of the request.
        what: &'static str,
        /// What is wrong with the answer.
        problem: String,
    },
}

/// Checks that the status of an answer to `what` is `Ok`; `message` is that of the refusal, if it has one.
///
/// # Errors
/// [`ConnectionError::Refused`], or [`ConnectionError::Garbled`] for a status that is unknown.
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
                // Names the flag of the commands that connect this way; not all of them have it.
                Status::Busy => format!(
                    "busy: held by pid {detail}; wait for its release, or take over with the flag \
                     --takeover of `emberwatch-agent run`"
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

/// Checks that an answer is of our version and to our request: `(got, expected)` sequence numbers.
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

/// The refusal that a server would give.
pub fn refused(status: Status, detail: u64) -> ConnectionError {
    ConnectionError::Refused {
        status,
        detail,
        message: status.explain(detail),
    }
}

/// The error of an answer that makes no sense.
pub fn garbled(what: &'static str, problem: impl ToString) -> ConnectionError {
    ConnectionError::Garbled {
        what,
        problem: problem.to_string(),
    }
}

/// The error for a reply that answers another question.
pub fn unexpected(what: &'static str, reply: &impl Debug) -> ConnectionError {
    garbled(what, format!("got the reply to something else: {reply:?}"))
}
