//! The server's ports on the channels.

use super::descriptors::raise_limit;
use super::memory::{PortIds, PortMemory, check_shared_memory};
use super::port_config::{PortConfig, frame_bytes};
use super::taken::{Taken, once_free};
use anyhow::Result;
use emberwatch_protocol::channels::{
    Channel, ChannelError, ControlService, Entries, FrameService, Ipc, Publications,
    RequestResponse, Services, StepService, TruthService, WireHeader, create_node, ipc_error,
    lives_elsewhere,
};
use emberwatch_protocol::control::Reply;
use emberwatch_protocol::failed_connections::FailedConnections;
use emberwatch_protocol::message::{
    FrameHeader, Header, Status, StepReply, StepRequest, TruthHeader,
};
use emberwatch_protocol::payload::{ROBOT_BYTES, WORLD_BYTES};
use emberwatch_protocol::program::{WatchedProcess, node_pid};
use emberwatch_protocol::responder::{
    Active, ActiveControl, Answers, ControlServer, control_server, port_owner, received,
};
use emberwatch_protocol::shared_memory::fill_ports;
use emberwatch_protocol::throttle::Throttle;
use emberwatch_protocol::turn::Turn;
use emberwatch_protocol::wait::{descriptor, drain};
use emberwatch_sim::config::Checked;
use iceoryx2::node::Node;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::server::Server;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::{CallbackProgression, PortFactory};
use iceoryx2::service::dynamic_config::publish_subscribe::SubscriberDetails;
use iceoryx2::service::dynamic_config::request_response::ClientDetails;
use iceoryx2::service::port_factory::server::ServerCreateError;
use std::cell::RefCell;
use std::collections::HashSet;
use std::os::fd::BorrowedFd;
use std::time::Instant;

/// A received request on `step` that is not answered yet.
pub type ActiveStep = Active<StepRequest, StepReply>;

pub struct Ports {
    step: StepServer,
    control: ControlServer,
    frames: Publisher<Ipc, [u8], WireHeader<FrameHeader>>,
    truth: Option<Publisher<Ipc, [u8], WireHeader<TruthHeader>>>,
    listener: Listener<Ipc>,
    answers: Answers,
    memory: PortMemory,
    failed_connections: FailedConnections,
    unpublished: RefCell<Throttle>,
    control_service: ControlService,
    step_service: StepService,
    frame_service: FrameService,
    truth_service: Option<TruthService>,
    entries: Entries,
    _node: Node<Ipc>,
    /// The lock for removing ports. It is dropped last, so that it is held while the other fields are dropped and their
    /// files removed.
    end: Option<Turn>,
}

impl Drop for Ports {
    fn drop(&mut self) {
        self.end = Turn::take().ok();
    }
}

impl Ports {
    pub fn open(checked: &Checked) -> Result<Self> {
        let (n_cells, config) = (checked.shape.n_cells(), &checked.config);
        let of_robots = config.world.robots as usize * (ROBOT_BYTES + n_cells);
        let config = PortConfig {
            instance: checked.instance.clone(),
            n_cells,
            frame_bytes: frame_bytes(config.world.robots, n_cells, config.world.moves),
            answer_bytes: config.worlds as usize * (WORLD_BYTES + of_robots),
            publish_truth: checked.config.publish_truth,
        };
        WatchedProcess::check()?;
        check_shared_memory(&config)?;
        raise_limit()?;
        once_free(|| Self::open_once(&config))
    }

    fn open_once(config: &PortConfig) -> Result<Self> {
        let _turn = Turn::take()?;
        let node = create_node()?;
        let services = Services {
            node: &node,
            instance: &config.instance,
        };
        let (control_service, step_service) = (services.create_control()?, services.create_step()?);
        let failed = FailedConnections::default();
        let control = control_server(&control_service, &failed)
            .map_err(|error| taken(config, &control_service, error))?;
        let step = step_server(&step_service, config.answer_bytes, &failed)
            .map_err(|error| taken(config, &step_service, error))?;
        let frame_service = services.frames()?;
        let frames = publisher(&frame_service, config.frame_bytes, &failed)?;
        let truth_service = config.publish_truth.then(|| services.truth()).transpose()?;
        let truth = truth_service
            .as_ref()
            .map(|service| publisher(service, config.n_cells, &failed))
            .transpose()?;
        let listener = services.listener(Channel::WakeServer)?;
        let answers = Answers::new(&services)?;
        fill_ports(&node, false)?;
        let ids = PortIds {
            control: control.id().value(),
            step: step.id().value(),
            frames: frames.id().value(),
            truth: truth.as_ref().map(|truth| truth.id().value()),
        };
        let memory = PortMemory::new(&ids, config)?;
        let entries = Entries::of(&node)?;
        Ok(Self {
            step,
            control,
            frames,
            truth,
            listener,
            answers,
            memory,
            failed_connections: failed,
            unpublished: RefCell::default(),
            control_service,
            step_service,
            frame_service,
            truth_service,
            entries,
            _node: node,
            end: None,
        })
    }

    /// Checks that clients can still find the server.
    pub fn check_entries(&self) -> Result<(), ChannelError> {
        self.entries.check_at(Instant::now())
    }

    /// Closes the ports and removes their files. If the files have already been removed by someone else, files with
    /// these names belong to another server and are kept.
    pub fn close(self) {
        if self.entries.check().is_err() {
            std::mem::forget(self);
        }
    }

    pub fn receive_step(&self) -> Option<ActiveStep> {
        received(self.step.receive(), &self.failed_connections)
    }

    pub fn receive_control(&self) -> Option<ActiveControl> {
        received(self.control.receive(), &self.failed_connections)
    }

    /// Returns the reply unchanged, except that a reply to `hello` becomes a refusal if there is no memory for answers
    /// to another client.
    pub fn with_memory(&self, reply: Reply) -> Reply {
        let n_clients = self.control_service.dynamic_config().number_of_clients();
        match (
            &reply,
            self.memory.for_clients(n_clients.max(self.n_clients())),
        ) {
            (Reply::Hello(_), Err(error)) => Reply::error(Status::NoMemory, 0, error.to_string()),
            _ => reply,
        }
    }

    pub fn answers(&mut self) -> &mut Answers {
        &mut self.answers
    }

    pub fn publish_frame(&self, header: FrameHeader, bytes: &[u8]) {
        let (n_observers, _) = self.observers();
        let ready = self.memory.for_observers(n_observers);
        let ready = ready.map_err(|error| error.to_string());
        let sent = ready.and_then(|()| publish(&self.frames, header, bytes));
        self.warn_of(sent, "a frame was not published");
    }

    pub fn publish_truth(&self, header: TruthHeader, states: &[u8]) {
        let Some(truth) = &self.truth else { return };
        let (_, n_readers) = self.observers();
        let ready = self.memory.for_readers(n_readers);
        let ready = ready.map_err(|error| error.to_string());
        let sent = ready.and_then(|()| publish(truth, header, states));
        self.warn_of(sent, "hidden states were not published");
    }

    fn warn_of(&self, sent: Result<usize, String>, what: &str) {
        if let Err(problem) = sent
            && let Some(n_unsaid) = self.unpublished.borrow_mut().pass(Instant::now())
        {
            tracing::warn!(problem, n_unsaid, "{what}");
        }
    }

    pub fn warn_of_descriptors(&self, now: Instant) {
        self.failed_connections.warn(now);
    }

    pub fn observers(&self) -> (usize, usize) {
        let n_frames = self.frame_service.dynamic_config().number_of_subscribers();
        let n_truth = self.truth_service.as_ref().map_or(0, |service| {
            service.dynamic_config().number_of_subscribers()
        });
        (n_frames, n_truth)
    }

    pub fn observer_ids(&self) -> Vec<u128> {
        self.list_observers(|observer| observer.subscriber_id.value())
    }

    pub fn nodes(&self) -> HashSet<u128> {
        let mut nodes = self.client_nodes();
        nodes.extend(self.list_observers(|observer| observer.node_id.value()));
        nodes
    }

    fn list_observers(&self, of: impl Fn(&SubscriberDetails) -> u128) -> Vec<u128> {
        let mut list = Vec::new();
        let mut add = |observer: &SubscriberDetails| {
            list.push(of(observer));
            CallbackProgression::Continue
        };
        self.frame_service
            .dynamic_config()
            .list_subscribers(&mut add);
        if let Some(service) = &self.truth_service {
            service.dynamic_config().list_subscribers(&mut add);
        }
        list
    }

    pub fn connect_observers(&self) {
        // Errors are ignored: if connecting to one observer fails, only that observer receives nothing.
        let _ = self.frames.update_connections();
        let _ = self
            .truth
            .as_ref()
            .map(UpdateConnections::update_connections);
    }

    pub fn n_clients(&self) -> usize {
        self.step_service.dynamic_config().number_of_clients()
    }

    pub fn client_nodes(&self) -> HashSet<u128> {
        let mut nodes = HashSet::new();
        let mut add = |client: &ClientDetails| {
            nodes.insert(client.node_id.value());
            CallbackProgression::Continue
        };
        self.control_service.dynamic_config().list_clients(&mut add);
        self.step_service.dynamic_config().list_clients(&mut add);
        nodes
    }

    pub fn drain(&self) -> Result<bool, ChannelError> {
        drain(&self.listener)
    }

    pub fn descriptor(&self) -> BorrowedFd<'_> {
        descriptor(&self.listener)
    }
}

type StepServer = Server<Ipc, [u8], WireHeader<StepRequest>, [u8], WireHeader<StepReply>>;

fn step_server(
    service: &StepService,
    answer_bytes: usize,
    failed: &FailedConnections,
) -> Result<StepServer, ServerCreateError> {
    service
        .server_builder()
        .initial_max_slice_len(answer_bytes.max(1))
        .set_request_degradation_handler(failed.counter())
        .set_response_degradation_handler(failed.counter())
        .max_loaned_responses_per_request(1)
        .create()
}

fn publisher<H: Header>(
    service: &Publications<H>,
    sample_bytes: usize,
    failed: &FailedConnections,
) -> Result<Publisher<Ipc, [u8], WireHeader<H>>, ChannelError> {
    service
        .publisher_builder()
        .initial_max_slice_len(sample_bytes)
        .set_degradation_handler(failed.counter())
        .max_loaned_samples(1)
        .create()
        .map_err(ipc_error("create a publisher"))
}

fn publish<H: Header>(
    publisher: &Publisher<Ipc, [u8], WireHeader<H>>,
    header: H,
    bytes: &[u8],
) -> Result<usize, String> {
    let mut sample = publisher
        .loan_slice_uninit(bytes.len())
        .map_err(|error| format!("{error:?}"))?;
    *sample.user_header_mut() = WireHeader(header);
    let sent = sample.write_from_slice(bytes).send();
    sent.map_err(|error| format!("{error:?}"))
}

fn taken<Q: Header, R: Header>(
    config: &PortConfig,
    service: &RequestResponse<Q, R>,
    error: ServerCreateError,
) -> anyhow::Error {
    let instance = config.instance.name().to_owned();
    match port_owner(service, &error) {
        Some(node) if lives_elsewhere(node) => ChannelError::OtherPidNamespace { instance }.into(),
        Some(node) => Taken {
            instance,
            pid: node_pid(node),
        }
        .into(),
        None => ipc_error("create a server")(error).into(),
    }
}
