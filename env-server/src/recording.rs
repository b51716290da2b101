//! An observer that records what an instance publishes.
//!
//! One thread reads the channels without delay; another compresses and writes. Gaps in the sequence numbers reveal lost
//! samples. Their number is stored in the next record, and their total in the end record.
//!
//! In a file, a frame of 64 x 64 cells with its path of 64 moves takes about 150 bytes, and the hidden states of the
//! same step take 650 bytes.

use anyhow::{Context, Result};
use emberwatch_protocol::Connection;
use emberwatch_protocol::channels::{ChannelError, FRAME_BUFFER, Instance};
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::control::ServerInfo;
use emberwatch_protocol::limits::threads::spawn;
use emberwatch_protocol::message::{FrameHeader, TruthHeader};
use emberwatch_protocol::observer::{Observer, Sample};
use emberwatch_protocol::recording::{Event, Record, RecordingError, Totals, Writer};
use std::collections::HashMap;
use std::fs::{File, OpenOptions};
use std::io::{BufWriter, Error, ErrorKind};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

const TICK: Duration = Duration::from_millis(50);

/// Time between flushes, so that every record reaches the operating system within a second.
const FLUSH_INTERVAL: Duration = Duration::from_millis(500);

/// Maximum wait for the answer to `hello`. No samples are lost meanwhile, because a server that does not answer
/// publishes nothing either.
const HELLO_TIMEOUT: Duration = Duration::from_secs(5);

/// Pause before another `hello` to a server that did not answer.
const RETRY_INTERVAL: Duration = Duration::from_secs(1);

/// Capacity of the queue to the writing thread: about 16,000 frames of 64 x 64 cells.
const MAX_QUEUED_BYTES: usize = 64 << 20;

const NAME: &str = "emberwatch-server record";

#[derive(Debug)]
pub struct RecordOptions {
    /// The instance to record. Its server may start later, and may end and restart.
    pub instance: Instance,
    pub out: PathBuf,
    pub overwrite: bool,
    /// Whether to record hidden states, where the server publishes them.
    pub truth: bool,
    pub n_steps: u64,
    /// The worlds to record. If empty, all worlds are recorded.
    pub worlds: Vec<u32>,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RecordSummary {
    pub totals: Totals,
    pub n_steps: u64,
    pub n_bytes: u64,
    /// Number of samples that were not recorded, because their server did not answer `hello`.
    pub n_unknown: u64,
}

pub fn record(options: &RecordOptions, stop: &AtomicBool) -> Result<RecordSummary> {
    // Sends `hello` before it starts to observe, because a fast agent would overflow the observer's buffer during the
    // wait for the answer.
    let first_server = Connection::open(&options.instance, NAME, HELLO_TIMEOUT);
    // Starts to observe the hidden states before the frames, so that every recorded frame has its hidden states.
    let truths = options
        .truth
        .then(|| Observer::truth(&options.instance))
        .transpose()?;
    let frames = Observer::frames(&options.instance)?.eager();
    let file = || format!("--out {}", options.out.display());
    let created = create(&options.out, options.overwrite).with_context(file)?;
    let writing = Writing::start(created).with_context(file)?;
    let mut recorder = Recorder {
        options,
        writing,
        began: Instant::now(),
        first_server: first_server
            .ok()
            .map(|connection| connection.info().clone()),
        server: None,
        silent: None,
        frames: Channel::default(),
        truths: Channel::default(),
        steps: HashMap::new(),
        n_steps: 0,
        n_unknown: 0,
    };
    recorder.announce();
    while !stop.load(Ordering::Relaxed) && recorder.wants_more() {
        recorder.run_once(&frames, truths.as_ref(), TICK)?;
    }
    // Reads the samples that were published before the stop, but at most one buffer of them, because the server may
    // keep publishing.
    for _ in 0..FRAME_BUFFER {
        if !recorder.wants_more() || !recorder.run_once(&frames, truths.as_ref(), Duration::ZERO)? {
            break;
        }
    }
    recorder.finish().with_context(file)
}

struct Recorder<'a> {
    options: &'a RecordOptions,
    writing: Writing,
    began: Instant,
    /// The answer to the `hello` that was sent before the first sample arrived.
    first_server: Option<ServerInfo>,
    server: Option<u32>,
    /// A server process that did not answer `hello`, and the time at which it was asked.
    silent: Option<(u32, Instant)>,
    frames: Channel,
    truths: Channel,
    /// Episode and step of each world's latest frame, to detect frames that are published repeatedly.
    steps: HashMap<u32, (u64, u64)>,
    n_steps: u64,
    n_unknown: u64,
}

/// The sequence numbers of a channel, to detect lost samples.
#[derive(Default)]
struct Channel {
    next: Option<u64>,
    /// Number of samples lost since the last recorded one.
    n_lost: u64,
}

impl Recorder<'_> {
    fn announce(&self) {
        let instance = self.options.instance.name();
        if self.first_server.is_some() {
            tracing::info!(instance, "recording");
        } else {
            tracing::info!(instance, "no server yet; recording starts with the server");
        }
    }

    /// Waits for a frame. Records first the hidden states that were published before the frame, and then the frame.
    /// Returns whether a frame arrived.
    fn run_once(
        &mut self,
        frames: &Observer<FrameHeader>,
        truths: Option<&Observer<TruthHeader>>,
        limit: Duration,
    ) -> Result<bool> {
        let frame = frames.receive(limit)?;
        let is_there = frame.is_some();
        if let Some(truths) = truths {
            while let Some(sample) = truths.try_receive()? {
                self.take_truth(truths.publisher(), sample);
            }
        }
        if let Some(sample) = frame {
            self.take_frame(frames.publisher(), sample);
        }
        Ok(is_there)
    }

    fn take_truth(&mut self, publisher: Option<u32>, sample: Sample<TruthHeader>) {
        let (world, sequence) = (sample.header.world, sample.header.sequence);
        if self.knows(publisher, self.truths.is_new(sequence)) {
            let n_lost = self.truths.count(sequence, self.wants(world));
            self.push(world, n_lost, Event::Truth(sample));
        }
    }

    fn take_frame(&mut self, publisher: Option<u32>, sample: Sample<FrameHeader>) {
        let (world, sequence) = (sample.header.world, sample.header.sequence);
        if !self.knows(publisher, self.frames.is_new(sequence)) {
            return;
        }
        let n_lost = self.frames.count(sequence, self.wants(world));
        let result = &sample.header.result;
        let now = (result.episode, result.step);
        let is_step = result.step > 0 && self.wants(world);
        if self.steps.insert(world, now) != Some(now) && is_step {
            self.n_steps += 1;
        }
        self.push(world, n_lost, Event::Frame(sample));
    }

    /// Returns whether the server of a sample is known. If the server is new, first asks it for its description and
    /// records this.
    fn knows(&mut self, publisher: Option<u32>, is_new: bool) -> bool {
        if publisher.is_some() && publisher == self.server && !is_new {
            return true;
        }
        let first_server = self
            .first_server
            .take()
            .filter(|info| Some(info.pid) == publisher);
        let Some(info) = first_server.or_else(|| self.ask(publisher?)) else {
            self.n_unknown += 1;
            return false;
        };
        tracing::info!(pid = info.pid, worlds = info.n_worlds, "recording a server");
        self.warn_of_gaps(&info);
        self.server = publisher;
        (self.frames, self.truths) = (Channel::default(), Channel::default());
        self.steps.clear();
        self.send(0, Event::Server(Box::new(info)));
        true
    }

    fn ask(&mut self, publisher: u32) -> Option<ServerInfo> {
        if let Some((pid, when)) = self.silent
            && pid == publisher
            && when.elapsed() < RETRY_INTERVAL
        {
            return None;
        }
        let problem = match Connection::open(&self.options.instance, NAME, HELLO_TIMEOUT) {
            Ok(connection) if connection.info().pid == publisher => {
                return Some(connection.info().clone());
            }
            Ok(connection) => format!("pid {} now runs the instance", connection.info().pid),
            Err(ConnectionError::Channel(ChannelError::NoServer { .. })) => {
                "the server has ended".into()
            }
            Err(error) => error.to_string(),
        };
        tracing::warn!(pid = publisher, problem, "a server did not answer `hello`");
        self.silent = Some((publisher, Instant::now()));
        None
    }

    fn warn_of_gaps(&self, info: &ServerInfo) {
        if self.options.truth && !info.publish_truth {
            tracing::warn!(
                "--truth: expected a server with --publish-truth, got one without; recording only frames"
            );
        }
        for world in self
            .options
            .worlds
            .iter()
            .filter(|&&it| it >= info.n_worlds)
        {
            tracing::warn!(
                world,
                worlds = info.n_worlds,
                "the server has no such world"
            );
        }
    }

    fn wants(&self, world: u32) -> bool {
        self.options.worlds.is_empty() || self.options.worlds.contains(&world)
    }

    fn push(&mut self, world: u32, n_lost: u32, event: Event) {
        if self.wants(world) {
            self.send(n_lost, event);
        }
    }

    fn send(&mut self, n_lost: u32, event: Event) {
        let nanos = self.began.elapsed().as_nanos() as u64;
        self.writing.push(Record {
            nanos,
            n_lost,
            event,
        });
    }

    fn wants_more(&self) -> bool {
        let is_done = self.options.n_steps > 0 && self.n_steps >= self.options.n_steps;
        !is_done && self.writing.is_running()
    }

    fn finish(self) -> Result<RecordSummary, RecordingError> {
        let (totals, n_bytes) = self.writing.finish()?;
        Ok(RecordSummary {
            totals,
            n_steps: self.n_steps,
            n_bytes,
            n_unknown: self.n_unknown,
        })
    }
}

impl Channel {
    /// Returns whether a sequence number shows that a new server has started, because it is lower than expected.
    fn is_new(&self, sequence: u64) -> bool {
        self.next.is_some_and(|next| sequence < next)
    }

    fn count(&mut self, sequence: u64, is_recorded: bool) -> u32 {
        let expected = self.next.unwrap_or(sequence);
        self.n_lost = self
            .n_lost
            .saturating_add(sequence.saturating_sub(expected));
        self.next = Some(sequence.saturating_add(1));
        let n_lost = u32::try_from(self.n_lost).unwrap_or(u32::MAX);
        if is_recorded {
            self.n_lost = 0;
        }
        n_lost
    }
}

struct Writing {
    queue: Sender<Record>,
    n_queued_bytes: Arc<AtomicUsize>,
    thread: JoinHandle<Result<(Totals, u64), RecordingError>>,
}

impl Writing {
    fn start(file: File) -> Result<Self, RecordingError> {
        let mut writer = Writer::new(BufWriter::new(file))?;
        writer.flush()?;
        let (queue, records) = channel();
        let n_queued_bytes = Arc::new(AtomicUsize::new(0));
        let counter = n_queued_bytes.clone();
        let thread = spawn("writer", move || write(writer, &records, &counter));
        let thread = thread.map_err(Error::other)?;
        Ok(Self {
            queue,
            n_queued_bytes,
            thread,
        })
    }

    /// Queues a record, and waits while the queue is full. Samples that the observer loses during the wait are counted.
    fn push(&self, record: Record) {
        while self.n_queued_bytes.load(Ordering::Relaxed) > MAX_QUEUED_BYTES && self.is_running() {
            std::thread::sleep(Duration::from_millis(1));
        }
        self.n_queued_bytes
            .fetch_add(bytes_of(&record), Ordering::Relaxed);
        // Sending fails only if writing has failed, which `finish` reports.
        let _ = self.queue.send(record);
    }

    fn is_running(&self) -> bool {
        !self.thread.is_finished()
    }

    fn finish(self) -> Result<(Totals, u64), RecordingError> {
        drop(self.queue);
        self.thread
            .join()
            .unwrap_or_else(|_| Err(Error::other("the writing thread panicked").into()))
    }
}

fn write(
    mut writer: Writer<BufWriter<File>>,
    records: &Receiver<Record>,
    n_queued_bytes: &AtomicUsize,
) -> Result<(Totals, u64), RecordingError> {
    let mut flushed = Instant::now();
    loop {
        match records.recv_timeout(FLUSH_INTERVAL) {
            Ok(record) => {
                writer.write(&record)?;
                n_queued_bytes.fetch_sub(bytes_of(&record), Ordering::Relaxed);
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => break,
        }
        if flushed.elapsed() >= FLUSH_INTERVAL {
            writer.flush()?;
            flushed = Instant::now();
        }
    }
    let totals = writer.finish()?;
    Ok((totals, writer.n_bytes()))
}

fn bytes_of(record: &Record) -> usize {
    size_of::<Record>()
        + match &record.event {
            Event::Server(_) => 0,
            Event::Frame(sample) => sample.payload.len(),
            Event::Truth(sample) => sample.payload.len(),
        }
}

/// Creates the file, readable only by its owner because it may contain hidden states.
fn create(path: &Path, overwrite: bool) -> std::io::Result<File> {
    let mut file_options = OpenOptions::new();
    file_options.write(true).mode(0o600);
    let found = path.metadata().ok().filter(|_| overwrite);
    let file = match found.map(|found| found.is_file()) {
        // Replaces the file instead of truncating it, because other programs may have the old file open.
        Some(true) => path.canonicalize().and_then(|path| {
            std::fs::remove_file(&path)?;
            file_options.create_new(true).open(path)
        }),
        Some(false) => file_options.open(path), // for example a pipe
        None if overwrite => file_options.create(true).open(path), // also a dangling link
        None => file_options.create_new(true).open(path),
    };
    file.map_err(|error| match error.kind() {
        ErrorKind::AlreadyExists => {
            Error::other("expected a new file, got an existing one; --force overwrites it")
        }
        _ => error,
    })
}
