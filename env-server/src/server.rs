//! The loop: receive, check the lease, step, answer, publish.

mod later;

use crate::autosave::{Autosave, FirstWorlds, first_worlds};
use crate::config::Checked;
use crate::files::Files;
use crate::liveness::{Cleaner, Clients};
use crate::ports::{ActiveStep, PortError, Ports};
use crate::publications::Publications;
use crate::resets::Resets;
use crate::simulator::{Awaited, FileOrder, Outcome, Simulator, Surroundings};
use crate::snapshot::folder::FileError;
use crate::throttle::Throttle;
use protocol::channels::{ChannelError, ipc_error};
use protocol::control::Reply;
use protocol::message::{Operation, Status};
use protocol::model::ModelError;
use protocol::program::{Keeper, NoKeeper};
use protocol::responder::{ActiveControl, listener_id, wait_until_taken};
use protocol::wait::{Waiter, sleep_until_event};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use rayon::{ThreadPool, ThreadPoolBuilder};
use std::cell::Cell;
use std::collections::HashMap;
use std::collections::hash_map::RandomState;
use std::hash::BuildHasher;
use std::ops::Range;
use std::os::fd::BorrowedFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use thiserror::Error;

/// How often an idle server looks around: leases that expire, observers that came.
const IDLE_TICK: Duration = Duration::from_millis(250);

/// How often a busy server does: bounds how late a client's death is noticed.
const BUSY_TICK: Duration = Duration::from_millis(50);

/// One turn in this many looks for a control request before a step.
const CONTROL_FIRST: u64 = 64;

/// How often a server that is greeting observers shows them more.
const GREETING_TICK: Duration = Duration::from_millis(5);

/// Over how long the step rate is measured.
const RATE_WINDOW: Duration = Duration::from_secs(1);

/// Why the server could not start or had to end.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ServeError {
    /// Its place could not be taken.
    #[error(transparent)]
    Port(#[from] PortError),
    /// A channel failed.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// The model does not fit the grid.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The process to end with is not there.
    #[error(transparent)]
    Keeper(#[from] NoKeeper),
    /// A snapshot to begin with is refused, or none could be written.
    #[error(transparent)]
    File(#[from] FileError),
    /// Threads could not be started.
    #[error("start {n_threads} threads: {problem}")]
    Threads {
        /// How many.
        n_threads: usize,
        /// The system's reason.
        problem: String,
    },
}

/// Serves until `stop` is set, a client asks to shut down, or the process `exit_with` ends.
///
/// # Errors
/// [`ServeError`].
pub fn serve(
    checked: Checked,
    stop: &Arc<AtomicBool>,
    exit_with: Option<i32>,
) -> Result<(), ServeError> {
    let mut server = Server::start(checked, exit_with)?;
    let mut outcome = Ok(());
    while outcome.is_ok() && !stop.load(Ordering::Relaxed) && !server.is_over {
        outcome = server.turn();
    }
    let n_steps = server.simulator.n_steps();
    server.end()?;
    outcome?;
    tracing::info!(n_steps, "stopped");
    Ok(())
}

struct Server {
    simulator: Simulator,
    ports: Ports,
    waiter: Waiter,
    clients: Clients,
    keeper: Option<Keeper>,
    cleaner: Cleaner,
    resets: Resets,
    awaiting: Vec<(ActiveControl, Awaited)>,
    files: Files,
    /// Requests that wait for a file, by the number of its job.
    file_orders: HashMap<u64, (ActiveControl, FileOrder)>,
    autosave: Option<Autosave>,
    payload: Vec<u8>,
    /// Observers that were there at the last look.
    publications: Publications,
    expiries: Throttle,
    rate: Rate,
    started: Instant,
    last_tick: Instant,
    n_turns: u64,
    is_over: bool,
}

/// What a turn of the loop found.
enum Found {
    Step(ActiveStep),
    Control(ActiveControl),
    /// A wake-up without a request, a death or a finished reset.
    Event,
}

/// World steps a second over the last window.
struct Rate {
    since: Instant,
    n_steps: u64,
    per_second: f64,
}

impl Server {
    fn start(checked: Checked, exit_with: Option<i32>) -> Result<Self, ServeError> {
        let keeper = exit_with.map(Keeper::watch).transpose()?;
        let ports = Ports::open(&checked)?;
        let (instance, config) = (checked.instance.name().to_owned(), &checked.config);
        tracing::info!(
            instance,
            pid = std::process::id(),
            worlds = config.worlds,
            seed = config.seed,
            "serving"
        );
        if checked.model.reward().iter().all(|&reward| reward == 0.0) {
            let model = checked.model.name();
            tracing::warn!(
                model,
                "no state pays: every reward will be 0; give a state a `reward` in the model file"
            );
        }
        let n_threads = config.threads;
        let autosave = Autosave::new(&checked)?;
        let settings = checked.clone();
        let (mut simulator, mut orders) =
            Simulator::new(checked, threads(n_threads)?, token_source())?;
        let place = simulator.place();
        if let Some(FirstWorlds { path, worlds }) = first_worlds(&settings, &place)? {
            tracing::info!(file = %path.display(), "restored");
            let worlds = worlds.into_iter().enumerate();
            orders = worlds
                .filter_map(|(world, restored)| simulator.begin_with(world, restored))
                .collect();
        }
        let not_started = |problem: String| ServeError::Threads { n_threads, problem };
        let files = Files::start(place).map_err(|error| not_started(error.to_string()))?;
        let resets = Resets::new(threads(n_threads)?, simulator.rules().clone());
        let resets = resets.map_err(|errno| not_started(errno.to_string()))?;
        resets.start(orders);
        let now = Instant::now();
        Ok(Self {
            simulator,
            ports,
            waiter: Waiter::default(),
            clients: Clients::default(),
            keeper,
            cleaner: Cleaner::start(),
            resets,
            awaiting: Vec::new(),
            files,
            file_orders: HashMap::new(),
            autosave,
            payload: Vec::new(),
            publications: Publications::default(),
            expiries: Throttle::default(),
            rate: Rate {
                since: now,
                n_steps: 0,
                per_second: 0.0,
            },
            started: now,
            last_tick: now,
            n_turns: 0,
            is_over: false,
        })
    }

    /// Waits for something and handles it.
    fn turn(&mut self) -> Result<(), ServeError> {
        let woken = Cell::new(false);
        let tick = if self.publications.is_greeting() {
            GREETING_TICK
        } else {
            IDLE_TICK
        };
        // Now and then control comes first, so that endless steps cannot keep it waiting.
        self.n_turns = self.n_turns.wrapping_add(1);
        if self.n_turns.is_multiple_of(CONTROL_FIRST)
            && let Some(request) = self.ports.receive_control()
        {
            self.answer_control(Instant::now(), request);
            return Ok(());
        }
        let found = self.waiter.wait(
            tick,
            || Ok(self.look(&woken)),
            |limit| {
                woken.set(self.sleep(limit)?);
                Ok::<_, ServeError>(())
            },
        )?;
        let now = Instant::now();
        match found {
            Some(Found::Step(request)) => self.answer_step(now, &request),
            Some(Found::Control(request)) => self.answer_control(now, request),
            Some(Found::Event) | None => self.look_around(now)?,
        }
        if now - self.last_tick > BUSY_TICK {
            self.look_around(now)?;
        }
        Ok(())
    }

    fn look(&self, woken: &Cell<bool>) -> Option<Found> {
        if let Some(request) = self.ports.receive_step() {
            return Some(Found::Step(request));
        }
        if let Some(request) = self.ports.receive_control() {
            return Some(Found::Control(request));
        }
        woken.get().then_some(Found::Event)
    }

    /// Sleeps until a wake-up, a signal, a death or a finished reset; returns whether there was one.
    fn sleep(&self, limit: Duration) -> Result<bool, ServeError> {
        let own = [
            self.ports.descriptor(),
            self.resets.descriptor(),
            self.files.descriptor(),
        ];
        let keeper = self.keeper.iter().map(Keeper::descriptor);
        let others = keeper.chain(self.clients.descriptors());
        let descriptors: Vec<BorrowedFd<'_>> = own.into_iter().chain(others).collect();
        let woken = sleep_until_event(&descriptors, limit).map_err(ipc_error("sleep"))?;
        // Not later: what is left ends the next sleep at once.
        self.ports.drain()?;
        Ok(woken)
    }

    fn answer_step(&mut self, now: Instant, request: &ActiveStep) {
        let client = self.clients.identify(request.header());
        let header = *request.user_header();
        let mut reply =
            self.simulator
                .step(now, client, &header, request.payload(), &mut self.payload);
        reply.simulation_nanos = now.elapsed().as_nanos() as u64;
        let listener = listener_id(header.listener_low, header.listener_high);
        self.ports
            .answers()
            .send(request, reply, &self.payload, listener);
        if header.operation == Operation::Step as u32 {
            let worlds = self.simulator.worlds_of(&reply);
            self.publish(worlds);
            self.save_if_due();
        }
    }

    fn answer_control(&mut self, now: Instant, request: ActiveControl) {
        // A holder that died a moment ago must not keep its worlds from the next.
        self.forget_ended_clients();
        let client = self.clients.identify(request.header());
        let surroundings = Surroundings {
            uptime: self.started.elapsed(),
            steps_per_second: self.rate.per_second,
            n_clients: self.ports.n_clients(),
            n_observers: self.ports.observers().0,
        };
        let version = request.user_header().version;
        match self
            .simulator
            .control(now, client, version, request.payload(), &surroundings)
        {
            Outcome::Answer(reply) => self.send_reply(&request, &reply),
            Outcome::Later(orders, awaited) => {
                self.resets.start(orders);
                self.awaiting.push((request, awaited));
                self.answer_awaiting(now);
            }
            Outcome::Changed(worlds, reply) => {
                self.send_reply(&request, &reply);
                self.publish(worlds);
            }
            Outcome::File(job, order) => self.order_file(now, request, job, order),
            Outcome::Shutdown => {
                self.send_reply(&request, &Reply::Done);
                wait_until_taken(&[request]);
                tracing::info!(client = client.pid, "a client asked to shut down");
                self.is_over = true;
            }
        }
    }

    fn send_reply(&mut self, request: &ActiveControl, reply: &Reply) {
        if reply.status() != Status::Ok {
            tracing::debug!(status = ?reply.status(), "refused a control request");
        }
        self.ports
            .answers()
            .send_json(request, reply.status(), reply);
    }

    fn publish(&mut self, worlds: Range<usize>) {
        self.publications
            .publish(&self.ports, &self.simulator, worlds);
    }

    /// Everything that no request asks for.
    fn look_around(&mut self, now: Instant) -> Result<(), ServeError> {
        self.last_tick = now;
        self.forget_abandoned(now);
        self.forget_ended_clients();
        self.take_resets(now);
        self.take_files(now);
        self.is_over |= self.keeper.as_ref().is_some_and(Keeper::has_ended);
        for pid in self.simulator.expire(now) {
            if let Some(unsaid) = self.expiries.pass(now) {
                tracing::warn!(pid, unsaid, "a lease expired");
            }
        }
        self.ports.warn_of_shortage(now);
        self.publications.greet(&self.ports, &self.simulator);
        self.rate.update(now, self.simulator.n_steps());
        Ok(self.ports.check_entries()?)
    }

    fn forget_ended_clients(&mut self) {
        for pid in self.clients.take_dead() {
            let n_leases = self.simulator.end_of_process(pid);
            tracing::info!(pid, n_leases, "a client ended");
            self.cleaner.request();
        }
        let n_leases = self
            .simulator
            .end_of_connections(&self.ports.client_nodes());
        if n_leases > 0 {
            tracing::info!(n_leases, "a connection was closed without a release");
        }
    }
}

impl Rate {
    fn update(&mut self, now: Instant, n_steps: u64) {
        let elapsed = now - self.since;
        if elapsed >= RATE_WINDOW {
            let per_second = (n_steps - self.n_steps) as f64 / elapsed.as_secs_f64();
            *self = Self {
                since: now,
                n_steps,
                per_second,
            };
        }
    }
}

fn threads(n_threads: usize) -> Result<ThreadPool, ServeError> {
    let pool = ThreadPoolBuilder::new().num_threads(n_threads).build();
    pool.map_err(|error| ServeError::Threads {
        n_threads,
        problem: error.to_string(),
    })
}

/// Lease tokens that nobody can guess, below 2^53 so that every JSON reader holds them; never 0.
fn token_source() -> Box<dyn FnMut() -> u64> {
    let entropy = RandomState::new();
    let mut key = [0; 32];
    for (index, bytes) in key.chunks_mut(8).enumerate() {
        bytes.copy_from_slice(&entropy.hash_one(index).to_le_bytes());
    }
    let mut rng = ChaCha8Rng::from_seed(key);
    Box::new(move || (rng.next_u64() >> 11).max(1))
}
