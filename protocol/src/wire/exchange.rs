//! One request and its answer: send, wait, copy the answer out of shared memory.
//!
//! A wait ends at once when the server answers or dies: a pidfd of the server is in the poll set.

use super::channels::{ChannelError, Instance, Ipc, ipc_error};
use super::cleanup::remove_leftovers;
use super::interrupt::check_interrupt;
use super::message::{Header, Status, VERSION};
use super::process::WatchedProcess;
use super::wait::{Waiter, descriptor, drain, sleep_until_readable};
use crate::limits::memory::{NoMemory, with_capacity};
use iceoryx2::node::Node;
use iceoryx2::pending_response::PendingResponse;
use iceoryx2::port::client::{Client, RequestSendError};
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use std::time::{Duration, Instant};
use thiserror::Error;

/// Longest sleep between two looks at the answer: bounds what a lost wake-up can cost.
const LONGEST_SLEEP: Duration = Duration::from_millis(50);

/// How long the answering side may take to release a request that was given up.
const RELEASE_TIMEOUT: Duration = Duration::from_millis(500);

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

/// What a request and its answer need: both ends of waking, and the server's process.
pub(super) struct Exchange {
    pub(super) instance: Instance,
    pub(super) server: Notifier<Ipc>,
    pub(super) listener: Listener<Ipc>,
    pub(super) server_process: WatchedProcess,
    pub(super) waiter: Waiter,
    pub(super) node: Node<Ipc>,
}

impl Exchange {
    pub(super) fn listener_id(&self) -> (u64, u64) {
        let id = self.listener.id().value();
        (id as u64, (id >> 64) as u64)
    }

    /// Sends one request and waits for its answer, which `read` copies out of shared memory.
    pub(super) fn request<Q: Header, R: Header, T>(
        &self,
        client: &Client<Ipc, [u8], Q, [u8], R>,
        header: Q,
        payload: &[u8],
        what: &'static str,
        timeout: Duration,
        read: impl Fn(&R, &[u8]) -> T,
    ) -> Result<T, ConnectionError> {
        if self.server_process.has_ended() {
            // A new server on the instance would take the request, but knows nothing of it.
            return Err(self.server_gone());
        }
        let pending = send(client, header, payload)?;
        if pending.number_of_server_connections() == 0 {
            return Err(self.server_gone());
        }
        self.server.notify().map_err(ipc_error("wake the server"))?;
        self.answer(&pending, timeout, read)?
            .ok_or_else(|| ConnectionError::Timeout {
                what,
                instance: self.instance.name().into(),
                timeout,
            })
    }

    fn answer<Q: Header, R: Header, T>(
        &self,
        pending: &Pending<Q, R>,
        timeout: Duration,
        read: impl Fn(&R, &[u8]) -> T,
    ) -> Result<Option<T>, ConnectionError> {
        let has_ended = std::cell::Cell::new(false);
        let poll = || match pending.receive().map_err(ipc_error("receive an answer"))? {
            Some(response) => Ok(Some(read(response.user_header(), response.payload()))),
            None if has_ended.get() => Err(self.server_gone()),
            None => Ok(None),
        };
        self.waiter.wait(timeout, poll, |remaining| {
            let [is_woken, is_over] = self.sleep(remaining.min(LONGEST_SLEEP))?;
            has_ended.set(is_over || !pending.is_connected());
            if !is_woken {
                check_interrupt()?;
            }
            Ok(())
        })
    }

    /// Sleeps until woken; returns whether it was woken, and whether the server has ended.
    fn sleep(&self, timeout: Duration) -> Result<[bool; 2], ChannelError> {
        let descriptors = [descriptor(&self.listener), self.server_process.descriptor()];
        let readable = sleep_until_readable(&descriptors, timeout)
            .map_err(ipc_error("wait for the server"))?;
        // Wake-ups that are left would end the next sleep at once.
        drain(&self.listener)?;
        Ok([readable[0], readable[1]])
    }

    /// The error of a server that has ended; removes the files it left.
    pub(super) fn server_gone(&self) -> ConnectionError {
        let _ = remove_leftovers(); // Else the next program removes them.
        ConnectionError::ServerGone {
            instance: self.instance.name().into(),
        }
    }
}

/// A request that waits for its answer.
type Pending<Q, R> = PendingResponse<Ipc, [u8], Q, [u8], R>;

/// Sends a request, once the one before is released.
fn send<Q: Header, R: Header>(
    client: &Client<Ipc, [u8], Q, [u8], R>,
    header: Q,
    payload: &[u8],
) -> Result<Pending<Q, R>, ChannelError> {
    let start = Instant::now();
    loop {
        let request = client.loan_slice_uninit(payload.len());
        let mut request = request.map_err(ipc_error("send a request"))?;
        *request.user_header_mut() = header;
        match request.write_from_slice(payload).send() {
            Err(RequestSendError::ExceedsMaxActiveRequests)
                if start.elapsed() < RELEASE_TIMEOUT =>
            {
                std::thread::sleep(Duration::from_millis(5));
            }
            sent => return sent.map_err(ipc_error("send a request")),
        }
    }
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
pub(super) fn check_answer(
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

/// A copy of an answer's payload.
pub(super) fn copied(what: &str, payload: &[u8]) -> Result<Vec<u8>, NoMemory> {
    let mut copy = with_capacity(format_args!("the answer to {what}"), payload.len())?;
    copy.extend_from_slice(payload);
    Ok(copy)
}

/// The error of an answer that makes no sense.
pub(super) fn garbled(what: &'static str, problem: impl ToString) -> ConnectionError {
    ConnectionError::Garbled {
        what,
        problem: problem.to_string(),
    }
}
