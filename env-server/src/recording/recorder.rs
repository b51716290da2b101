//! Records an instance: an observer that writes what is published to a file.
//!
//! One thread reads, so that it returns to the channels at once; another compresses and writes. Lost samples are
//! counted by sequence numbers, in each record and in the end record.

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

/// Longest wait for a frame before the recorder checks whether to stop.
const TICK: Duration = Duration::from_millis(50);

/// Time between flushes: every record reaches the system within a second.
const FLUSH_INTERVAL: Duration = Duration::from_millis(500);

/// Longest wait for the answer to `hello`. A server that does not answer publishes nothing either.
const HELLO_TIMEOUT: Duration = Duration::from_secs(5);

/// Pause before `hello` is sent again to a server that did not answer.
const RETRY_INTERVAL: Duration = Duration::from_secs(1);

/// Most bytes that wait to be written: 16,000 frames of 64 x 64 cells.
const MAX_QUEUED_BYTES: usize = 64 << 20;

/// The name by which servers log this client.
const NAME: &str = "emberwatch-server record";

/// What to record, and to which file.
#[derive(Debug)]
pub struct RecordOptions {
    /// Its server may start later, end, and start again.
    pub instance: Instance,
    pub out: PathBuf,
    /// Whether to overwrite an existing file.
    pub overwrite: bool,
    /// Whether to record hidden states, where the server publishes them.
    pub truth: bool,
    /// World steps to record; 0: until stopped.
    pub n_steps: u64,
    /// The worlds to record; empty: all.
    pub worlds: Vec<u32>,
}

/// What was recorded.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RecordSummary {
    pub totals: Totals,
    /// World steps in it.
    pub n_steps: u64,
    /// Length of the file.
    pub n_bytes: u64,
    /// Samples of servers that did not answer `hello`, which are not in the file.
    pub n_unknown: u64,
}

/// Records until `stop` is set or the steps are recorded.
///
/// # Errors
/// If the file cannot be written, or the instance not be observed; earlier records stay in the file.
pub fn record(options: &RecordOptions, stop: &AtomicBool) -> Result<RecordSummary> {
    // Before observing: a fast agent would fill an observer's buffer while this waits for the answer.
    let first_server = Connection::open(&options.instance, NAME, HELLO_TIMEOUT);
    // The truth first, so that every recorded frame has its hidden states.
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
    while !stop.load(Ordering::Relaxed) && recorder.goes_on() {
        recorder.run_once(&frames, truths.as_ref(), TICK)?;
    }
    // Reads what was published before the stop, at most one buffer: the server may go on publishing.
    for _ in 0..FRAME_BUFFER {
        if !recorder.goes_on() || !recorder.run_once(&frames, truths.as_ref(), Duration::ZERO)? {
            break;
        }
    }
    recorder.finish().with_context(file)
}

struct Recorder<'a> {
    options: &'a RecordOptions,
    writing: Writing,
    began: Instant,
    /// The answer to `hello` from before the first sample.
    first_server: Option<ServerInfo>,
    /// The process whose samples are recorded now.
    server: Option<u32>,
    /// A process that did not answer `hello`, and when.
    silent: Option<(u32, Instant)>,
    frames: Channel,
    truths: Channel,
    /// Episode and step of each world's last frame: a frame may be published again.
    steps: HashMap<u32, (u64, u64)>,
    n_steps: u64,
    n_unknown: u64,
}

/// The sequence numbers of a channel.
#[derive(Default)]
struct Channel {
    next: Option<u64>,
    /// Lost since the last sample that was recorded.
    n_lost: u64,
}

impl Recorder<'_> {
    fn announce(&self) {
        let instance = self.options.instance.name();
        if self.first_server.is_some() {
            tracing::info!(instance, "recording");
        } else {
            tracing::info!(instance, "no server yet; recording when there is one");
        }
    }

    /// Waits for a frame; records it after the hidden states before it. Returns whether there was one.
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

    /// Whether a sample's server is known; asks a new server for its settings and records them.
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
            Ok(connection) => format!("pid {} is there now", connection.info().pid),
            Err(ConnectionError::Channel(ChannelError::NoServer { .. })) => "it is gone".into(),
            Err(error) => error.to_string(),
        };
        tracing::warn!(pid = publisher, problem, "a server did not say who it is");
        self.silent = Some((publisher, Instant::now()));
        None
    }

    /// Warns of worlds and hidden states that were asked for and that this server lacks.
    fn warn_of_gaps(&self, info: &ServerInfo) {
        if self.options.truth && !info.publish_truth {
            tracing::warn!("--truth: expected a server with --publish-truth; recording frames");
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

    /// Whether more is to be recorded, and the thread that writes still runs.
    fn goes_on(&self) -> bool {
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
    /// Whether this sample can only be a new server's.
    fn is_new(&self, sequence: u64) -> bool {
        self.next.is_some_and(|next| sequence < next)
    }

    /// Counts a sample; returns how many were lost since the last that was recorded.
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

/// The thread that writes.
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

    /// Queues a record. Waits while the queue is full: the observer then loses samples, and counts them.
    fn push(&self, record: Record) {
        while self.n_queued_bytes.load(Ordering::Relaxed) > MAX_QUEUED_BYTES && self.is_running() {
            std::thread::sleep(Duration::from_millis(1));
        }
        self.n_queued_bytes
            .fetch_add(bytes_of(&record), Ordering::Relaxed);
        // Fails only when writing has failed, which `finish` reports.
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

/// A file that no other user can read: it may hold hidden states.
fn create(path: &Path, overwrite: bool) -> std::io::Result<File> {
    let mut file_options = OpenOptions::new();
    file_options.write(true).mode(0o600);
    let found = path.metadata().ok().filter(|_| overwrite);
    let file = match found.map(|found| found.is_file()) {
        // A new file: other programs may have the old one open.
        Some(true) => path.canonicalize().and_then(|path| {
            std::fs::remove_file(&path)?;
            file_options.create_new(true).open(path)
        }),
        Some(false) => file_options.open(path), // a pipe, perhaps
        None if overwrite => file_options.create(true).open(path), // a link to nothing, perhaps
        None => file_options.create_new(true).open(path),
    };
    file.map_err(|error| match error.kind() {
        ErrorKind::AlreadyExists => {
            Error::other("expected a new file, got one that exists; --force writes over it")
        }
        _ => error,
    })
}
