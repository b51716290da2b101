//! Shared memory for a server's messages. A server starts only if there is enough for the maximum number of clients and
//! observers. The memory of each one is allocated when it connects. So a few clients use little memory, and the server
//! never writes to memory that the system cannot supply.

use super::port_config::PortConfig;
use anyhow::{Result, anyhow};
use emberwatch_protocol::channels::{
    ChannelError, FRAME_BUFFER, MAX_CLIENTS, MAX_OBSERVERS, MAX_TRUTH_READERS, TRUTH_BUFFER,
    check_room,
};
use emberwatch_protocol::responder::JSON_SLICE;
use emberwatch_protocol::shared_memory::MessageMemory;

/// Maximum overhead of iceoryx2 per message, in bytes.
const MESSAGE_OVERHEAD: usize = 512;

/// Size in bytes of the shared memory that does not depend on the settings: control messages, events and tables.
const FIXED_BYTES: u64 = 8 << 20;

/// Number of answers for which iceoryx2 reserves memory per client: three for each of 2 requests (one buffered, one
/// borrowed and one loaned).
const ANSWERS: usize = 2 * 3;

pub struct PortMemory {
    control: MessageMemory,
    step: MessageMemory,
    frames: MessageMemory,
    truth: Option<MessageMemory>,
}

pub struct PortIds {
    pub control: u128,
    pub step: u128,
    pub frames: u128,
    pub truth: Option<u128>,
}

impl PortMemory {
    pub fn new(ids: &PortIds, config: &PortConfig) -> Result<Self, ChannelError> {
        let n_answers = MAX_CLIENTS * ANSWERS;
        let truth = ids.truth.map(|id| {
            let n_truths = samples(MAX_TRUTH_READERS, TRUTH_BUFFER);
            MessageMemory::of(id, n_truths, config.n_cells)
        });
        let n_frames = samples(MAX_OBSERVERS, FRAME_BUFFER);
        let memory = Self {
            control: MessageMemory::of(ids.control, n_answers, JSON_SLICE)?,
            step: MessageMemory::of(ids.step, n_answers, config.answer_bytes)?,
            frames: MessageMemory::of(ids.frames, n_frames, config.frame_bytes)?,
            truth: truth.transpose()?,
        };
        memory.for_clients(1)?;
        Ok(memory)
    }

    pub fn for_clients(&self, n_clients: usize) -> Result<(), ChannelError> {
        self.control.make_ready(n_clients * ANSWERS)?;
        self.step.make_ready(n_clients * ANSWERS)
    }

    pub fn for_observers(&self, n_observers: usize) -> Result<(), ChannelError> {
        self.frames.make_ready(samples(n_observers, FRAME_BUFFER))
    }

    pub fn for_readers(&self, n_readers: usize) -> Result<(), ChannelError> {
        let n_truths = samples(n_readers, TRUTH_BUFFER);
        self.truth
            .as_ref()
            .map_or(Ok(()), |it| it.make_ready(n_truths))
    }
}

/// Returns the maximum number of samples that exist at once. Each subscriber can occupy a full buffer and the sample
/// that it is reading. The publisher occupies the last sample and the next one.
fn samples(n_subscribers: usize, buffer: usize) -> usize {
    n_subscribers * (buffer + 1) + 2
}

pub fn check_shared_memory(config: &PortConfig) -> Result<()> {
    let bytes =
        |n_messages: usize, length: usize| (n_messages * (length + MESSAGE_OVERHEAD)) as u64;
    let answers = bytes(MAX_CLIENTS * ANSWERS, config.answer_bytes);
    let frames = bytes(samples(MAX_OBSERVERS, FRAME_BUFFER), config.frame_bytes);
    let truth = bytes(samples(MAX_TRUTH_READERS, TRUTH_BUFFER), config.n_cells);
    let needed = FIXED_BYTES + answers + frames + if config.publish_truth { truth } else { 0 };
    check_room(needed, answers.max(frames).max(truth))
        .map_err(|error| anyhow!("{error}, or serve fewer worlds or robots, or a smaller grid"))
}
