//! The channel `agent`: the beliefs that agents publish for displays.
//!
//! An agent has a [`BeliefPublisher`], which costs almost nothing without readers. A reader decodes each sample to an
//! [`AgentBelief`].

use super::channels::{
    AGENT_BUFFER, AgentService, ChannelError, Entries, Instance, Ipc, MAX_AGENT_READERS, Services,
    WireHeader, create_node, ipc_error, limited_error,
};
use super::node::Opened;
use super::resources::check_room_for_ports;
use super::shared_memory::{MessageMemory, fill_ports};
use super::turn::Turn;
use emberwatch_messages::message::{AgentHeader, VERSION};
use emberwatch_model::grid::Probabilities;
use iceoryx2::node::Node;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::prelude::{AllocationStrategy, PortFactory};

pub use emberwatch_messages::agent_belief::{
    AgentBelief, BeliefError, Intent, MAX_INTENT_BYTES, MAX_STATES,
};

#[derive(Debug)]
pub struct BeliefPublisher {
    ports: Opened<Ports>,
    sequence: u64,
}

#[derive(Debug)]
struct Ports {
    service: AgentService,
    memory: MessageMemory,
    n_bytes: usize,
    publisher: Publisher<Ipc, [u8], WireHeader<AgentHeader>>,
    _node: Node<Ipc>,
}

impl BeliefPublisher {
    /// Opens the channel. `n_bytes` is the size of the first sample in bytes; later samples may be larger.
    ///
    /// # Errors
    /// If the channel cannot be opened, or has too many agents.
    pub fn open(instance: &Instance, n_bytes: usize) -> Result<Self, ChannelError> {
        let _turn = Turn::take()?;
        let node = create_node()?;
        let service = Services {
            node: &node,
            instance,
        }
        .agent()?;
        let publisher = service
            .publisher_builder()
            .initial_max_slice_len(n_bytes)
            .allocation_strategy(AllocationStrategy::PowerOfTwo)
            .max_loaned_samples(1)
            .create()
            .map_err(limited_error("publish beliefs", "16 agents"))?;
        let memory = MessageMemory::of(
            publisher.id().value(),
            n_messages(MAX_AGENT_READERS),
            n_bytes,
        )?;
        fill_ports(&node, false)?;
        let entries = Entries::of(&node)?;
        let ports = Ports {
            service,
            memory,
            n_bytes,
            publisher,
            _node: node,
        };
        Ok(Self {
            ports: Opened::new(entries, ports),
            sequence: 0,
        })
    }

    /// Returns whether there are readers. Also returns true if the channel's files were removed, so that [`Self::show`]
    /// is called and reports the error.
    pub fn is_watched(&self) -> bool {
        self.ports.check().is_err()
            || self.ports.service.dynamic_config().number_of_subscribers() > 0
    }

    /// Publishes a belief of shape `[S, H, W]`. The caller fills in the world, robots, episode, step and seed of
    /// `about`.
    ///
    /// # Errors
    /// If iceoryx2 cannot publish it, or the channel's files were removed.
    pub fn show(
        &mut self,
        about: AgentHeader,
        belief: &Probabilities,
        intent: &Intent,
    ) -> Result<(), ChannelError> {
        self.ports.check()?;
        let (n_states, height, width) = belief.dim();
        let text = serde_json::to_vec(intent).expect("invariant: an intent serialises");
        let n_bytes = belief.len() * size_of::<f32>() + text.len();
        if n_bytes <= self.ports.n_bytes {
            let n_readers = self.ports.service.dynamic_config().number_of_subscribers();
            self.ports.memory.make_ready(n_messages(n_readers))?;
        } else {
            check_room_for_ports(n_bytes)?; // The sample needs a new file.
        }
        let mut sample = self
            .ports
            .publisher
            .loan_slice(n_bytes)
            .map_err(ipc_error("loan a sample"))?;
        sample.user_header_mut().0 = AgentHeader {
            version: VERSION,
            sequence: self.sequence,
            height: height as u32,
            width: width as u32,
            n_states: n_states as u32,
            pid: std::process::id(),
            ..about
        };
        let (numbers, words) = sample.payload_mut().split_at_mut(n_bytes - text.len());
        for (bytes, number) in numbers.chunks_exact_mut(size_of::<f32>()).zip(belief) {
            bytes.copy_from_slice(&number.to_ne_bytes());
        }
        words.copy_from_slice(&text);
        sample.send().map_err(ipc_error("publish a belief"))?;
        self.sequence += 1;
        Ok(())
    }
}

/// Returns the maximum number of samples in use at a time. Each reader uses its buffer and the sample that it is
/// reading. The publisher uses the last sample and the next one.
fn n_messages(n_readers: usize) -> usize {
    n_readers * (AGENT_BUFFER + 1) + 2
}
