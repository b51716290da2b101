//! The client's side of `control`, the channel of JSON text.

use super::channel_files::lives_elsewhere;
use super::channels::{
    Channel, ChannelError, ControlService, Instance, Ipc, Services, ipc_error, limited_error,
    server_node,
};
use super::directory::no_server;
use super::exchange::{Exchange, RequestClient, copied};
use super::process::{WatchedProcess, node_pid, watch_error};
use super::resources::check_room_for_ports;
use super::wait::Waiter;
use emberwatch_messages::control::Request;
use emberwatch_messages::errors::{ConnectionError, check_answer, check_status, garbled};
use emberwatch_messages::message::{ControlReply, ControlRequest, VERSION};
use emberwatch_messages::process::pid_namespace;
use iceoryx2::node::Node;
use iceoryx2::prelude::AllocationStrategy;
use rustix::io::Errno;
use serde::Deserialize;
use std::time::Duration;

/// Initial maximum size of a request in bytes. A longer request makes its segment grow.
const SLICE: usize = 4096;

const WHAT: &str = "a control request";

pub(super) struct TextPort {
    client: RequestClient<ControlRequest, ControlReply>,
    sequence: u64,
    pub(super) exchange: Exchange,
}

/// The fields of a refusal or of a reply to `hello` that this module reads.
#[derive(Deserialize, Default)]
struct Common {
    #[serde(default)]
    detail: u64,
    message: Option<String>,
    pid_namespace: Option<u64>,
}

impl TextPort {
    pub(super) fn create(
        node: Node<Ipc>,
        instance: &Instance,
        service: &ControlService,
    ) -> Result<Self, ChannelError> {
        let services = Services {
            node: &node,
            instance,
        };
        let server_process = server_process(service, instance)?;
        let notifier = services
            .wake(Channel::WakeServer)?
            .notifier_builder()
            .create();
        let server = notifier.map_err(ipc_error("create a notifier"))?;
        let listener = services.listener(Channel::WakeClient)?;
        let client = service.client_builder().initial_max_slice_len(SLICE);
        let client = client
            .allocation_strategy(AllocationStrategy::PowerOfTwo)
            .create()
            .map_err(limited_error("create a control client", "16 clients"))?;
        Ok(Self {
            client,
            sequence: 0,
            exchange: Exchange {
                instance: instance.clone(),
                server,
                listener,
                server_process,
                waiter: Waiter::default(),
                node,
            },
        })
    }

    /// Shakes hands, and returns the server's reply to `hello`. `client` names this program in the server's log.
    pub(super) fn shake_hands(
        &mut self,
        client: &str,
        timeout: Duration,
    ) -> Result<Vec<u8>, ConnectionError> {
        let hello = Request::Hello {
            protocol: VERSION,
            client: client.into(),
        };
        let hello = serde_json::to_vec(&hello).expect("invariant: requests serialise");
        let answer = self.ask(&hello, timeout)?;
        // In another PID namespace, the server's process id refers to another process or to none.
        let said: Common = serde_json::from_slice(&answer).map_err(|it| garbled("hello", it))?;
        if said
            .pid_namespace
            .is_some_and(|it| pid_namespace() != Some(it))
        {
            return Err(self.exchange.instance.elsewhere().into());
        }
        Ok(answer)
    }

    pub(super) fn ask(
        &mut self,
        text: &[u8],
        timeout: Duration,
    ) -> Result<Vec<u8>, ConnectionError> {
        if text.len() > SLICE {
            check_room_for_ports(text.len())?; // The request needs a new file.
        }
        self.sequence += 1;
        let (listener_low, listener_high) = self.exchange.listener_id();
        let header = ControlRequest {
            version: VERSION,
            reserved: 0,
            sequence: self.sequence,
            listener_low,
            listener_high,
        };
        let copy = |reply: &ControlReply, answer: &[u8]| (*reply, copied(WHAT, answer));
        let (client, exchange) = (&self.client, &self.exchange);
        let (reply, answer) = exchange.request(client, header, text, WHAT, timeout, copy)?;
        let answer = answer?;
        check_answer(WHAT, reply.version, (reply.sequence, self.sequence))?;
        if reply.status != 0 {
            let said: Common = serde_json::from_slice(&answer).unwrap_or_default();
            check_status(WHAT, reply.status, said.detail, said.message)?;
        }
        Ok(answer)
    }
}

fn server_process(
    service: &ControlService,
    instance: &Instance,
) -> Result<WatchedProcess, ChannelError> {
    let node = server_node(service).ok_or_else(|| no_server(instance))?;
    match WatchedProcess::open(node_pid(node)) {
        Ok(process) if !process.has_ended() => Ok(process),
        Ok(_) | Err(Errno::SRCH) if lives_elsewhere(node) => Err(instance.elsewhere()),
        Ok(_) | Err(Errno::SRCH) => Err(no_server(instance)),
        Err(errno) => Err(watch_error(errno)),
    }
}
