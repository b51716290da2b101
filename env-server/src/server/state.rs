//! The state of a running server, its start and its end.

use super::autosave::{Autosave, FirstWorlds, first_worlds};
use super::files::Files;
use super::liveness::Clients;
use super::ports::{ActiveStep, Ports};
use super::publications::Publications;
use super::resets::Resets;
use anyhow::Result;
use emberwatch_protocol::control::Reply;
use emberwatch_protocol::message::Status;
use emberwatch_protocol::program::WatchedProcess;
use emberwatch_protocol::responder::ActiveControl;
use emberwatch_protocol::throttle::Throttle;
use emberwatch_protocol::wait::Waiter;
use emberwatch_sim::config::Checked;
use emberwatch_sim::limits::{check_memory, n_threads, start};
use emberwatch_sim::rate::Rate;
use emberwatch_sim::simulator::{PendingFile, PendingReply, ResetJob, Simulator, Ticket};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use rayon::{ThreadPool, ThreadPoolBuilder};
use std::collections::HashMap;
use std::collections::hash_map::RandomState;
use std::hash::BuildHasher;
use std::ops::Range;
use std::time::{Duration, Instant};

const LAST_FILES: Duration = Duration::from_secs(10);

pub(super) struct Server {
    pub(super) simulator: Simulator,
    pub(super) ports: Ports,
    pub(super) waiter: Waiter,
    pub(super) clients: Clients,
    pub(super) exit_with: Option<WatchedProcess>,
    pub(super) resets: Resets,
    pub(super) waiting_steps: Vec<(Ticket, ActiveStep)>,
    pub(super) pending_replies: Vec<(ActiveControl, PendingReply)>,
    pub(super) files: Files,
    /// Control requests that wait for a file, indexed by the number of the file job.
    pub(super) pending_files: HashMap<u64, (ActiveControl, PendingFile)>,
    pub(super) autosave: Option<Autosave>,
    pub(super) payload: Vec<u8>,
    pub(super) publications: Publications,
    pub(super) expired_leases: Throttle,
    pub(super) has_warned_of_barren: bool,
    pub(super) rate: Rate,
    pub(super) started: Instant,
    pub(super) last_tick: Instant,
    pub(super) n_rounds: u64,
    pub(super) is_over: bool,
}

impl Server {
    pub(super) fn start(checked: Checked, exit_with: Option<i32>) -> Result<Self> {
        let exit_with = exit_with.map(WatchedProcess::watch).transpose()?;
        let n_threads = n_threads(&checked.config);
        let steps = start(ThreadPoolBuilder::new(), n_threads)?;
        let reset_threads = start(ThreadPoolBuilder::new(), n_threads)?;
        check_memory(&checked, n_threads)?;
        let ports = Ports::open(&checked)?;
        announce(&checked);
        let autosave = Autosave::new(&checked)?;
        let (simulator, resets_due) = simulator(checked, steps)?;
        let spec = simulator.spec().clone();
        let resets = Resets::new(reset_threads, spec.rules.clone())?;
        let files = Files::start(spec)?;
        resets.start(resets_due);
        let now = Instant::now();
        Ok(Self {
            simulator,
            ports,
            waiter: Waiter::default(),
            clients: Clients::default(),
            exit_with,
            resets,
            waiting_steps: Vec::new(),
            pending_replies: Vec::new(),
            files,
            pending_files: HashMap::new(),
            autosave,
            payload: Vec::new(),
            publications: Publications::default(),
            expired_leases: Throttle::default(),
            has_warned_of_barren: false,
            rate: Rate::since(now),
            started: now,
            last_tick: now,
            n_rounds: 0,
            is_over: false,
        })
    }

    pub(super) fn send_reply(&mut self, request: &ActiveControl, reply: &Reply) {
        if reply.status() != Status::Ok {
            tracing::debug!(status = ?reply.status(), "refused a control request");
        }
        self.ports
            .answers()
            .send_json(request, reply.status(), reply);
    }

    pub(super) fn publish(&mut self, worlds: Range<usize>) {
        self.publications
            .publish(&self.ports, &self.simulator, worlds);
    }

    pub(super) fn save_if_due(&mut self) {
        let n_steps = self.simulator.n_steps();
        if self
            .autosave
            .as_ref()
            .is_some_and(|autosave| autosave.is_due(n_steps))
        {
            self.save(false);
        }
    }

    fn save(&mut self, is_last: bool) {
        let Some(autosave) = &mut self.autosave else {
            return;
        };
        let n_steps = self.simulator.n_steps();
        match self.simulator.snapshot(self.simulator.worlds()) {
            Ok(bytes) => autosave.start(n_steps, bytes, is_last, &mut self.files),
            Err(error) => {
                autosave.skip(n_steps);
                autosave.warn(&error);
            }
        }
    }

    /// Writes a last snapshot and closes the channels. Afterwards another server can use the instance's name.
    pub(super) fn end(mut self) -> Result<()> {
        self.save(true);
        let (finished, is_late) = match self.files.finish(LAST_FILES) {
            Ok(finished) => (finished, false),
            Err(finished) => (finished, true),
        };
        if is_late {
            tracing::warn!("snapshot files were not finished within {LAST_FILES:?}");
        }
        self.ports.close();
        let failed = finished
            .into_iter()
            .filter_map(|(_, outcome)| outcome.err());
        match failed.last() {
            Some(error) if self.autosave.is_some() => Err(error.into()),
            _ => Ok(()),
        }
    }
}

fn announce(checked: &Checked) {
    let config = &checked.config;
    tracing::info!(
        instance = checked.instance.name(),
        pid = std::process::id(),
        worlds = config.worlds,
        seed = config.seed,
        "serving"
    );
    announce_settings(checked);
}

/// Logs how many free cells cannot be reached from random starts, and warns of settings that do badly.
pub fn announce_settings(checked: &Checked) {
    if let Some(words) = checked.reach.cut_off() {
        tracing::info!("{words}");
    }
    for warning in checked.warnings() {
        tracing::warn!("{warning}");
    }
}

/// Creates the worlds. Restores worlds from a snapshot if the settings name one. Also returns the reset jobs for the
/// remaining worlds.
fn simulator(checked: Checked, steps: ThreadPool) -> Result<(Simulator, Vec<ResetJob>)> {
    let settings = checked.clone();
    let (mut simulator, mut resets) = Simulator::new(checked, steps, token_source())?;
    if let Some(FirstWorlds { path, worlds }) = first_worlds(&settings, simulator.spec())? {
        tracing::info!(file = %path.display(), "restored");
        let worlds = worlds.into_iter().enumerate();
        resets = worlds
            .filter_map(|(world, restored)| simulator.start_with(world, restored))
            .collect();
    }
    Ok((simulator, resets))
}

/// Returns a generator of unguessable lease tokens. They are at least 1, and below 2^53 so that every JSON reader
/// represents them exactly.
fn token_source() -> Box<dyn FnMut() -> u64 + Send> {
    let entropy = RandomState::new();
    let mut key = [0; 32];
    for (index, bytes) in key.chunks_mut(8).enumerate() {
        bytes.copy_from_slice(&entropy.hash_one(index).to_le_bytes());
    }
    let mut rng = ChaCha8Rng::from_seed(key);
    Box::new(move || (rng.next_u64() >> 11).max(1))
}
