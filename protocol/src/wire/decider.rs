//! A client of an agent that serves decisions: it chooses the objective of the next path in each world.

use super::channels::{Channel, Entries, Instance, Services, create_node};
use super::connection::{ConnectionError, unexpected};
use super::decisions::{AgentInfo, Reply};
use super::exchange::garbled;
use super::node::Opened;
use super::resources::{CLIENT_DESCRIPTORS, check_descriptors};
use super::shared_memory::fill_ports;
use super::texts::TextPort;
use super::turn::Turn;
use std::time::{Duration, Instant};

/// A connection to the agent of some worlds, which takes the requests in [`super::decisions`] as JSON text.
pub struct Decider {
    port: Opened<TextPort>,
    info: AgentInfo,
}

impl Decider {
    /// Connects to the agent whose first world is `world`, and shakes hands.
    ///
    /// # Errors
    /// If no agent serves its decisions, it speaks another version, or it does not answer in time.
    pub fn open(
        instance: &Instance,
        world: u32,
        client: &str,
        timeout: Duration,
    ) -> Result<Self, ConnectionError> {
        let start = Instant::now();
        let mut port = Self::open_port(instance, world, timeout)?;
        let left = timeout.saturating_sub(start.elapsed());
        let hello = port.shake_hands(client, left)?;
        match serde_json::from_slice(&hello).map_err(|it| garbled("hello", it))? {
            Reply::Hello(info) => Ok(Self { port, info: *info }),
            other => Err(unexpected("hello", &other)),
        }
    }

    fn open_port(
        instance: &Instance,
        world: u32,
        limit: Duration,
    ) -> Result<Opened<TextPort>, ConnectionError> {
        let _turn = Turn::take_within(limit)?; // declared first: what fails below is dropped within it
        check_descriptors("connect", CLIENT_DESCRIPTORS)?;
        let node = create_node()?;
        let services = Services {
            node: &node,
            instance,
        };
        let service = services.open_decisions(world)?;
        let port = TextPort::create(node, instance, &service, Channel::WakeAgent(world))?;
        fill_ports(&port.exchange.node, true)?;
        Ok(Opened::new(Entries::of(&port.exchange.node)?, port))
    }

    /// What the agent said of itself.
    pub fn info(&self) -> &AgentInfo {
        &self.info
    }

    /// Asks it; returns the text of its answer.
    ///
    /// # Errors
    /// If it refuses, has ended, or gives no good answer in time.
    pub fn ask(&mut self, text: &[u8], timeout: Duration) -> Result<Vec<u8>, ConnectionError> {
        self.port.ask(text, timeout)
    }
}
