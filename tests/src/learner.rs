//! A learner outside: asks an agent for decisions as PROTOCOL.md says, byte by byte if need be.

use crate::harness::{AGENT, PATIENCE, Program, eventually, seed};
use crate::wire::{
    ControlAnswer, Pending, Requests, answer, answer_by, client, control_header, send,
};
use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use emberwatch_protocol::channels::{
    Channel, ChannelError, Instance, Ipc, Services, create_node, ipc_error,
};
use emberwatch_protocol::decisions::{AgentInfo, Decision, Reply, Request};
use emberwatch_protocol::message::{ControlReply, ControlRequest, Status, VERSION};
use emberwatch_protocol::wait::{Waiter, descriptor, drain, sleep_until_readable};
use iceoryx2::node::Node;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use std::time::Duration;

pub struct Learner {
    port: Requests<ControlRequest, ControlReply>,
    agent: Notifier<Ipc>,
    listener: Listener<Ipc>,
    waiter: Waiter,
    _node: Node<Ipc>,
}

/// Starts an agent that serves decisions, of world 0 unless told otherwise; `flags` are separated by spaces.
pub fn start_agent(instance: &Instance, flags: &str) -> Program {
    let name = instance.name();
    Program::start(AGENT, &format!("serve-decisions --instance {name} {flags}"))
}

/// Starts an agent and waits until it answers.
pub fn start_with_learner(instance: &Instance, flags: &str) -> (Program, Learner) {
    start_at(instance, 0, flags)
}

/// The same for an agent whose first world is another.
pub fn start_at(instance: &Instance, world: u32, flags: &str) -> (Program, Learner) {
    let agent = start_agent(instance, &format!("--world {world} {flags}"));
    let learner = Learner::connect(instance, world, &agent);
    (agent, learner)
}

impl Learner {
    /// Waits for an agent and shakes hands.
    fn connect(instance: &Instance, world: u32, agent: &Program) -> Self {
        let mut learner = None;
        let answers = eventually(PATIENCE, || {
            // One that was killed may have left its port.
            learner = Self::try_open_at(instance, world).ok();
            learner.as_ref().and_then(Self::pid) == Some(agent.pid())
        });
        assert!(answers, "{}", agent.stderr());
        learner.expect("connected")
    }

    /// Who answers, if anybody does within a second.
    fn pid(&self) -> Option<u32> {
        let text = serde_json::to_vec(&hello()).expect("requests serialise");
        let pending = self.send(control_header(7), &text);
        let (_, reply) = answer(&pending, Duration::from_secs(1))?;
        match serde_json::from_slice(&reply).expect("a reply") {
            Reply::Hello(info) => Some(info.pid),
            _ => None,
        }
    }

    /// Opens the channel of world 0, without a handshake.
    pub fn try_open(instance: &Instance) -> Result<Self, ChannelError> {
        Self::try_open_at(instance, 0)
    }

    fn try_open_at(instance: &Instance, world: u32) -> Result<Self, ChannelError> {
        let node = create_node()?;
        let services = Services {
            node: &node,
            instance,
        };
        let port = client(&services.open_decisions(world)?)?;
        let wake = services.wake(Channel::WakeAgent(world))?;
        let agent = wake.notifier_builder().create();
        Ok(Self {
            port,
            agent: agent.map_err(ipc_error("create a notifier"))?,
            listener: services.listener(Channel::WakeClient)?,
            waiter: Waiter::default(),
            _node: node,
        })
    }

    pub fn send(
        &self,
        header: ControlRequest,
        payload: &[u8],
    ) -> Pending<ControlRequest, ControlReply> {
        let pending = send(&self.port, header, payload).expect("send a request");
        self.agent.notify().expect("wake the agent");
        pending
    }

    /// Sends bytes and waits for the reply; its status must be the header's.
    pub fn exchange(&self, header: ControlRequest, payload: &[u8]) -> Reply {
        reply_to(&self.send(header, payload), header)
    }

    /// Sends a request and waits for the reply as PROTOCOL.md says: until it is woken.
    pub fn ask(&self, request: &Request) -> Reply {
        let text = serde_json::to_vec(request).expect("requests serialise");
        let id = self.listener.id().value();
        let header = ControlRequest {
            listener_low: id as u64,
            listener_high: (id >> 64) as u64,
            ..control_header(7)
        };
        let pending = self.send(header, &text);
        let block = |limit| {
            if !drain(&self.listener)? {
                sleep_until_readable(&[descriptor(&self.listener)], limit).expect("sleep");
            }
            Ok::<_, ChannelError>(())
        };
        let answered = answer_by(&pending, PATIENCE, &self.waiter, block);
        checked(answered.expect("an answer"), header)
    }

    pub fn hello(&self) -> AgentInfo {
        match self.ask(&hello()) {
            Reply::Hello(info) => *info,
            other => panic!("expected a handshake, got {other:?}"),
        }
    }

    pub fn reset(&self, seed: u64) -> Decision {
        one(self.reset_some(&[(0, seed)]))
    }

    /// Starts episodes in some worlds.
    pub fn reset_some(&self, seeds: &[(u32, u64)]) -> Vec<Decision> {
        decisions(self.ask(&reset(seeds)))
    }

    pub fn decide(&self, objective: u64) -> Decision {
        one(self.decide_all(&[Some(objective)]))
    }

    /// Decides for an objective in each world that has one.
    pub fn decide_all(&self, objectives: &[Option<u64>]) -> Vec<Decision> {
        decisions(self.ask(&decide(objectives)))
    }

    /// The last decision of the one world again.
    pub fn last(&self) -> Decision {
        one(self.last_of_all())
    }

    /// The last decision of each world again.
    pub fn last_of_all(&self) -> Vec<Decision> {
        decisions(self.ask(&Request::Last {}))
    }

    /// Decides, and expects to be refused: status, detail and message.
    pub fn refused(&self, request: &Request) -> (Status, u64, String) {
        refusal(self.ask(request))
    }
}

pub fn reset(seeds: &[(u32, u64)]) -> Request {
    let seeds = seeds.iter().map(|&(world, to)| seed(world, to));
    Request::Reset {
        worlds: seeds.collect(),
    }
}

pub fn decide(objectives: &[Option<u64>]) -> Request {
    Request::Decide {
        objectives: objectives.to_vec(),
    }
}

fn hello() -> Request {
    Request::Hello {
        protocol: VERSION,
        client: "tests".into(),
    }
}

/// The reply to a request under way.
pub fn reply_to(pending: &Pending<ControlRequest, ControlReply>, header: ControlRequest) -> Reply {
    checked(answer(pending, PATIENCE).expect("an answer"), header)
}

fn checked((answered, payload): ControlAnswer, header: ControlRequest) -> Reply {
    assert_eq!(
        (answered.version, answered.sequence),
        (VERSION, header.sequence)
    );
    let reply: Reply = serde_json::from_slice(&payload).expect("a reply");
    assert_eq!(Status::try_from(answered.status), Ok(reply.status()));
    reply
}

pub fn decisions(reply: Reply) -> Vec<Decision> {
    match reply {
        Reply::Decisions { worlds } => worlds,
        other => panic!("expected decisions, got {other:?}"),
    }
}

/// The numbers that describe the plans after a decision.
pub fn features(decision: &Decision) -> Vec<f32> {
    let bytes = BASE64.decode(&decision.features).expect("base64");
    let numbers = bytes.chunks_exact(4).map(|bytes| bytes.try_into());
    let numbers = numbers.map(|bytes| f32::from_le_bytes(bytes.expect("four bytes")));
    numbers.collect()
}

fn one(mut decisions: Vec<Decision>) -> Decision {
    assert_eq!(decisions.len(), 1);
    decisions.remove(0)
}

pub fn refusal(reply: Reply) -> (Status, u64, String) {
    match reply {
        Reply::Error {
            status,
            detail,
            message,
        } => (status, detail, message),
        other => panic!("expected a refusal, got {other:?}"),
    }
}
