//! An observer's side of `frames` and `truth`: it reads, never acts, and never slows the server.

use crate::channels::{
    Channel, ChannelError, FRAME_BUFFER, Instance, Ipc, Services, TRUTH_BUFFER, create_node,
    ipc_error,
};
use crate::message::{FrameHeader, Header, TruthHeader};
use crate::wait::Waiter;
use iceoryx2::node::Node;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::PayloadHeader;
use std::cell::Cell;
use std::time::Duration;

/// How long an observer sleeps between two looks: publishing wakes nobody, so that observers cost
/// the server no system call.
const LOOK_INTERVAL: Duration = Duration::from_micros(200);

/// A sample copied out of shared memory.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample<H> {
    /// The binary header.
    pub header: H,
    /// The bytes behind it.
    pub payload: Vec<u8>,
}

/// Reads one channel of an instance, before, while and after a server runs.
pub struct Observer<H: Header> {
    subscriber: Subscriber<Ipc, [u8], H>,
    publisher: Cell<Option<u32>>,
    waiter: Waiter,
    _node: Node<Ipc>,
}

impl Observer<FrameHeader> {
    /// Reads the frames of an instance; the server publishes every world's current one at once.
    ///
    /// # Errors
    /// [`ChannelError`], also when there are too many observers.
    pub fn frames(instance: &Instance) -> Result<Self, ChannelError> {
        let node = create_node()?;
        let services = Services {
            node: &node,
            instance,
        };
        let subscriber = services
            .frames()?
            .subscriber_builder()
            .buffer_size(FRAME_BUFFER)
            .create();
        let subscriber = subscriber.map_err(ipc_error(
            "observe frames (are there more than 16 observers?)",
        ))?;
        wake_server(&services)?;
        Ok(Self {
            subscriber,
            publisher: Cell::new(None),
            waiter: Waiter::default(),
            _node: node,
        })
    }
}

impl Observer<TruthHeader> {
    /// Reads the hidden states of an instance, if its server publishes them.
    ///
    /// # Errors
    /// [`ChannelError`], also when there are too many readers.
    pub fn truth(instance: &Instance) -> Result<Self, ChannelError> {
        let node = create_node()?;
        let services = Services {
            node: &node,
            instance,
        };
        let subscriber = services
            .truth()?
            .subscriber_builder()
            .buffer_size(TRUTH_BUFFER)
            .create();
        let subscriber =
            subscriber.map_err(ipc_error("read the truth (are there more than 4 readers?)"))?;
        wake_server(&services)?;
        Ok(Self {
            subscriber,
            publisher: Cell::new(None),
            waiter: Waiter::default(),
            _node: node,
        })
    }
}

impl<H: Header> Observer<H> {
    /// The next sample; `None` if none came in time. Gaps in the headers' sequence numbers are
    /// samples that this observer was too slow for.
    ///
    /// # Errors
    /// [`ChannelError::Ipc`].
    pub fn receive(&self, timeout: Duration) -> Result<Option<Sample<H>>, ChannelError> {
        let poll = || self.try_receive();
        self.waiter.wait(timeout, poll, |remaining| {
            std::thread::sleep(remaining.min(LOOK_INTERVAL));
            Ok(())
        })
    }

    /// The next sample, if there is one already.
    ///
    /// # Errors
    /// [`ChannelError::Ipc`].
    pub fn try_receive(&self) -> Result<Option<Sample<H>>, ChannelError> {
        let sample = self
            .subscriber
            .receive()
            .map_err(ipc_error("receive a sample"))?;
        Ok(sample.map(|sample| {
            let pid = sample.header().node_id().pid::<Ipc>();
            self.publisher.set(pid.ok().map(|id| id.value() as u32));
            Sample {
                header: *sample.user_header(),
                payload: sample.payload().to_vec(),
            }
        }))
    }

    /// The process that published the sample received last, the server's.
    pub fn publisher(&self) -> Option<u32> {
        self.publisher.get()
    }
}

/// Lets a sleeping server notice the new observer now rather than at its next tick.
fn wake_server(services: &Services<'_>) -> Result<(), ChannelError> {
    let notifier = services
        .wake(Channel::WakeServer)?
        .notifier_builder()
        .create();
    notifier
        .map_err(ipc_error("create a notifier"))?
        .notify()
        .map_err(ipc_error("wake the server"))?;
    Ok(())
}
