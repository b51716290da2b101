//! The answering side of a request channel: receives a request, sends its answer, and wakes its client.
//!
//! The server uses [`Answers`] on each of its channels.

use super::channels::{
    Channel, ChannelError, ControlService, Ipc, RequestResponse, Services, WireHeader, ipc_error,
    server_node,
};
use super::failed_connections::FailedConnections;
use super::resources::check_room_for_ports;
use emberwatch_messages::control::Reply;
use emberwatch_messages::message::{ControlReply, ControlRequest, Header, Status, VERSION};
use iceoryx2::active_request::ActiveRequest;
use iceoryx2::port::ReceiveError;
use iceoryx2::port::notifier::{ListenerKey, Notifier};
use iceoryx2::port::server::Server;
use iceoryx2::prelude::{AllocationStrategy, CallbackProgression};
use iceoryx2::service::port_factory::server::ServerCreateError;
use serde::Serialize;
use std::collections::HashMap;
use std::time::{Duration, Instant};

/// Initial maximum size of a JSON answer in bytes. A longer answer makes its segment grow.
pub const JSON_SLICE: usize = 16_384;

/// Maximum number of known listeners. A full table is emptied.
const MAX_KNOWN_LISTENERS: usize = 1024;

/// Maximum time that an ending sender waits for clients to read its last answers.
const LAST_ANSWER_TIMEOUT: Duration = Duration::from_millis(500);

/// A request that is waiting for its answer.
pub type Active<Q, R> = ActiveRequest<Ipc, [u8], WireHeader<Q>, [u8], WireHeader<R>>;

pub type ActiveControl = Active<ControlRequest, ControlReply>;

pub type ControlServer =
    Server<Ipc, [u8], WireHeader<ControlRequest>, [u8], WireHeader<ControlReply>>;

/// The sender of answers, which wakes the clients that wait for them.
#[derive(Debug)]
pub struct Answers {
    notifier: Notifier<Ipc>,
    listeners: HashMap<u128, ListenerKey>,
}

impl Answers {
    pub fn new(services: &Services<'_>) -> Result<Self, ChannelError> {
        let wake = services.wake(Channel::WakeClient)?;
        let notifier = wake.notifier_builder().create();
        Ok(Self {
            notifier: notifier.map_err(ipc_error("create a notifier"))?,
            listeners: HashMap::new(),
        })
    }

    /// Sends an answer and wakes its client. The answer is lost if the client has ended, or does not read its answers.
    pub fn send<Q: Header, R: Header>(
        &mut self,
        request: &Active<Q, R>,
        header: R,
        payload: &[u8],
        listener: u128,
    ) {
        let sent = request
            .loan_slice_uninit(payload.len())
            .map_err(|error| format!("{error:?}"))
            .and_then(|mut response| {
                *response.user_header_mut() = WireHeader(header);
                response
                    .write_from_slice(payload)
                    .send()
                    .map_err(|error| format!("{error:?}"))
            });
        match sent {
            Ok(()) => self.wake(listener),
            Err(problem) => tracing::debug!(problem, "an answer could not be sent"),
        }
    }

    /// Sends a JSON answer and wakes its client. If there is too little memory for a long answer, sends a refusal
    /// instead.
    pub fn send_json(&mut self, request: &ActiveControl, status: Status, reply: &impl Serialize) {
        let mut status = status;
        let mut text = serde_json::to_vec(reply).expect("invariant: replies serialise");
        if text.len() > JSON_SLICE
            && let Err(error) = check_room_for_ports(text.len())
        {
            let refusal = Reply::error(Status::NoMemory, 0, error.to_string());
            status = Status::NoMemory;
            text = serde_json::to_vec(&refusal).expect("invariant: replies serialise");
        }
        let asked = request.user_header().0;
        let header = ControlReply {
            version: VERSION,
            status: status as u32,
            sequence: asked.sequence,
        };
        let listener = listener_id(asked.listener_low, asked.listener_high);
        self.send(request, header, &text, listener);
    }

    fn wake(&mut self, listener: u128) {
        let known = self
            .listeners
            .get(&listener)
            .is_some_and(|key| self.notifier.notify_single_listener(key).is_ok());
        if listener == 0 || known {
            return;
        }
        if self.listeners.len() == MAX_KNOWN_LISTENERS {
            self.listeners.clear();
        }
        self.listeners.remove(&listener);
        let listeners = &mut self.listeners;
        self.notifier.for_each_listener(|one, details| {
            if details.listener_id.value() != listener {
                return CallbackProgression::Continue;
            }
            listeners.insert(listener, one.listener_key());
            let _ = one.notify();
            CallbackProgression::Stop
        });
    }
}

/// Returns the received request, if any. Only a client can cause a failure, for example if its memory is gone, so a
/// failure must not end the server.
pub fn received<T>(
    result: Result<Option<T>, ReceiveError>,
    failed_connections: &FailedConnections,
) -> Option<T> {
    result.unwrap_or_else(|error| {
        if matches!(error, ReceiveError::ConnectionFailure(_)) {
            failed_connections.add();
        }
        tracing::debug!(?error, "a request was not received");
        None
    })
}

/// Makes the answering port of a service of JSON messages. Answers may have any length.
///
/// # Errors
/// If iceoryx2 cannot make it. [`port_owner`] finds out whether another process has the port.
pub fn control_server(
    service: &ControlService,
    failed_connections: &FailedConnections,
) -> Result<ControlServer, ServerCreateError> {
    let builder = service.server_builder().initial_max_slice_len(JSON_SLICE);
    builder
        .set_request_degradation_handler(failed_connections.counter())
        .set_response_degradation_handler(failed_connections.counter())
        .allocation_strategy(AllocationStrategy::PowerOfTwo)
        .create()
}

/// Returns the node that owns a service's only answering port, if `error` means that this port already exists.
pub fn port_owner<Q: Header, R: Header>(
    service: &RequestResponse<Q, R>,
    error: &ServerCreateError,
) -> Option<u128> {
    (*error == ServerCreateError::ExceedsMaxSupportedServers)
        .then(|| server_node(service))
        .flatten()
}

pub fn listener_id(low: u64, high: u64) -> u128 {
    u128::from(low) | u128::from(high) << 64
}

/// Waits until clients have read their answers and dropped their requests, for at most half a second.
pub fn wait_until_taken<Q: Header, R: Header>(requests: &[Active<Q, R>]) {
    let deadline = Instant::now() + LAST_ANSWER_TIMEOUT;
    while requests.iter().any(Active::is_connected) && Instant::now() < deadline {
        std::thread::sleep(Duration::from_millis(1));
    }
}
