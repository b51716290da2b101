//! Sends raw headers and payloads, as a client in another language or a hostile client would. Fields are sent as given
//! and are not checked.

use crate::programs::PATIENCE;
use emberwatch_protocol::channels::{
    Channel, ChannelError, Instance, Ipc, RequestResponse, Services, WireHeader, create_node,
    ipc_error,
};
use emberwatch_protocol::control::{LeaseInfo, Reply, Request};
use emberwatch_protocol::message::{
    ControlReply, ControlRequest, Header, Operation, Status, StepReply, StepRequest, VERSION,
};
use emberwatch_protocol::payload::write_step_body;
use emberwatch_protocol::wait::Waiter;
use iceoryx2::node::Node;
use iceoryx2::pending_response::PendingResponse;
use iceoryx2::port::client::{Client, RequestSendError};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::AllocationStrategy;
use std::convert::Infallible;
use std::ops::Range;
use std::time::Duration;

pub type StepAnswer = (StepReply, Vec<u8>);

pub type ControlAnswer = (ControlReply, Vec<u8>);

pub type Requests<Q, R> = Client<Ipc, [u8], WireHeader<Q>, [u8], WireHeader<R>>;

/// A sent request whose answer has not arrived.
pub type Pending<Q, R> = PendingResponse<Ipc, [u8], WireHeader<Q>, [u8], WireHeader<R>>;

/// A client of the compliance suite, which sends raw messages and waits for their answers.
pub trait RawClient {
    /// Sends a step request and waits for its answer.
    fn step(&self, header: StepRequest, payload: &[u8]) -> StepAnswer;

    /// Sends bytes on `control` and waits for the answer.
    fn control(&self, header: ControlRequest, payload: &[u8]) -> ControlAnswer;

    /// Returns the process id that the server sees as the client's.
    fn pid(&self) -> u32;

    /// Sends a well-formed control request, and checks that the header of the answer has the same status as the reply
    /// in its payload.
    fn ask(&self, request: &Request) -> Reply {
        let text = serde_json::to_vec(request).expect("requests serialise");
        let (header, payload) = self.control(control_header(7), &text);
        assert_eq!((header.version, header.sequence), (VERSION, 7));
        let reply: Reply = serde_json::from_slice(&payload).expect("a reply");
        assert_eq!(Status::try_from(header.status), Ok(reply.status()));
        reply
    }

    /// Sends a step request, and returns the status and detail of its answer.
    fn status_of(&self, header: StepRequest, payload: &[u8]) -> (Status, u64) {
        let (reply, _) = self.step(header, payload);
        let status = Status::try_from(reply.status);
        (status.expect("a known status"), reply.detail)
    }

    fn acquire(&self, robots: Range<u32>) -> LeaseInfo {
        match self.ask(&acquire_request(robots)) {
            Reply::Lease(lease) => lease,
            other => panic!("expected a lease, got {other:?}"),
        }
    }
}

/// A client that skips the handshake and all checks.
pub struct Wire {
    step: Requests<StepRequest, StepReply>,
    control: Requests<ControlRequest, ControlReply>,
    server: Notifier<Ipc>,
    _node: Node<Ipc>,
}

impl Wire {
    /// Opens both channels of an instance, without a handshake.
    pub fn open(instance: &Instance) -> Self {
        Self::try_open(instance).expect("open the channels")
    }

    /// Opens both channels as [`Self::open`] does, but returns an error instead of panicking.
    pub fn try_open(instance: &Instance) -> Result<Self, ChannelError> {
        let node = create_node()?;
        let services = Services {
            node: &node,
            instance,
        };
        let step = client(&services.open_step()?)?;
        let control = client(&services.open_control()?)?;
        let wake = services.wake(Channel::WakeServer)?;
        let server = wake.notifier_builder().create();
        Ok(Self {
            step,
            control,
            server: server.map_err(ipc_error("create a notifier"))?,
            _node: node,
        })
    }

    pub fn send_step(
        &self,
        header: StepRequest,
        payload: &[u8],
    ) -> Result<Pending<StepRequest, StepReply>, RequestSendError> {
        let pending = send(&self.step, header, payload)?;
        self.server.notify().expect("wake the server");
        Ok(pending)
    }

    pub fn send_control(
        &self,
        header: ControlRequest,
        payload: &[u8],
    ) -> Result<Pending<ControlRequest, ControlReply>, RequestSendError> {
        let pending = send(&self.control, header, payload)?;
        self.server.notify().expect("wake the server");
        Ok(pending)
    }
}

impl RawClient for Wire {
    fn step(&self, header: StepRequest, payload: &[u8]) -> StepAnswer {
        let pending = self.send_step(header, payload).expect("send a step");
        answer(&pending, PATIENCE).expect("an answer to a step")
    }

    fn control(&self, header: ControlRequest, payload: &[u8]) -> ControlAnswer {
        let pending = self.send_control(header, payload).expect("send a request");
        answer(&pending, PATIENCE).expect("an answer on control")
    }

    fn pid(&self) -> u32 {
        std::process::id()
    }
}

/// Returns the header of a correct step of robot 0.
pub fn step_header(lease: u64, n_moves: u32) -> StepRequest {
    StepRequest {
        version: VERSION,
        operation: Operation::Step as u32,
        lease,
        sequence: 1,
        n_robots: 1,
        n_moves,
        ..StepRequest::default()
    }
}

/// Returns the header of a correct request to observe robots.
pub fn observe_header(robots: Range<u32>) -> StepRequest {
    StepRequest {
        operation: Operation::Observe as u32,
        first_robot: robots.start,
        n_robots: robots.len() as u32,
        ..step_header(0, 0)
    }
}

/// Returns the payload of a step request for worlds that are at these steps.
pub fn step_body(steps: &[u64], paths: &[u8]) -> Vec<u8> {
    let mut body = Vec::new();
    write_step_body(steps, paths, &mut body);
    body
}

/// Returns a request for a lease on free robots.
pub fn acquire_request(robots: Range<u32>) -> Request {
    Request::Acquire {
        first_robot: robots.start,
        n_robots: robots.len() as u32,
        takeover: false,
        ttl_millis: None,
    }
}

/// Returns the header of a correct control request.
pub fn control_header(sequence: u64) -> ControlRequest {
    ControlRequest {
        version: VERSION,
        sequence,
        ..ControlRequest::default()
    }
}

/// Waits for an answer. Returns `None` if none arrives in time.
pub fn answer<Q: Header, R: Header>(
    pending: &Pending<Q, R>,
    limit: Duration,
) -> Option<(R, Vec<u8>)> {
    let poll = || {
        let response = pending.receive().expect("receive an answer");
        Ok(response.map(|response| (response.user_header().0, response.payload().to_vec())))
    };
    let block = |remaining: Duration| {
        std::thread::sleep(remaining.min(Duration::from_micros(100)));
        Ok::<_, Infallible>(())
    };
    Waiter::default().wait(limit, poll, block).expect("wait")
}

/// Opens a client port of a service without a handshake.
pub fn client<Q: Header, R: Header>(
    service: &RequestResponse<Q, R>,
) -> Result<Requests<Q, R>, ChannelError> {
    let builder = service.client_builder().initial_max_slice_len(4096);
    let builder = builder.allocation_strategy(AllocationStrategy::PowerOfTwo);
    builder.create().map_err(ipc_error("create a client"))
}

/// Sends a request without waking the server.
pub fn send<Q: Header, R: Header>(
    client: &Requests<Q, R>,
    header: Q,
    payload: &[u8],
) -> Result<Pending<Q, R>, RequestSendError> {
    let mut request = client.loan_slice_uninit(payload.len())?;
    *request.user_header_mut() = WireHeader(header);
    request.write_from_slice(payload).send()
}
