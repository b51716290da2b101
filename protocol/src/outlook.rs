//! What an agent believes and wants, for whoever looks on: the channel `agent`.
//!
//! A [`Showcase`] is the agent's side; it costs next to nothing while nobody looks. An [`Outlook`] is what
//! a reader makes of a sample.

use crate::channels::{
    AgentService, ChannelError, Instance, Ipc, Services, create_node, ipc_error,
};
use crate::grid::{Probabilities, Shape};
use crate::message::{AgentHeader, VERSION};
use crate::observer::Sample;
use crate::turn::Turn;
use iceoryx2::node::Node;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::prelude::{AllocationStrategy, PortFactory};
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Most states of a belief that is shown.
pub const MAX_STATES: u32 = 256;

/// Longest text of what an agent wants, bytes.
pub const MAX_INTENT_BYTES: usize = 65_536;

/// What an agent wants, and how it goes about it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Intent {
    /// Its policy's name.
    pub policy: String,
    /// Where its belief comes from.
    pub belief_from: String,
    /// What the path that was just flown was for.
    pub objective: String,
    /// Names of the belief's states.
    pub states: Vec<String>,
    /// Time that the path's plan took, milliseconds.
    pub plan_millis: f64,
}

/// One sample of `agent`, checked.
#[derive(Debug, Clone, PartialEq)]
pub struct Outlook {
    /// World, episode, step, process.
    pub header: AgentHeader,
    /// The belief about the state at that step, the posterior; shape `[S, H, W]`, each in 0..=1.
    pub belief: Probabilities,
    /// What it wants.
    pub intent: Intent,
}

/// A sample that is no outlook.
#[derive(Debug, Error, PartialEq, Eq)]
#[error("sample of an agent: {problem}")]
pub struct GarbledOutlook {
    /// What was expected, what was got.
    problem: String,
}

/// An agent's side of the channel.
#[derive(Debug)]
pub struct Showcase {
    service: AgentService,
    publisher: Publisher<Ipc, [u8], AgentHeader>,
    sequence: u64,
    _node: Node<Ipc>,
    /// Last, so that all else is dropped within it.
    end: Option<Turn>,
}

impl Drop for Showcase {
    fn drop(&mut self) {
        self.end = Turn::take().ok();
    }
}

impl Showcase {
    /// Opens the channel, for beliefs of so many bytes or more.
    ///
    /// # Errors
    /// [`ChannelError`], also when there are too many agents.
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
            .map_err(ipc_error(
                "publish beliefs (are there more than 16 agents?)",
            ))?;
        Ok(Self {
            service,
            publisher,
            sequence: 0,
            _node: node,
            end: None,
        })
    }

    /// Whether anybody looks.
    pub fn is_watched(&self) -> bool {
        self.service.dynamic_config().number_of_subscribers() > 0
    }

    /// Shows a belief of shape `[S, H, W]`; of the header, world, episode, step and seed are taken.
    ///
    /// # Errors
    /// [`ChannelError::Ipc`].
    pub fn show(
        &mut self,
        about: AgentHeader,
        belief: &Probabilities,
        intent: &Intent,
    ) -> Result<(), ChannelError> {
        let (n_states, height, width) = belief.dim();
        let text = serde_json::to_vec(intent).expect("invariant: an intent serialises");
        let n_bytes = belief.len() * size_of::<f32>() + text.len();
        let mut sample = self
            .publisher
            .loan_slice(n_bytes)
            .map_err(ipc_error("loan a sample"))?;
        *sample.user_header_mut() = AgentHeader {
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

impl TryFrom<&Sample<AgentHeader>> for Outlook {
    type Error = GarbledOutlook;

    fn try_from(sample: &Sample<AgentHeader>) -> Result<Self, GarbledOutlook> {
        let garbled = |problem: String| GarbledOutlook { problem };
        let header = sample.header;
        if header.version != VERSION {
            let got = header.version;
            return Err(garbled(format!("version: expected {VERSION}, got {got}")));
        }
        let shape = Shape::new(header.height as usize, header.width as usize)
            .map_err(|error| garbled(error.to_string()))?;
        if !(1..=MAX_STATES).contains(&header.n_states) {
            let got = header.n_states;
            return Err(garbled(format!(
                "states: expected 1 to {MAX_STATES}, got {got}"
            )));
        }
        let n_numbers = header.n_states as usize * shape.n_cells();
        let (numbers, text) = sample
            .payload
            .split_at_checked(n_numbers * size_of::<f32>())
            .ok_or_else(|| {
                let got = sample.payload.len();
                garbled(format!(
                    "belief: expected {n_numbers} numbers, got {got} bytes"
                ))
            })?;
        if text.len() > MAX_INTENT_BYTES {
            let got = text.len();
            return Err(garbled(format!(
                "intent: expected at most {MAX_INTENT_BYTES} bytes, got {got}"
            )));
        }
        let numbers: Vec<f32> = numbers
            .chunks_exact(size_of::<f32>())
            .map(bytemuck::pod_read_unaligned)
            .collect();
        if let Some(got) = numbers.iter().find(|p| !(0.0..=1.0).contains(*p)) {
            return Err(garbled(format!(
                "belief: expected probabilities, got {got}"
            )));
        }
        let (height, width) = shape.dim();
        Ok(Self {
            header,
            belief: Probabilities::from_shape_vec(
                (header.n_states as usize, height, width),
                numbers,
            )
            .expect("invariant: counted above"),
            intent: serde_json::from_slice(text)
                .map_err(|error| garbled(format!("intent: {error}")))?,
        })
    }
}
