//! A client's side of `step` and `control`: one request at a time, each with a deadline.
//!
//! Blocking waits end at once when the server answers or dies (a pidfd of the server is in the poll
//! set). Nothing returned points into shared memory.

use crate::channels::{
    Channel, ChannelError, Instance, Ipc, RequestResponse, Services, create_node, ipc_error,
};
use crate::cleanup::remove_leftovers;
use crate::control::{Reply, Request, ServerInfo};
use crate::message::split_step_payload;
use crate::message::{
    ControlReply, ControlRequest, Header, Status, StepReply, StepRequest, StepResult, VERSION,
};
use crate::turn::Turn;
use crate::wait::{Waiter, descriptor, drain, is_readable, sleep_until_readable};
use iceoryx2::node::Node;
use iceoryx2::pending_response::PendingResponse;
use iceoryx2::port::client::Client;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::{AllocationStrategy, CallbackProgression, PortFactory};
use rustix::process::{Pid, PidfdFlags, pidfd_open};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::time::Duration;
use thiserror::Error;

/// Longest sleep between two looks at the answer: bounds what a lost wake-up can cost.
const LONGEST_SLEEP: Duration = Duration::from_millis(50);

/// Length that control requests may have before their segment grows, bytes.
const CONTROL_SLICE: usize = 4096;

/// Why a request got no good answer.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConnectionError {
    /// The channel could not be used.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// The server ended while, or before, it was asked.
    #[error("the server on instance {instance:?} is gone")]
    ServerGone {
        /// The instance.
        instance: String,
    },
    /// No answer in time. A step may have been made all the same: observe before stepping again.
    #[error("no answer to {what} from instance {instance:?} within {timeout:?}")]
    Timeout {
        /// What was asked.
        what: &'static str,
        /// The instance.
        instance: String,
        /// How long it was waited for.
        timeout: Duration,
    },
    /// The server refused, and changed nothing.
    #[error("{message}")]
    Refused {
        /// Why.
        status: Status,
        /// See [`Status`].
        detail: u64,
        /// One sentence.
        message: String,
    },
    /// The answer makes no sense: client and server are not of one release.
    #[error("answer to {what}: {problem}")]
    Garbled {
        /// What was asked.
        what: &'static str,
        /// What is wrong with the answer.
        problem: String,
    },
}

/// The answer to a step: results and frames of consecutive worlds.
#[derive(Debug, Clone, PartialEq)]
pub struct StepAnswer {
    /// The binary header.
    pub reply: StepReply,
    /// One result per world.
    pub results: Vec<StepResult>,
    /// The frames, `H * W` bytes per world.
    pub frames: Vec<u8>,
}

/// A connection to a running server.
pub struct Connection {
    step: Client<Ipc, [u8], StepRequest, [u8], StepReply>,
    control: Client<Ipc, [u8], ControlRequest, [u8], ControlReply>,
    wake: Wake,
    info: ServerInfo,
    sequence: u64,
    /// Last, so that the ports are dropped within it.
    end: Option<Turn>,
}

impl Drop for Connection {
    fn drop(&mut self) {
        self.end = Turn::take().ok();
    }
}

/// Both ends of waking, and the server's life.
struct Wake {
    instance: Instance,
    server: Notifier<Ipc>,
    listener: Listener<Ipc>,
    server_process: OwnedFd,
    waiter: Waiter,
    _node: Node<Ipc>,
}

impl Connection {
    /// Connects to the instance's server and shakes hands; `client` names this program in its log.
    ///
    /// # Errors
    /// [`ChannelError::NoServer`] if nobody serves the instance, a refusal if the server speaks
    /// another version, a timeout if it does not answer.
    pub fn open(
        instance: &Instance,
        client: &str,
        timeout: Duration,
    ) -> Result<Self, ConnectionError> {
        let mut turn = Some(Turn::take()?); // declared first: what fails below is dropped within it
        let node = create_node()?;
        let services = Services {
            node: &node,
            instance,
        };
        let control_service = services.open_control()?;
        let step_service = services.open_step()?;
        let server_process =
            server_process(&control_service).ok_or_else(|| instance.no_server())?;
        let server = services
            .wake(Channel::WakeServer)?
            .notifier_builder()
            .create()
            .map_err(ipc_error("create a notifier"))?;
        let listener = services.listener(Channel::WakeClient)?;
        let control = control_service
            .client_builder()
            .initial_max_slice_len(CONTROL_SLICE);
        let control = control
            .allocation_strategy(AllocationStrategy::PowerOfTwo)
            .create();
        let control = control.map_err(ipc_error(
            "create a control client (are there more than 16 clients?)",
        ))?;
        let mut wake = Wake {
            instance: instance.clone(),
            server,
            listener,
            server_process,
            waiter: Waiter::default(),
            _node: node,
        };
        drop(turn.take());
        let info = shake_hands(&control, &mut wake, client, timeout);
        turn = Some(Turn::take()?);
        let info = info?;
        let longest = info.n_worlds as usize * info.n_moves;
        let step = step_service
            .client_builder()
            .initial_max_slice_len(longest.max(1))
            .create();
        let step = step.map_err(ipc_error(
            "create a step client (are there more than 16 clients?)",
        ))?;
        drop(turn);
        Ok(Self {
            step,
            control,
            wake,
            info,
            sequence: 1,
            end: None,
        })
    }

    /// What the server said of itself.
    pub fn info(&self) -> &ServerInfo {
        &self.info
    }

    /// The server's process: readable when it has ended.
    pub fn server_process(&self) -> BorrowedFd<'_> {
        self.wake.server_process.as_fd()
    }

    /// Looks whether the server lives, without asking it.
    ///
    /// # Errors
    /// [`ConnectionError::ServerGone`] if its process has ended.
    pub fn check_server(&self) -> Result<(), ConnectionError> {
        if is_readable(self.server_process()) {
            return Err(self.wake.gone());
        }
        Ok(())
    }

    /// Asks on the control channel.
    ///
    /// # Errors
    /// A refusal by the server, or [`ConnectionError`] if there is no good answer in time.
    pub fn control(
        &mut self,
        request: &Request,
        timeout: Duration,
    ) -> Result<Reply, ConnectionError> {
        self.sequence += 1;
        ask(
            &self.control,
            &mut self.wake,
            self.sequence,
            request,
            timeout,
        )
    }

    /// Asks on the step channel; version, sequence and listener are filled in here.
    ///
    /// # Errors
    /// A refusal by the server, or [`ConnectionError`] if there is no good answer in time.
    pub fn step(
        &mut self,
        request: StepRequest,
        paths: &[u8],
        timeout: Duration,
    ) -> Result<StepAnswer, ConnectionError> {
        const WHAT: &str = "step";
        self.sequence += 1;
        let (listener_low, listener_high) = self.wake.listener_id();
        let header = StepRequest {
            version: VERSION,
            sequence: self.sequence,
            listener_low,
            listener_high,
            ..request
        };
        let (reply, answer) = self.wake.exchange(
            &self.step,
            header,
            paths,
            WHAT,
            timeout,
            |reply, payload| {
                let parts = split_step_payload(reply, payload);
                (
                    *reply,
                    parts.map(|(results, frames)| (results, frames.to_vec())),
                )
            },
        )?;
        refuse(WHAT, reply.status, reply.detail, None)?;
        check_answer(WHAT, reply.version, (reply.sequence, self.sequence))?;
        let (results, frames) = answer.map_err(|expected| ConnectionError::Garbled {
            what: WHAT,
            problem: format!("expected a payload of {expected} bytes"),
        })?;
        Ok(StepAnswer {
            reply,
            results,
            frames,
        })
    }
}

impl Wake {
    fn listener_id(&self) -> (u64, u64) {
        let id = self.listener.id().value();
        (id as u64, (id >> 64) as u64)
    }

    /// Sends one request and waits for its answer, which `read` copies out of shared memory.
    fn exchange<Q: Header, R: Header, T>(
        &self,
        client: &Client<Ipc, [u8], Q, [u8], R>,
        header: Q,
        payload: &[u8],
        what: &'static str,
        timeout: Duration,
        read: impl Fn(&R, &[u8]) -> T,
    ) -> Result<T, ConnectionError> {
        let mut request = client
            .loan_slice_uninit(payload.len())
            .map_err(ipc_error("send a request"))?;
        *request.user_header_mut() = header;
        let pending = request
            .write_from_slice(payload)
            .send()
            .map_err(ipc_error("send a request"))?;
        if pending.number_of_server_connections() == 0 {
            return Err(self.gone());
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
        pending: &PendingResponse<Ipc, [u8], Q, [u8], R>,
        timeout: Duration,
        read: impl Fn(&R, &[u8]) -> T,
    ) -> Result<Option<T>, ConnectionError> {
        let gone = std::cell::Cell::new(false);
        let poll = || match pending.receive().map_err(ipc_error("receive an answer"))? {
            Some(response) => Ok(Some(read(response.user_header(), response.payload()))),
            None if gone.get() => Err(self.gone()),
            None => Ok(None),
        };
        self.waiter.wait(timeout, poll, |remaining| {
            gone.set(self.sleep(remaining.min(LONGEST_SLEEP))? || !pending.is_connected());
            Ok(())
        })
    }

    /// Sleeps until woken; returns whether the server has ended.
    fn sleep(&self, timeout: Duration) -> Result<bool, ChannelError> {
        let descriptors = [descriptor(&self.listener), self.server_process.as_fd()];
        let readable = sleep_until_readable(&descriptors, timeout)
            .map_err(ipc_error("wait for the server"))?;
        // Not later: what is left ends the next sleep at once.
        drain(&self.listener)?;
        Ok(readable[1])
    }

    /// The error of a server that has ended; clears away what it left.
    fn gone(&self) -> ConnectionError {
        let _ = remove_leftovers(); // What stays is removed by the next program.
        ConnectionError::ServerGone {
            instance: self.instance.name().into(),
        }
    }
}

/// A handle on the server's process; `None` if it has ended.
fn server_process<Q: Header, R: Header>(service: &RequestResponse<Q, R>) -> Option<OwnedFd> {
    let pid = Pid::from_raw(server_pid(service)?)?;
    let process = pidfd_open(pid, PidfdFlags::empty()).ok()?;
    (!is_readable(process.as_fd())).then_some(process)
}

/// The process id of the service's server, running or dead.
pub fn server_pid<Q: Header, R: Header>(service: &RequestResponse<Q, R>) -> Option<i32> {
    let mut pid = None;
    service.dynamic_config().list_servers(|server| {
        pid = server.node_id.pid::<Ipc>().ok().map(|id| id.value());
        CallbackProgression::Stop
    });
    pid
}

fn shake_hands(
    control: &Client<Ipc, [u8], ControlRequest, [u8], ControlReply>,
    wake: &mut Wake,
    client: &str,
    timeout: Duration,
) -> Result<ServerInfo, ConnectionError> {
    let hello = Request::Hello {
        protocol: VERSION,
        client: client.into(),
    };
    match ask(control, wake, 1, &hello, timeout)? {
        Reply::Hello(info) => Ok(*info),
        other => Err(unexpected("hello", &other)),
    }
}

fn ask(
    client: &Client<Ipc, [u8], ControlRequest, [u8], ControlReply>,
    wake: &mut Wake,
    sequence: u64,
    request: &Request,
    timeout: Duration,
) -> Result<Reply, ConnectionError> {
    const WHAT: &str = "a control request";
    let text = serde_json::to_vec(request).expect("invariant: requests serialise");
    let (listener_low, listener_high) = wake.listener_id();
    let header = ControlRequest {
        version: VERSION,
        reserved: 0,
        sequence,
        listener_low,
        listener_high,
    };
    let (reply, payload) =
        wake.exchange(client, header, &text, WHAT, timeout, |reply, payload| {
            (*reply, payload.to_vec())
        })?;
    check_answer(WHAT, reply.version, (reply.sequence, sequence))?;
    let parsed = serde_json::from_slice(&payload);
    let message = match &parsed {
        Ok(Reply::Error {
            message, detail, ..
        }) => Some((*detail, message.clone())),
        _ => None,
    };
    let detail = message.as_ref().map_or(0, |(detail, _)| *detail);
    refuse(WHAT, reply.status, detail, message.map(|(_, text)| text))?;
    parsed.map_err(|error| ConnectionError::Garbled {
        what: WHAT,
        problem: error.to_string(),
    })
}

/// The error for a reply that answers another question.
pub fn unexpected(what: &'static str, reply: &Reply) -> ConnectionError {
    ConnectionError::Garbled {
        what,
        problem: format!("got the reply to something else: {reply:?}"),
    }
}

fn refuse(
    what: &'static str,
    code: u32,
    detail: u64,
    message: Option<String>,
) -> Result<(), ConnectionError> {
    match Status::try_from(code) {
        Ok(Status::Ok) => Ok(()),
        Ok(status) => {
            let message = match status {
                // In the words of the commands that connect this way.
                Status::Busy => format!(
                    "busy: held by pid {detail}; wait for its release, or take over with --takeover"
                ),
                _ => message.unwrap_or_else(|| status.explain(detail)),
            };
            Err(ConnectionError::Refused {
                status,
                detail,
                message,
            })
        }
        Err(unknown) => Err(ConnectionError::Garbled {
            what,
            problem: unknown.to_string(),
        }),
    }
}

/// Checks that an answer is of our version and to our request: `(got, expected)` sequence numbers.
fn check_answer(
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
    Err(ConnectionError::Garbled { what, problem })
}
