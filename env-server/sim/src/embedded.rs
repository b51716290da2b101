//! Worlds inside a process that is their only client. They answer the same requests as a server, but without channels.
//!
//! Background threads reset worlds and read and write files, so that a caller can stop waiting for them early.

pub mod settings;
#[cfg(test)]
mod tests;
mod wait;

pub use wait::{INSTANCE, wait_for};

use crate::config::Checked;
use crate::limits::{check_memory, n_threads, start};
use crate::rate::Rate;
use crate::results::world_result;
use crate::simulator::{ClientId, Outcome, PendingFile, PendingReply, ResetJob, ServerStats};
use crate::simulator::{Simulator, Stepped};
use crate::snapshot::{Job, SnapshotError, decode};
use crate::world::{Episode, Rules};
use anyhow::Result;
use emberwatch_messages::backend::{Backend, StepAnswer};
use emberwatch_messages::control::{Reply, ServerInfo};
use emberwatch_messages::errors::{ConnectionError, ErrorClass, check_status};
use emberwatch_messages::limits::memory::NoMemory;
use emberwatch_messages::limits::threads::NoThreads;
use emberwatch_messages::message::{Status, StepRequest, VERSION, WorldResult};
use emberwatch_model::grid::Grid;
use rayon::{ThreadPool, ThreadPoolBuilder};
use serde_json::{Map, Value};
use settings::ReadError;
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};
use thiserror::Error;

/// Maximum number of queued file jobs. Each job keeps a whole snapshot in memory.
const MAX_FILES: usize = 16;

type Reset = (usize, Box<Episode>);

/// A simulator inside this process, with the threads for its slow work.
pub struct Embedded {
    simulator: Simulator,
    rules: Arc<Rules>,
    resets: (Sender<Reset>, Receiver<Reset>),
    /// Separate from the simulator's threads, so that steps do not wait for resets.
    reset_threads: ThreadPool,
    /// A pool of one thread, so that jobs run in order: if two snapshots are written to the same file, the later one
    /// remains.
    file_thread: ThreadPool,
    n_files: Arc<AtomicUsize>,
    info: ServerInfo,
    client: ClientId,
    started: Instant,
    rate: Rate,
    is_over: bool,
}

/// The reason why worlds could not be opened.
#[derive(Debug, Error)]
pub enum OpenError {
    /// The settings could not be read.
    #[error(transparent)]
    Settings(#[from] ReadError),
    /// The worlds could not be created.
    #[error("{0:#}")]
    Worlds(anyhow::Error),
}

impl OpenError {
    pub fn class(&self) -> ErrorClass {
        match self {
            Self::Settings(ReadError::Wait(error)) => error.class(),
            Self::Settings(ReadError::Threads(_)) => ErrorClass::Memory,
            Self::Worlds(error) if error.is::<NoMemory>() || error.is::<NoThreads>() => {
                ErrorClass::Memory
            }
            Self::Settings(ReadError::Config(_)) | Self::Worlds(_) => ErrorClass::Invalid,
        }
    }
}

impl Embedded {
    /// Reads and checks settings as [`settings::read`] does, and creates the worlds.
    ///
    /// # Errors
    /// As for [`settings::read`] and [`Self::new`].
    pub fn open(given: Map<String, Value>) -> Result<Self, OpenError> {
        Self::new(settings::read(given)?).map_err(OpenError::Worlds)
    }

    /// Creates the worlds and starts their burn-ins. Ignores settings about channels and automatic snapshots.
    ///
    /// # Errors
    /// If the model does not fit the grid, there is too little memory, or no threads can be started.
    pub fn new(checked: Checked) -> Result<Self> {
        let config = &checked.config;
        let n_threads = n_threads(config).min(config.worlds as usize);
        let mut n_leases = 0;
        let next_token = move || {
            n_leases += 1;
            n_leases
        };
        let (steps, reset_threads) = (threads(n_threads)?, threads(n_threads)?);
        let file_thread = threads(1)?;
        check_memory(&checked, n_threads)?;
        let (simulator, jobs) = Simulator::new(checked, steps, Box::new(next_token))?;
        let now = Instant::now();
        let embedded = Self {
            rules: Arc::new(simulator.spec().rules.clone()),
            info: simulator.info(),
            simulator,
            resets: channel(),
            reset_threads,
            file_thread,
            n_files: Arc::default(),
            client: ClientId {
                node: 0,
                pid: std::process::id(),
            },
            started: now,
            rate: Rate::since(now),
            is_over: false,
        };
        embedded.start(jobs);
        Ok(embedded)
    }

    /// Returns the current episodes of consecutive worlds, or `None` if a world does not exist or is being reset.
    ///
    /// # Errors
    /// If the worlds were shut down.
    pub fn episodes(
        &mut self,
        mut worlds: Range<usize>,
    ) -> Result<Option<Vec<&Episode>>, ConnectionError> {
        self.settle(Instant::now())?;
        let simulator = &self.simulator;
        Ok(worlds.try_fold(Vec::new(), |mut found, world| {
            found.push(simulator.episode(world)?);
            Some(found)
        }))
    }

    fn ready_worlds(&mut self, what: &'static str) -> Result<Range<usize>, ConnectionError> {
        let worlds = self.simulator.worlds();
        match self.episodes(worlds.clone())? {
            Some(_) => Ok(worlds),
            None => Err(ConnectionError::Invalid {
                what,
                problem: "expected worlds after their burn-in, got one during it".into(),
            }),
        }
    }

    /// Prepares for a request: installs worlds whose reset finished since the last call, and ends expired leases.
    fn settle(&mut self, now: Instant) -> Result<(), ConnectionError> {
        if self.is_over {
            return Err(ConnectionError::ServerGone {
                instance: INSTANCE.into(),
            });
        }
        while let Ok((world, episode)) = self.resets.1.try_recv() {
            self.simulator.put(world, episode);
        }
        self.simulator.tick(now);
        self.rate.update(now, self.simulator.n_steps());
        Ok(())
    }

    fn start(&self, jobs: Vec<ResetJob>) {
        for job in jobs {
            let (rules, sender) = (self.rules.clone(), self.resets.0.clone());
            self.reset_threads.spawn(move || {
                let reset = job.run(&rules);
                if !rules.ended.load(Ordering::Relaxed) {
                    // Sending fails only after `Embedded` was dropped, when nobody needs the episode.
                    drop(sender.send(reset));
                }
            });
        }
    }

    fn reset(
        &mut self,
        pending: &PendingReply,
        timeout: Duration,
    ) -> Result<Reply, ConnectionError> {
        let start = Instant::now();
        loop {
            if let Some(reply) = self.simulator.pending_reply(Instant::now(), pending) {
                return Ok(reply);
            }
            match wait_for(&self.resets.1, start, timeout) {
                Ok((world, episode)) => self.simulator.put(world, episode),
                Err(ended) => {
                    self.simulator.cancel_reply(Instant::now(), pending);
                    return Err(ended);
                }
            }
        }
    }

    fn file(
        &mut self,
        job: Job,
        pending: &PendingFile,
        timeout: Duration,
    ) -> Result<Reply, ConnectionError> {
        if self.n_files.fetch_add(1, Ordering::Relaxed) >= MAX_FILES {
            self.n_files.fetch_sub(1, Ordering::Relaxed);
            self.simulator.cancel_file(Instant::now(), pending);
            let message = "too many file jobs at a time: try again later".into();
            return Ok(Reply::error(Status::BadFile, 0, message));
        }
        let (sender, receiver) = channel();
        let (spec, n_files) = (self.simulator.spec().clone(), self.n_files.clone());
        self.file_thread.spawn(move || {
            let done = job.run(&spec);
            n_files.fetch_sub(1, Ordering::Relaxed);
            drop(sender.send(done));
        });
        let done = wait_for(&receiver, Instant::now(), timeout);
        let now = Instant::now();
        if done.is_err() {
            self.simulator.cancel_file(now, pending);
        }
        Ok(self.simulator.file_reply(now, pending, done?))
    }
}

/// Answers requests as a server does. Unlike a request to a server, `control_text` can be interrupted. After a
/// `shutdown` request, every later request fails with [`ConnectionError::ServerGone`].
impl Backend for Embedded {
    fn info(&self) -> &ServerInfo {
        &self.info
    }

    fn control_text(&mut self, text: &[u8], timeout: Duration) -> Result<Vec<u8>, ConnectionError> {
        let (now, client) = (Instant::now(), self.client);
        self.settle(now)?;
        let stats = ServerStats {
            uptime: now - self.started,
            steps_per_second: self.rate.per_second,
            n_clients: 1,
            n_observers: 0,
        };
        let reply = match self.simulator.control(now, client, VERSION, text, &stats) {
            Outcome::Answer(reply) | Outcome::Changed(_, reply) => reply,
            Outcome::Pending(jobs, pending) => {
                self.start(jobs);
                self.reset(&pending, timeout)?
            }
            Outcome::File(job, pending) => self.file(job, &pending, timeout)?,
            Outcome::Shutdown => {
                self.is_over = true;
                Reply::Done
            }
        };
        if let Reply::Error {
            status,
            detail,
            message,
        } = reply
        {
            let refused = check_status("a control request", status as u32, detail, Some(message));
            return refused.map(|()| Vec::new());
        }
        Ok(serde_json::to_vec(&reply).expect("invariant: replies serialise"))
    }

    /// Ignores the timeout: a step never waits, because no other client holds robots of these worlds.
    fn step(
        &mut self,
        request: StepRequest,
        body: &[u8],
        _: Duration,
    ) -> Result<StepAnswer, ConnectionError> {
        let now = Instant::now();
        self.settle(now)?;
        let request = StepRequest {
            version: VERSION,
            ..request
        };
        let mut payload = Vec::new();
        let stepped = self
            .simulator
            .step(now, self.client, &request, body, &mut payload);
        let Stepped::Reply(mut reply) = stepped else {
            unreachable!(
                "invariant: the only client sends the paths of all robots that it holds in a world"
            );
        };
        check_status("step", reply.status, reply.detail, None)?;
        reply.simulation_nanos = now.elapsed().as_nanos() as u64;
        Ok((reply, payload))
    }

    fn truths(
        &mut self,
        worlds: Range<u32>,
    ) -> Result<Vec<(WorldResult, Grid<u8>)>, ConnectionError> {
        let shows = self.info.publish_truth;
        let range = worlds.start as usize..worlds.end as usize;
        match self.episodes(range)?.filter(|_| shows) {
            Some(episodes) => Ok(episodes
                .into_iter()
                .map(|it| (world_result(it.outcome()), it.states().to_owned()))
                .collect()),
            None => Err(ConnectionError::Invalid {
                what: "truths",
                problem: format!(
                    "expected embedded worlds with publish_truth that are not in a reset, got worlds {worlds:?}"
                ),
            }),
        }
    }

    fn clone_state(&mut self) -> Result<Vec<u8>, ConnectionError> {
        let what = "clone_state";
        let worlds = self.ready_worlds(what)?;
        let bytes = self.simulator.snapshot(worlds);
        bytes.map_err(|error| invalid(what, &error))
    }

    fn restore_state(&mut self, bytes: &[u8]) -> Result<(), ConnectionError> {
        let what = "restore_state";
        let worlds = self.ready_worlds(what)?;
        let restored = decode(bytes).and_then(|it| it.restore(self.simulator.spec()));
        let restored = restored.map_err(|error| invalid(what, &error))?;
        if restored.len() != worlds.len() {
            let expected = format!("{} worlds", worlds.len());
            return Err(invalid(
                what,
                &SnapshotError::n_worlds(expected, restored.len()),
            ));
        }
        let restored = worlds.zip(restored);
        let jobs = restored.filter_map(|(world, it)| self.simulator.start_with(world, it));
        let jobs = jobs.collect();
        self.start(jobs);
        Ok(())
    }
}

fn invalid(what: &'static str, error: &SnapshotError) -> ConnectionError {
    ConnectionError::Invalid {
        what,
        problem: error.to_string(),
    }
}

impl Drop for Embedded {
    fn drop(&mut self) {
        self.rules.ended.store(true, Ordering::Relaxed);
    }
}

/// Starts a pool in which a panic ends only the job, not the process.
fn threads(n_threads: usize) -> Result<ThreadPool, NoThreads> {
    start(ThreadPoolBuilder::new().panic_handler(|_| ()), n_threads)
}
