//! An observer's side of `frames`, `truth` and `agent`: it only reads, and never slows the server.

use super::channels::{
    AGENT_BUFFER, Channel, ChannelError, Entries, FRAME_BUFFER, Instance, Ipc, Publications,
    Services, TRUTH_BUFFER, WireHeader, create_node, ipc_error, limited_error,
};
use super::node::Opened;
use super::resources::{OBSERVER_DESCRIPTORS, check_descriptors};
use super::shared_memory::fill_ports;
use super::turn::Turn;
use emberwatch_messages::errors::{ConnectionError, garbled};
use emberwatch_messages::interrupt::check_interrupt;
use emberwatch_messages::message::{AgentHeader, FrameHeader, Published, TruthHeader, VERSION};
pub use emberwatch_messages::sample::Sample;
use iceoryx2::node::Node;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::PayloadHeader;
use std::cell::{Cell, RefCell};
use std::collections::HashMap;
use std::time::{Duration, Instant};

/// Time that an observer sleeps between two polls while it is busy. Publishing wakes no observer, so observers cost the
/// server no system call. Observers do not spin either, because spinning would take processor time from the server. At
/// 128,000 frames per second, [`FRAME_BUFFER`] fills up within this time.
const BUSY_INTERVAL: Duration = Duration::from_micros(500);

/// Time that an observer sleeps between two polls while it is idle. Each poll wakes a process, on a core that the
/// server may need.
const IDLE_INTERVAL: Duration = Duration::from_millis(4);

/// Time that an observer stays busy after it was opened, and after it found more than a quarter of its buffer full.
const BUSY: Duration = Duration::from_secs(1);

type Ports<H> = (Subscriber<Ipc, [u8], WireHeader<H>>, Node<Ipc>);

/// A reader of one channel of an instance. It can be opened before the server starts.
pub struct Observer<H: Published> {
    ports: Opened<Ports<H>>,
    publisher: Cell<Option<u32>>,
    gaps: RefCell<Gaps>,
    polling: Polling,
}

#[derive(Debug, Default)]
struct Gaps {
    /// The number that is expected next from each process that publishes. A new process begins a new sequence.
    next: HashMap<Option<u32>, u64>,
    n_lost: u64,
}

impl Gaps {
    fn pass(&mut self, publisher: Option<u32>, sequence: u64) {
        let next = self.next.insert(publisher, sequence.saturating_add(1));
        let lost = next.map_or(0, |next| sequence.saturating_sub(next));
        self.n_lost = self.n_lost.saturating_add(lost);
    }
}

#[derive(Debug)]
struct Polling {
    buffer: usize,
    is_eager: bool,
    n_found: Cell<usize>,
    busy: Cell<Instant>,
}

impl Observer<FrameHeader> {
    /// Opens the frames of an instance. The server then immediately publishes the current frame of every world.
    ///
    /// # Errors
    /// If the channel cannot be opened, or has too many observers.
    pub fn frames(instance: &Instance) -> Result<Self, ChannelError> {
        let frames = |services: &Services<'_>| services.frames();
        Self::new(instance, frames, FRAME_BUFFER, "16 observers", true)
    }
}

impl Observer<TruthHeader> {
    /// Opens the hidden states of an instance. They arrive only if the instance's server publishes them.
    ///
    /// # Errors
    /// If the channel cannot be opened, or has too many readers.
    pub fn truth(instance: &Instance) -> Result<Self, ChannelError> {
        let truth = |services: &Services<'_>| services.truth();
        Self::new(
            instance,
            truth,
            TRUTH_BUFFER,
            "4 readers of the truth",
            true,
        )
    }
}

impl Observer<AgentHeader> {
    /// Opens the beliefs of an instance's agents. [`super::agent_belief::AgentBelief`] checks each sample.
    ///
    /// # Errors
    /// If the channel cannot be opened, or has too many readers.
    pub fn agents(instance: &Instance) -> Result<Self, ChannelError> {
        let agent = |services: &Services<'_>| services.agent();
        Self::new(instance, agent, AGENT_BUFFER, "4 readers of beliefs", false)
    }
}

impl<H: Published> Observer<H> {
    fn new(
        instance: &Instance,
        service: impl FnOnce(&Services<'_>) -> Result<Publications<H>, ChannelError>,
        buffer: usize,
        most: &'static str,
        is_of_server: bool,
    ) -> Result<Self, ChannelError> {
        let _turn = Turn::take()?;
        check_descriptors("observe an instance", OBSERVER_DESCRIPTORS)?;
        let node = create_node()?;
        let services = Services {
            node: &node,
            instance,
        };
        let service = service(&services)?;
        let subscriber = service.subscriber_builder().buffer_size(buffer).create();
        let subscriber = subscriber.map_err(limited_error("observe an instance", most))?;
        if is_of_server {
            wake_server(&services)?;
        }
        fill_ports(&node, true)?;
        let now = Instant::now();
        Ok(Self {
            ports: Opened::new(Entries::of(&node)?, (subscriber, node)),
            publisher: Cell::new(None),
            gaps: RefCell::default(),
            polling: Polling {
                buffer,
                is_eager: false,
                n_found: Cell::new(0),
                busy: Cell::new(now),
            },
        })
    }

    /// Makes the observer always poll every 500 us. Use it if the first samples after a pause must not be lost: between
    /// two polls of an idle observer, which are 4 ms apart, the server may publish more samples than the buffer can
    /// hold.
    #[must_use]
    pub fn eager(mut self) -> Self {
        self.polling.is_eager = true;
        self
    }

    /// Waits for the next sample. Returns `None` if no sample arrived in time. A gap in the headers' sequence numbers
    /// means that this observer was too slow and lost samples.
    ///
    /// # Errors
    /// If iceoryx2 cannot read the channel, or its files were removed.
    pub fn receive(&self, timeout: Duration) -> Result<Option<Sample<H>>, ChannelError> {
        let start = Instant::now();
        loop {
            let sample = self.try_receive()?;
            let remaining = timeout.saturating_sub(start.elapsed());
            if sample.is_some() || remaining.is_zero() {
                return Ok(sample);
            }
            std::thread::sleep(remaining.min(self.polling.interval(Instant::now())));
            check_interrupt()?;
        }
    }

    pub fn try_receive(&self) -> Result<Option<Sample<H>>, ChannelError> {
        let (subscriber, _) = &*self.ports;
        let sample = subscriber
            .receive()
            .map_err(ipc_error("receive a sample"))?;
        if sample.is_none() {
            self.ports.check()?;
        }
        let n_found = &self.polling.n_found;
        Ok(sample.map(|sample| {
            n_found.set(n_found.get() + 1);
            let pid = sample.header().node_id().pid::<Ipc>();
            let pid = pid.ok().map(|id| id.value() as u32);
            self.publisher.set(pid);
            let header = sample.user_header().0;
            self.gaps.borrow_mut().pass(pid, header.sequence());
            Sample {
                header,
                payload: sample.payload().to_vec(),
            }
        }))
    }

    /// Waits for the next sample of a world, or of any world. Returns it with the number of samples lost since the last
    /// one returned, or `None` if no sample arrived in time.
    ///
    /// # Errors
    /// As for [`Self::receive`], and [`ConnectionError::Garbled`] for a sample of another protocol version.
    pub fn next_of(
        &self,
        world: Option<u32>,
        timeout: Duration,
    ) -> Result<Option<(Sample<H>, u64)>, ConnectionError> {
        let start = Instant::now();
        loop {
            let left = timeout.saturating_sub(start.elapsed());
            let Some(sample) = self.receive(left)? else {
                return Ok(None);
            };
            let version = sample.header.version();
            if version != VERSION {
                let problem = format!("expected version {VERSION}, got {version}");
                return Err(garbled("sample", problem));
            }
            if world.is_none_or(|world| world == sample.header.world()) {
                return Ok(Some((sample, self.take_lost())));
            }
        }
    }

    /// Returns the number of samples lost before the last received one, since the last call.
    pub fn take_lost(&self) -> u64 {
        std::mem::take(&mut self.gaps.borrow_mut().n_lost)
    }

    /// Returns the process id of the server or agent that published the last received sample.
    pub fn publisher(&self) -> Option<u32> {
        self.publisher.get()
    }
}

impl Polling {
    fn interval(&self, now: Instant) -> Duration {
        if self.n_found.replace(0) > self.buffer / 4 {
            self.busy.set(now);
        }
        if self.is_eager || now.duration_since(self.busy.get()) < BUSY {
            BUSY_INTERVAL
        } else {
            IDLE_INTERVAL
        }
    }
}

/// Wakes a sleeping server, so that it notices the new observer at once.
fn wake_server(services: &Services<'_>) -> Result<(), ChannelError> {
    let wake = services.wake(Channel::WakeServer)?;
    let notifier = wake.notifier_builder().create();
    let notified = notifier.map_err(ipc_error("create a notifier"))?.notify();
    notified.map(drop).map_err(ipc_error("wake the server"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_are_counted_per_publisher() {
        let mut gaps = Gaps::default();
        let row = [(1, 7), (1, 8), (1, 11), (1, 11), (2, 90), (2, 92), (1, 12)];
        let missing = row.map(|(publisher, sequence)| {
            gaps.pass(Some(publisher), sequence);
            std::mem::take(&mut gaps.n_lost)
        });
        assert_eq!(missing, [0, 0, 2, 0, 0, 1, 0]);
    }

    #[test]
    fn an_observer_polls_often_until_a_second_after_it_was_busy() {
        let began = Instant::now();
        let mut polling = Polling {
            buffer: 64,
            is_eager: false,
            n_found: Cell::new(0),
            busy: Cell::new(began),
        };
        let later = |seconds: f64| began + Duration::from_secs_f64(seconds);
        assert_eq!(
            polling.interval(later(0.9)),
            BUSY_INTERVAL,
            "it has just begun"
        );
        polling.n_found.set(16);
        assert_eq!(polling.interval(later(1.1)), IDLE_INTERVAL);
        polling.n_found.set(17);
        assert_eq!(polling.interval(later(2.0)), BUSY_INTERVAL);
        assert_eq!(polling.interval(later(2.9)), BUSY_INTERVAL);
        assert_eq!(polling.interval(later(3.1)), IDLE_INTERVAL);
        polling.is_eager = true;
        assert_eq!(polling.interval(later(9.0)), BUSY_INTERVAL);
    }
}
