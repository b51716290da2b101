//! A learner outside: asks an agent for decisions as PROTOCOL.md says, byte by byte if need be.

use crate::harness::{PATIENCE, Program, eventually};
use crate::wire::{Pending, Requests, answer, client, control_header, send};
use iceoryx2::node::Node;
use iceoryx2::port::notifier::Notifier;
use protocol::channels::{Channel, ChannelError, Instance, Ipc, Services, create_node, ipc_error};
use protocol::decisions::{AgentInfo, Decision, Reply, Request};
use protocol::message::{ControlReply, ControlRequest, Status};
use std::time::Duration;

/// A learner that is connected to an agent.
pub struct Learner {
    port: Requests<ControlRequest, ControlReply>,
    agent: Notifier<Ipc>,
    _node: Node<Ipc>,
}

/// Starts an agent that serves decisions of world 0; `flags` are separated by spaces.
pub fn start_agent(instance: &Instance, flags: &str) -> Program {
    let name = ["serve-decisions", "--instance", instance.name()];
    let flags: Vec<&str> = name.into_iter().chain(flags.split_whitespace()).collect();
    Program::start("emberwatch-agent", &flags)
}

/// Starts an agent and waits until it answers.
pub fn start_with_learner(instance: &Instance, flags: &str) -> (Program, Learner) {
    let agent = start_agent(instance, flags);
    let learner = Learner::connect(instance, &agent);
    (agent, learner)
}

impl Learner {
    /// Waits for an agent and shakes hands.
    pub fn connect(instance: &Instance, agent: &Program) -> Self {
        let mut learner = None;
        let answers = eventually(PATIENCE, || {
            // One that was killed may have left its port.
            learner = Self::try_open(instance).ok();
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
            Reply::Decisions(info) => Some(info.pid),
            _ => None,
        }
    }

    /// Opens the channel of world 0, without a handshake.
    pub fn try_open(instance: &Instance) -> Result<Self, ChannelError> {
        let node = create_node()?;
        let services = Services {
            node: &node,
            instance,
        };
        let port = client(&services.open_decisions(0)?)?;
        let wake = services.wake(Channel::WakeAgent(0))?;
        let agent = wake.notifier_builder().create();
        Ok(Self {
            port,
            agent: agent.map_err(ipc_error("create a notifier"))?,
            _node: node,
        })
    }

    /// Sends bytes.
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

    /// Sends a request and waits for the reply.
    pub fn ask(&self, request: &Request) -> Reply {
        let text = serde_json::to_vec(request).expect("requests serialise");
        self.exchange(control_header(7), &text)
    }

    /// What the agent says of itself.
    pub fn hello(&self) -> AgentInfo {
        match self.ask(&hello()) {
            Reply::Decisions(info) => *info,
            other => panic!("expected a handshake, got {other:?}"),
        }
    }

    /// Starts an episode.
    pub fn reset(&self, seed: u64) -> Decision {
        decision(self.ask(&Request::Reset { seed: Some(seed) }))
    }

    /// Decides for an objective.
    pub fn decide(&self, objective: u64) -> Decision {
        decision(self.ask(&Request::Decide { objective }))
    }

    /// The last decision again.
    pub fn last(&self) -> Decision {
        decision(self.ask(&Request::Last {}))
    }

    /// Decides, and expects to be refused: status, detail and message.
    pub fn refused(&self, request: &Request) -> (Status, u64, String) {
        refusal(self.ask(request))
    }
}

fn hello() -> Request {
    Request::Hello {
        protocol: 1,
        client: "tests".into(),
    }
}

/// The reply to a request under way.
pub fn reply_to(pending: &Pending<ControlRequest, ControlReply>, header: ControlRequest) -> Reply {
    let (answered, payload) = answer(pending, PATIENCE).expect("an answer");
    assert_eq!((answered.version, answered.sequence), (1, header.sequence));
    let reply: Reply = serde_json::from_slice(&payload).expect("a reply");
    assert_eq!(Status::try_from(answered.status), Ok(reply.status()));
    reply
}

/// The decision of a reply.
pub fn decision(reply: Reply) -> Decision {
    match reply {
        Reply::Decision(decision) => decision,
        other => panic!("expected a decision, got {other:?}"),
    }
}

/// Status, detail and message of a refusal.
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
