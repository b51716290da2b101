//! The client's side of `step` and `control`: one request at a time, each with a deadline.
//!
//! No returned value points into shared memory.

use super::channels::{Entries, Instance, Services, StepService, create_node, limited_error};
use super::exchange::{RequestClient, copied};
use super::node::Opened;
use super::resources::{CLIENT_DESCRIPTORS, check_descriptors};
use super::shared_memory::fill_ports;
use super::texts::TextPort;
use super::turn::Turn;
use emberwatch_messages::backend::{Backend, StepAnswer};
use emberwatch_messages::control::{Reply, Request, ServerInfo};
use emberwatch_messages::errors::{ChannelError, check_answer, garbled};
use emberwatch_messages::interrupt::check_interrupt;
use emberwatch_messages::message::{StepReply, StepRequest, VERSION};
use emberwatch_messages::payload::split_step_payload;
use std::time::{Duration, Instant};

pub use emberwatch_messages::errors::{ConnectionError, check_status, refused, unexpected};
pub use emberwatch_messages::message::worlds_of;

/// The first and the longest pause between two attempts to connect.
const FIRST_PAUSE: Duration = Duration::from_millis(5);
const LONGEST_PAUSE: Duration = Duration::from_millis(200);

pub struct Connection {
    ports: Opened<Ports>,
    info: ServerInfo,
    sequence: u64,
}

type StepClient = RequestClient<StepRequest, StepReply>;

struct Ports {
    step: Option<StepClient>,
    /// Kept open because the service owns one of the files that [`Opened`] checks before it closes the ports. If the
    /// service were closed first, the check would find this file missing.
    step_service: StepService,
    texts: TextPort,
}

impl Connection {
    /// Connects to the server of an instance and shakes hands. `client` names this program in the server's log.
    ///
    /// # Errors
    /// If no server runs on the instance, or if the server speaks another version or does not answer in time.
    pub fn open(
        instance: &Instance,
        client: &str,
        timeout: Duration,
    ) -> Result<Self, ConnectionError> {
        let start = Instant::now();
        let left = || timeout.saturating_sub(start.elapsed());
        let mut ports = Self::open_ports(instance, left())?;
        let hello = ports.texts.shake_hands(client, left())?;
        let said = serde_json::from_slice(&hello).map_err(|error| garbled("hello", error))?;
        let Reply::Hello(info) = said else {
            return Err(unexpected("hello", &said));
        };
        let of_world = size_of::<u64>() + info.n_robots as usize * info.n_moves;
        let longest = info.n_worlds as usize * of_world;
        let _turn = Turn::take_within(left())?;
        let step = ports.step_service.client_builder();
        let step = step.initial_max_slice_len(longest.max(1)).create();
        ports.step = Some(step.map_err(limited_error("create a step client", "16 clients"))?);
        fill_ports(&ports.texts.exchange.node, true)?;
        Ok(Self {
            ports,
            info: *info,
            sequence: 0,
        })
    }

    /// Connects as [`Self::open`] does. While the server is away, tries again for up to `wait`, after pauses that grow
    /// from 5 ms to 200 ms. `waits` is called before each pause, and ends the wait if it returns false.
    ///
    /// # Errors
    /// The same as [`Self::open`], and [`ConnectionError::Channel`] if the wait was interrupted.
    pub fn open_within(
        instance: &Instance,
        client: &str,
        (wait, timeout): (Duration, Duration),
        mut waits: impl FnMut(&ConnectionError) -> bool,
    ) -> Result<Self, ConnectionError> {
        let (start, mut pause) = (Instant::now(), FIRST_PAUSE);
        loop {
            let error = match Self::open(instance, client, timeout) {
                Err(error) if error.is_away() => error,
                opened => return opened,
            };
            let left = wait.saturating_sub(start.elapsed());
            if left.is_zero() || !waits(&error) {
                return Err(error);
            }
            sleep(pause.min(left))?;
            pause = LONGEST_PAUSE.min(2 * pause);
        }
    }

    /// Opens all ports except the port for steps, whose size depends on the server's settings.
    fn open_ports(instance: &Instance, limit: Duration) -> Result<Opened<Ports>, ConnectionError> {
        let _turn = Turn::take_within(limit)?; // Declared first, so that on an error it is dropped after the ports.
        check_descriptors("connect", CLIENT_DESCRIPTORS)?;
        let node = create_node()?;
        let services = Services {
            node: &node,
            instance,
        };
        let control = services.open_control()?;
        let step_service = services.open_step()?;
        let texts = TextPort::create(node, instance, &control)?;
        let node = &texts.exchange.node;
        fill_ports(node, true)?;
        let entries = Entries::of(node)?;
        let ports = Ports {
            step: None,
            step_service,
            texts,
        };
        Ok(Opened::new(entries, ports))
    }

    pub fn info(&self) -> &ServerInfo {
        &self.info
    }

    /// Sends a request on the control channel.
    ///
    /// # Errors
    /// If the server refuses, has ended, or sends no valid answer in time.
    pub fn control(
        &mut self,
        request: &Request,
        timeout: Duration,
    ) -> Result<Reply, ConnectionError> {
        Backend::control(self, request, timeout)
    }
}

impl Backend for Connection {
    fn info(&self) -> &ServerInfo {
        &self.info
    }

    fn control_text(&mut self, text: &[u8], timeout: Duration) -> Result<Vec<u8>, ConnectionError> {
        self.ports.texts.ask(text, timeout)
    }

    fn step(
        &mut self,
        request: StepRequest,
        body: &[u8],
        timeout: Duration,
    ) -> Result<StepAnswer, ConnectionError> {
        self.sequence += 1;
        let step = self.ports.step.as_ref();
        let step = step.expect("invariant: made when it was opened");
        let exchange = &self.ports.texts.exchange;
        let (listener_low, listener_high) = exchange.listener_id();
        let header = StepRequest {
            version: VERSION,
            sequence: self.sequence,
            listener_low,
            listener_high,
            ..request
        };
        let copy = |reply: &StepReply, payload: &[u8]| (*reply, copied(WHAT, payload));
        let (reply, payload) = exchange.request(step, header, body, WHAT, timeout, copy)?;
        let payload = payload?;
        check_status(WHAT, reply.status, reply.detail, None)?;
        check_answer(WHAT, reply.version, (reply.sequence, self.sequence))?;
        check_asked(&self.info, &request, &reply)?;
        let parts = split_step_payload(&reply, &payload)
            .map_err(|expected| garbled(WHAT, format!("expected a payload of {expected} bytes")))?;
        parts.check(&self.info).map_err(|it| garbled(WHAT, it))?;
        Ok((reply, payload))
    }
}

fn sleep(pause: Duration) -> Result<(), ChannelError> {
    let start = Instant::now();
    while let left @ 1.. = pause.saturating_sub(start.elapsed()).as_millis() as u64 {
        std::thread::sleep(Duration::from_millis(left.min(5)));
        check_interrupt()?;
    }
    Ok(())
}

const WHAT: &str = "step";

fn check_asked(
    info: &ServerInfo,
    request: &StepRequest,
    reply: &StepReply,
) -> Result<(), ConnectionError> {
    let n_worlds = worlds_of(request.first_robot, request.n_robots, info.n_robots).len();
    let of_request = (request.first_robot, request.n_robots, request.flags);
    let asked = (of_request, n_worlds, (info.height, info.width));
    let of_reply = (reply.first_robot, reply.n_robots, reply.flags);
    let grid = (reply.height as usize, reply.width as usize);
    let got = (of_reply, reply.n_worlds as usize, grid);
    if asked == got {
        Ok(())
    } else {
        let what = "robots and flags, worlds, grid";
        Err(garbled(
            WHAT,
            format!("expected {what} {asked:?}, got {got:?}"),
        ))
    }
}
