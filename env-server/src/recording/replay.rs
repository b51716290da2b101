//! Publishes a recording again, with the same headers and bytes and in the same order as the recorded server.
//!
//! The file is read twice: first to check it completely before anything is published, then to publish it.
//!
//! By default a replay begins with the first observer and keeps the recorded timing. At any speed it publishes at most
//! 64 samples within a millisecond, so an observer that polls every 500 us loses none. No sample is published twice, so
//! a late observer receives a world only when the recording contains its next sample. At its end, a replay waits up to
//! 3 s for its observers to leave. When a replay restarts at its end, the sequence numbers start again, as with a new
//! server.

use super::pace::Pace;
use super::replies::{ConnectionCounts, Next, ReplayState};
use crate::server::{Clients, PortConfig, Ports};
use anyhow::{Context, Error, Result, bail};
use emberwatch_protocol::channels::{Instance, ipc_error};
use emberwatch_protocol::control::{Reply, ServerInfo};
use emberwatch_protocol::message::{Status, StepReply, VERSION};
use emberwatch_protocol::recording::{Event, Reader, Record, RecordingError, Totals};
use emberwatch_protocol::responder::{ActiveControl, listener_id, wait_until_taken};
use emberwatch_protocol::wait::sleep_until_event;
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// How often a waiting replay checks for observers and whether to stop.
const TICK: Duration = Duration::from_millis(50);

/// How long a replay waits at its end for observers to read the last samples and leave.
const LAST_SAMPLES_TIMEOUT: Duration = Duration::from_secs(3);

/// Options of a replay.
#[derive(Debug)]
pub struct ReplayOptions {
    pub file: PathBuf,
    /// The instance to publish on.
    pub instance: Instance,
    /// Speed relative to the recording. `None` means as fast as observers can follow.
    pub speed: Option<f64>,
    /// Length of the beginning to skip.
    pub from: Duration,
    /// Whether to restart at the end, until stopped.
    pub repeat: bool,
    /// Whether to start without waiting for an observer.
    pub at_once: bool,
    /// Whether to refuse a damaged or truncated file.
    pub strict: bool,
}

/// Replays a recording until its end, until `stop` is set, or until a client requests a shutdown.
///
/// Unless `strict` is set, a damaged or truncated recording is replayed up to the damage, with a warning.
///
/// # Errors
/// If the file has no samples to replay, or the channels fail.
pub fn replay(options: &ReplayOptions, stop: &AtomicBool) -> Result<()> {
    let summary = RecordingSummary::of(options)?;
    let ports = Ports::open_with(&summary.config)?;
    let instance = options.instance.name();
    tracing::info!(
        instance,
        frames = summary.totals.n_frames,
        truths = summary.totals.n_truths,
        lost = summary.totals.n_lost_frames + summary.totals.n_lost_truths,
        "replaying"
    );
    let mut replay = Playback {
        options,
        stop,
        ports,
        state: ReplayState::new(summary.info, summary.totals.n_truths > 0),
        pace: Pace::new(options.speed, Instant::now()),
        is_over: false,
        clients: Clients::default(),
    };
    let outcome = replay.run();
    tracing::info!(steps = replay.state.n_steps(), "replayed");
    replay.ports.close();
    outcome
}

/// A summary of the whole file: the message sizes, the description of the first server, and the totals.
struct RecordingSummary {
    config: PortConfig,
    /// The description of the first server in the file.
    info: ServerInfo,
    totals: Totals,
}

struct Playback<'a> {
    options: &'a ReplayOptions,
    stop: &'a AtomicBool,
    ports: Ports,
    state: ReplayState,
    pace: Pace,
    is_over: bool,
    clients: Clients,
}

impl RecordingSummary {
    fn of(options: &ReplayOptions) -> Result<Self> {
        let mut config = PortConfig::empty(options.instance.clone());
        let (mut first, mut is_empty, mut end) = (None, true, None);
        let mut reader = open(&options.file)?;
        for record in reader.by_ref() {
            match record {
                Ok(record) => match record.event {
                    Event::Server(info) => {
                        config.fit(&info);
                        first.get_or_insert(*info);
                    }
                    _ => is_empty &= Duration::from_nanos(record.nanos) < options.from,
                },
                Err(problem) if !options.strict && problem.leaves_good_records() => {
                    end = Some(problem);
                    break;
                }
                Err(problem) => return Err(file_error(&options.file, problem)),
            }
        }
        let totals = reader.totals();
        config.publish_truth = totals.n_truths > 0;
        match (first, end) {
            (Some(info), end) if !is_empty => {
                if let Some(problem) = end {
                    tracing::warn!(file = %options.file.display(), "{problem}; replaying the records before it");
                }
                Ok(Self {
                    config,
                    info,
                    totals,
                })
            }
            (_, Some(problem)) => Err(file_error(&options.file, problem)),
            _ => bail!(
                "{}: expected samples after the first {:?}, got none",
                in_file(&options.file),
                options.from
            ),
        }
    }
}

impl Playback<'_> {
    fn run(&mut self) -> Result<()> {
        if !self.options.at_once {
            tracing::info!("waiting for an observer");
            while !self.ends() && self.ports.observers() == (0, 0) {
                self.serve_until(Instant::now() + TICK)?;
            }
        }
        self.publish_all()?;
        while self.options.repeat && !self.ends() {
            self.publish_all()?;
        }
        let deadline = Instant::now() + LAST_SAMPLES_TIMEOUT;
        while !self.ends() && self.ports.observers() != (0, 0) && Instant::now() < deadline {
            self.serve_until(Instant::now() + TICK)?;
        }
        Ok(())
    }

    /// Publishes the whole recording once.
    fn publish_all(&mut self) -> Result<()> {
        self.pace.begin_round(Instant::now());
        for record in open(&self.options.file)? {
            let record = match record {
                Ok(record) => record,
                Err(problem) if problem.leaves_good_records() => break,
                Err(problem) => return Err(file_error(&self.options.file, problem)),
            };
            let time = Duration::from_nanos(record.nanos);
            if let Event::Server(_) = record.event {
                self.state.record(&record.event);
            } else if time >= self.options.from {
                self.wait_until_due(time - self.options.from)?;
                if self.ends() {
                    break;
                }
                self.publish(record);
            }
        }
        Ok(())
    }

    /// Waits until the samples at a time in the recording are due and observers can follow.
    fn wait_until_due(&mut self, time: Duration) -> Result<()> {
        let due = self.pace.due(time);
        let mut now = Instant::now();
        while !self.ends() && due.is_none_or(|due| now < due) {
            let tick = now + TICK;
            self.serve_until(due.map_or(tick, |due| due.min(tick)))?;
            now = Instant::now();
        }
        if let Some(pause) = self.pace.pause() {
            self.serve_until(pause)?;
        }
        Ok(())
    }

    fn publish(&mut self, record: Record) {
        self.pace.publish(Instant::now());
        self.state.record(&record.event);
        match record.event {
            Event::Frame(sample) => self.ports.publish_frame(sample.header, &sample.payload),
            Event::Truth(sample) => self.ports.publish_truth(sample.header, &sample.payload),
            Event::Server(_) => {}
        }
    }

    fn ends(&self) -> bool {
        self.is_over || self.stop.load(Ordering::Relaxed)
    }

    /// Answers requests until the given time or the end of the replay.
    fn serve_until(&mut self, until: Instant) -> Result<()> {
        loop {
            self.ports.connect_observers();
            while let Some(request) = self.ports.receive_step() {
                let asked = request.user_header().0;
                let reply = StepReply {
                    version: VERSION,
                    status: self.state.refuse_step(asked.version) as u32,
                    sequence: asked.sequence,
                    first_robot: asked.first_robot,
                    detail: if asked.version == VERSION {
                        0
                    } else {
                        VERSION.into()
                    },
                    ..StepReply::default()
                };
                let listener = listener_id(asked.listener_low, asked.listener_high);
                self.ports.answers().send(&request, reply, &[], listener);
            }
            while let Some(request) = self.ports.receive_control() {
                self.answer(request);
            }
            self.ports.check_entries()?;
            self.clients.take_dead(&self.ports.nodes());
            let now = Instant::now();
            self.ports.warn_of_descriptors(now);
            let left = until.saturating_duration_since(now);
            if left.is_zero() || self.ends() {
                return Ok(());
            }
            if !self.ports.drain()? {
                sleep_until_event(&[self.ports.descriptor()], left).map_err(ipc_error("sleep"))?;
            }
        }
    }

    fn answer(&mut self, request: ActiveControl) {
        let counts = ConnectionCounts {
            n_clients: self.ports.n_clients(),
            n_observers: self.ports.observers().0,
        };
        let version = request.user_header().0.version;
        let (reply, next) = self.state.answer(version, request.payload(), &counts);
        let reply = self.ports.with_memory(reply);
        self.send(&request, &reply);
        if next == Next::End {
            wait_until_taken(&[request]);
            tracing::info!("a client asked to shut down");
            self.is_over = true;
        }
    }

    fn send(&mut self, request: &ActiveControl, reply: &Reply) {
        if reply.status() != Status::Ok {
            tracing::debug!(status = ?reply.status(), "refused a control request");
        }
        self.ports
            .answers()
            .send_json(request, reply.status(), reply);
    }
}

fn open(path: &Path) -> Result<Reader<BufReader<File>>> {
    let open = || Reader::new(BufReader::new(File::open(path)?));
    open().with_context(|| in_file(path))
}

fn file_error(path: &Path, problem: RecordingError) -> Error {
    Error::new(problem).context(in_file(path))
}

fn in_file(path: &Path) -> String {
    format!("recording {}", path.display())
}
