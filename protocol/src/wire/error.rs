//! Why a channel could not be opened or used.

use super::message::VERSION;
use iceoryx2::service::ipc_threadsafe;
use std::time::Duration;
use thiserror::Error;

/// iceoryx2's inter-process flavour whose ports may move between threads.
pub type Ipc = ipc_threadsafe::Service;

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
    /// The check of [`super::interrupt::interrupt_when`] ended a wait.
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
