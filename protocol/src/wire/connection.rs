//! A client's side of `step` and `control`: one request at a time, each with a deadline.
//!
//! Nothing returned points into shared memory.

use super::channel_files::lives_elsewhere;
use super::channels::{
    Channel, ChannelError, ControlService, Entries, Instance, Ipc, Services, StepService,
    create_node, ipc_error, limited_error, server_node,
};
use super::control::{Reply, Request, ServerInfo};
use super::exchange::{Exchange, check_answer, check_status, garbled};
use super::message::{
    ControlReply, ControlRequest, RobotResult, StepReply, StepRequest, VERSION, WorldResult,
};
use super::node::Opened;
use super::payload::split_step_payload;
use super::process::{WatchedProcess, node_pid, pid_namespace};
use super::resources::check_room_for_ports;
use super::shared_memory::fill_ports;
use super::turn::Turn;
use super::wait::Waiter;
use iceoryx2::port::client::Client;
use iceoryx2::prelude::AllocationStrategy;
use std::ops::Range;
use std::os::fd::BorrowedFd;
use std::time::{Duration, Instant};

pub use super::exchange::ConnectionError;

/// Length that control requests may have before their segment grows, bytes.
const CONTROL_SLICE: usize = 4096;

/// The answer to a step: results and frames of consecutive robots, and results of their worlds.
#[derive(Debug, Clone, PartialEq)]
pub struct StepAnswer {
    /// The binary header.
    pub reply: StepReply,
    /// One result per world.
    pub worlds: Vec<WorldResult>,
    /// One result per robot.
    pub robots: Vec<RobotResult>,
    /// The frames, `H * W` bytes per robot, or per world if team frames were asked for.
    pub frames: Vec<u8>,
}

/// A connection to a running server.
pub struct Connection {
    ports: Opened<Ports>,
    info: ServerInfo,
    sequence: u64,
}

type StepClient = Client<Ipc, [u8], StepRequest, [u8], StepReply>;

struct Ports {
    step: Option<StepClient>,
    control: Client<Ipc, [u8], ControlRequest, [u8], ControlReply>,
    exchange: Exchange,
}

impl Connection {
    /// Connects to the instance's server and shakes hands; `client` names this program in its log.
    ///
    /// # Errors
    /// If no server runs on the instance, it speaks another version, or it does not answer in time.
    pub fn open(
        instance: &Instance,
        client: &str,
        timeout: Duration,
    ) -> Result<Self, ConnectionError> {
        let start = Instant::now();
        let left = || timeout.saturating_sub(start.elapsed());
        let (mut ports, step) = Self::open_ports(instance, left())?;
        let info = shake_hands(&ports.control, &ports.exchange, client, left())?;
        let of_world = size_of::<u64>() + info.n_robots as usize * info.n_moves;
        let longest = info.n_worlds as usize * of_world;
        let _turn = Turn::take_within(left())?;
        let step = step.client_builder().initial_max_slice_len(longest.max(1));
        let step = step.create();
        ports.step = Some(step.map_err(limited_error("create a step client", "16 clients"))?);
        fill_ports(&ports.exchange.node, true)?;
        Ok(Self {
            ports,
            info,
            sequence: 1,
        })
    }

    /// All ports but that for steps, whose size the server tells.
    fn open_ports(
        instance: &Instance,
        limit: Duration,
    ) -> Result<(Opened<Ports>, StepService), ConnectionError> {
        let _turn = Turn::take_within(limit)?; // declared first: what fails below is dropped within it
        let node = create_node()?;
        let services = Services {
            node: &node,
            instance,
        };
        let control_service = services.open_control()?;
        let step_service = services.open_step()?;
        let server_process = server_process(&control_service, instance)?;
        let server = services
            .wake(Channel::WakeServer)?
            .notifier_builder()
            .create()
            .map_err(ipc_error("create a notifier"))?;
        let listener = services.listener(Channel::WakeClient)?;
        let control = control_service
            .client_builder()
            .initial_max_slice_len(CONTROL_SLICE)
            .allocation_strategy(AllocationStrategy::PowerOfTwo)
            .create()
            .map_err(limited_error("create a control client", "16 clients"))?;
        fill_ports(&node, true)?;
        let entries = Entries::of(&node)?;
        let exchange = Exchange {
            instance: instance.clone(),
            server,
            listener,
            server_process,
            waiter: Waiter::default(),
            node,
        };
        let ports = Ports {
            step: None,
            control,
            exchange,
        };
        Ok((Opened::new(entries, ports), step_service))
    }

    /// What the server said of itself.
    pub fn info(&self) -> &ServerInfo {
        &self.info
    }

    /// The server's process: readable when it has ended.
    pub fn server_process(&self) -> BorrowedFd<'_> {
        self.ports.exchange.server_process.descriptor()
    }

    /// Checks that the server's process runs, without asking it.
    ///
    /// # Errors
    /// If it has ended.
    pub fn check_server(&self) -> Result<(), ConnectionError> {
        if self.ports.exchange.server_process.has_ended() {
            Err(self.ports.exchange.server_gone())
        } else {
            Ok(())
        }
    }

    /// Asks on the control channel.
    ///
    /// # Errors
    /// If the server refuses, has ended, or gives no good answer in time.
    pub fn control(
        &mut self,
        request: &Request,
        timeout: Duration,
    ) -> Result<Reply, ConnectionError> {
        self.sequence += 1;
        ask(
            &self.ports.control,
            &self.ports.exchange,
            self.sequence,
            request,
            timeout,
        )
    }

    /// Asks on the step channel; version, sequence and listener are filled in here. The answer is for the robots that
    /// were asked for, and waits until their world has moved.
    ///
    /// # Errors
    /// If the server refuses, has ended, or gives no good answer in time.
    pub fn step(
        &mut self,
        request: StepRequest,
        body: &[u8],
        timeout: Duration,
    ) -> Result<StepAnswer, ConnectionError> {
        const WHAT: &str = "step";
        self.sequence += 1;
        let step = self.ports.step.as_ref();
        let step = step.expect("invariant: made when it was opened");
        let (listener_low, listener_high) = self.ports.exchange.listener_id();
        let header = StepRequest {
            version: VERSION,
            sequence: self.sequence,
            listener_low,
            listener_high,
            ..request
        };
        let (reply, answer) =
            self.ports
                .exchange
                .request(step, header, body, WHAT, timeout, |reply, payload| {
                    let parts = split_step_payload(reply, payload);
                    (
                        *reply,
                        parts.map(|parts| (parts.worlds, parts.robots, parts.frames.to_vec())),
                    )
                })?;
        check_status(WHAT, reply.status, reply.detail, None)?;
        check_answer(WHAT, reply.version, (reply.sequence, self.sequence))?;
        let (worlds, robots, frames) = answer
            .map_err(|expected| garbled(WHAT, format!("expected a payload of {expected} bytes")))?;
        let asked = (request.first_robot, request.n_robots, request.flags);
        let got = (reply.first_robot, reply.n_robots, reply.flags);
        let expected = worlds_of(request.first_robot, request.n_robots, self.info.n_robots).len();
        if asked != got || worlds.len() != expected {
            let problem = format!(
                "expected {expected} worlds, and robots and flags {asked:?}, got {} and {got:?}",
                worlds.len()
            );
            return Err(garbled(WHAT, problem));
        }
        Ok(StepAnswer {
            reply,
            worlds,
            robots,
            frames,
        })
    }
}

/// The worlds of consecutive robots, with `team` robots in each world.
pub fn worlds_of(first_robot: u32, n_robots: u32, team: u32) -> Range<u32> {
    let (team, end) = (team.max(1), first_robot.saturating_add(n_robots));
    first_robot / team..end.div_ceil(team)
}

/// The process of a service's server.
fn server_process(
    service: &ControlService,
    instance: &Instance,
) -> Result<WatchedProcess, ChannelError> {
    let node = server_node(service).ok_or_else(|| instance.no_server())?;
    let process = WatchedProcess::open(node_pid(node)).ok();
    match process.filter(|process| !process.has_ended()) {
        Some(process) => Ok(process),
        None if lives_elsewhere(node) => Err(instance.elsewhere()),
        None => Err(instance.no_server()),
    }
}

fn shake_hands(
    control: &Client<Ipc, [u8], ControlRequest, [u8], ControlReply>,
    exchange: &Exchange,
    client: &str,
    timeout: Duration,
) -> Result<ServerInfo, ConnectionError> {
    let hello = Request::Hello {
        protocol: VERSION,
        client: client.into(),
    };
    match ask(control, exchange, 1, &hello, timeout)? {
        // In another PID namespace, the server's process id names another process or none.
        Reply::Hello(info)
            if info
                .pid_namespace
                .is_some_and(|it| pid_namespace() != Some(it)) =>
        {
            Err(exchange.instance.elsewhere().into())
        }
        Reply::Hello(info) => Ok(*info),
        other => Err(unexpected("hello", &other)),
    }
}

fn ask(
    client: &Client<Ipc, [u8], ControlRequest, [u8], ControlReply>,
    exchange: &Exchange,
    sequence: u64,
    request: &Request,
    timeout: Duration,
) -> Result<Reply, ConnectionError> {
    const WHAT: &str = "a control request";
    let text = serde_json::to_vec(request).expect("invariant: requests serialise");
    if text.len() > CONTROL_SLICE {
        check_room_for_ports(text.len())?; // It will be in a new file.
    }
    let (listener_low, listener_high) = exchange.listener_id();
    let header = ControlRequest {
        version: VERSION,
        reserved: 0,
        sequence,
        listener_low,
        listener_high,
    };
    let (reply, payload) =
        exchange.request(client, header, &text, WHAT, timeout, |reply, payload| {
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
    check_status(WHAT, reply.status, detail, message.map(|(_, text)| text))?;
    parsed.map_err(|error| garbled(WHAT, error))
}

/// The error for a reply that answers another question.
pub fn unexpected(what: &'static str, reply: &Reply) -> ConnectionError {
    garbled(what, format!("got the reply to something else: {reply:?}"))
}
