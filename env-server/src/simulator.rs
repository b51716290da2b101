//! All worlds and leases of a server: requests in, answers out, no I/O and no clock.
//!
//! Every request is checked whole before anything changes; a refusal changes nothing. What a client
//! sends is bytes and numbers it chose freely: nothing here may panic on them.

use crate::config::Checked;
use crate::episode::{Episode, Rules};
use crate::lease::{Claim, ClientId, Leases, Refusal};
use protocol::channels::MAX_CLIENTS;
use protocol::control::{
    LeaseInfo, MAX_CONTROL_BYTES, Reply, Request, ServerInfo, ServerStatus, WorldInfo, WorldSeed,
    WorldStatus,
};
use protocol::message::{
    FLAG_FULL_COVERAGE, Operation, Status, StepReply, StepRequest, StepResult, VERSION,
};
use protocol::model::ModelError;
use protocol::path::{MoveError, path_from_bytes};
use protocol::randomness::{Purpose, stream};
use protocol::{Coverage, Move};
use rand_chacha::rand_core::Rng;
use rayon::ThreadPool;
use rayon::iter::{IndexedParallelIterator, IntoParallelRefMutIterator, ParallelIterator};
use rayon::slice::ParallelSlice;
use std::ops::Range;
use std::time::{Duration, Instant};

/// Cells of a batch from which on it is stepped by several threads: below it, waking them (tens of
/// microseconds) costs more than it saves at about 1 ns a cell.
const PARALLEL_CELLS: usize = 1 << 17;

/// Longest lease a client may ask for: a day.
const LONGEST_LEASE: Duration = Duration::from_secs(86_400);

/// Shortest lease a client may ask for.
const SHORTEST_LEASE: Duration = Duration::from_millis(100);

/// Worlds and leases.
pub struct Simulator {
    checked: Checked,
    rules: Rules,
    slots: Vec<Slot>,
    leases: Leases,
    threads: ThreadPool,
    next_token: Box<dyn FnMut() -> u64>,
    n_steps: u64,
    n_refused: u64,
}

/// Where a world is.
enum Slot {
    Ready(Box<Episode>),
    /// On its way through burn-in; this is where it stood before.
    Resetting(StepResult),
}

/// An answer that waits until worlds have been reset.
pub struct Awaited {
    worlds: Vec<usize>,
    /// The lease to tell of; `None` tells of the worlds alone.
    lease: Option<(u64, ClientId)>,
}

/// What the server itself knows and a status answer tells.
#[derive(Debug, Clone, Copy, Default)]
pub struct Surroundings {
    /// Time since the server started.
    pub uptime: Duration,
    /// World steps a second, lately.
    pub steps_per_second: f64,
    /// Clients on the step channel.
    pub n_clients: usize,
    /// Observers of frames.
    pub n_observers: usize,
}

/// What a control request leads to.
pub enum Outcome {
    /// An answer now.
    Answer(Reply),
    /// Resets to carry out, and an answer when the worlds it names are ready.
    Later(Vec<ResetOrder>, Awaited),
    /// An answer now, then the end of the server.
    Shutdown,
}

/// A world to reset, taken out of the simulator.
pub struct ResetOrder {
    /// The world.
    pub world: usize,
    /// Its episode, if it had one before.
    pub episode: Option<Box<Episode>>,
    /// Its new seed.
    pub seed: u64,
}

/// A step request whose numbers were checked.
struct Batch {
    worlds: Range<usize>,
    coverage: Coverage,
    /// One path after the other.
    moves: Vec<Move>,
    n_moves: usize,
}

impl Simulator {
    /// The worlds of a server and the orders that start them; `next_token` names leases.
    ///
    /// # Errors
    /// As [`Rules::new`].
    pub fn new(
        checked: Checked,
        threads: ThreadPool,
        next_token: Box<dyn FnMut() -> u64>,
    ) -> Result<(Self, Vec<ResetOrder>), ModelError> {
        let config = &checked.config;
        let rules = Rules::new(
            &checked.model,
            checked.shape,
            config.burn_in,
            config.max_steps,
            config.start,
        )?;
        let (n_worlds, first_seed) = (config.worlds as usize, config.seed);
        let slots = (0..n_worlds)
            .map(|_| Slot::Resetting(StepResult::default()))
            .collect();
        let start = |world: usize| ResetOrder {
            world,
            episode: None,
            seed: first_seed.wrapping_add(world as u64),
        };
        let orders = (0..n_worlds).map(start).collect();
        let leases = Leases::new(n_worlds);
        Ok((
            Self {
                checked,
                rules,
                slots,
                leases,
                threads,
                next_token,
                n_steps: 0,
                n_refused: 0,
            },
            orders,
        ))
    }

    /// Answers a step request; results and frames go to `payload`, which is left empty by a refusal.
    pub fn step(
        &mut self,
        now: Instant,
        client: ClientId,
        request: &StepRequest,
        paths: &[u8],
        payload: &mut Vec<u8>,
    ) -> StepReply {
        payload.clear();
        let outcome = self.try_step(now, client, request, paths);
        let header = StepReply {
            version: VERSION,
            sequence: request.sequence,
            first_world: request.first_world,
            height: self.rules.shape.height() as u32,
            width: self.rules.shape.width() as u32,
            ..StepReply::default()
        };
        match outcome {
            Ok(worlds) => {
                let n_worlds = worlds.len() as u32;
                self.write_worlds(worlds, payload);
                StepReply {
                    status: Status::Ok as u32,
                    n_worlds,
                    ..header
                }
            }
            Err(refusal) => {
                self.n_refused += 1;
                StepReply {
                    status: refusal.status as u32,
                    detail: refusal.detail,
                    ..header
                }
            }
        }
    }

    /// Handles a control request.
    pub fn control(
        &mut self,
        now: Instant,
        client: ClientId,
        version: u32,
        text: &[u8],
        surroundings: &Surroundings,
    ) -> Outcome {
        let outcome = self.try_control(now, client, version, text, surroundings);
        outcome.unwrap_or_else(|reply| {
            self.n_refused += 1;
            Outcome::Answer(reply)
        })
    }

    /// Puts a world that was reset back.
    pub fn finish_reset(&mut self, world: usize, episode: Box<Episode>) {
        self.slots[world] = Slot::Ready(episode);
    }

    /// The answer to a request that had to wait, once its worlds are ready.
    pub fn answer_awaited(&mut self, now: Instant, awaited: &Awaited) -> Option<Reply> {
        if awaited
            .worlds
            .iter()
            .any(|&world| self.episode(world).is_none())
        {
            return None;
        }
        let worlds = awaited
            .worlds
            .iter()
            .map(|&world| self.world_info(world))
            .collect();
        let Some((token, client)) = awaited.lease else {
            return Some(Reply::Reset { worlds });
        };
        // Waiting is use: a burn-in longer than the lease must not end it.
        Some(match self.leases.renew(now, token, client) {
            Ok(lease) => Reply::Lease(LeaseInfo {
                lease: token,
                ttl_millis: lease.time_to_live.as_millis() as u64,
                worlds,
            }),
            Err(lost) => refusal(lost),
        })
    }

    /// The rules, for those who carry out resets.
    pub fn rules(&self) -> &Rules {
        &self.rules
    }

    /// Ends leases that have expired; returns the pid of each.
    pub fn expire(&mut self, now: Instant) -> Vec<u32> {
        self.leases
            .expire(now)
            .iter()
            .map(|lease| lease.client.pid)
            .collect()
    }

    /// Ends the leases of a process that has died; returns how many there were.
    pub fn end_of_process(&mut self, pid: u32) -> usize {
        self.leases.end_of_process(pid).len()
    }

    /// The episode of a world that is not being reset.
    pub fn episode(&self, world: usize) -> Option<&Episode> {
        match self.slots.get(world)? {
            Slot::Ready(episode) => Some(episode),
            Slot::Resetting(_) => None,
        }
    }

    /// The worlds of a step request that was answered with `Ok`.
    pub fn worlds_of(&self, reply: &StepReply) -> Range<usize> {
        let first = reply.first_world as usize;
        first..first + reply.n_worlds as usize
    }

    /// Every world.
    pub fn worlds(&self) -> Range<usize> {
        0..self.slots.len()
    }

    /// World steps so far.
    pub fn n_steps(&self) -> u64 {
        self.n_steps
    }

    fn try_step(
        &mut self,
        now: Instant,
        client: ClientId,
        request: &StepRequest,
        paths: &[u8],
    ) -> Result<Range<usize>, Refusal> {
        if request.version != VERSION {
            return Err(Refusal::new(Status::VersionMismatch, VERSION.into()));
        }
        let operation = Operation::try_from(request.operation);
        let operation = operation
            .map_err(|unknown| Refusal::new(Status::UnknownOperation, unknown.value.into()))?;
        let worlds = self.range(request.first_world, request.n_worlds)?;
        match operation {
            Operation::Observe => self.check_observation(&worlds, paths)?,
            Operation::Step => {
                let batch = self.check_batch(worlds.clone(), request, paths)?;
                self.leases.use_lease(now, request.lease, client, &worlds)?;
                self.check_ready(&worlds)?;
                self.run(batch);
            }
        }
        Ok(worlds)
    }

    fn range(&self, first: u32, n_worlds: u32) -> Result<Range<usize>, Refusal> {
        let (first, end) = (first as usize, first as usize + n_worlds as usize);
        if first < end && end <= self.slots.len() {
            return Ok(first..end);
        }
        Err(Refusal::new(Status::NoSuchWorld, self.slots.len() as u64))
    }

    fn check_observation(&self, worlds: &Range<usize>, paths: &[u8]) -> Result<(), Refusal> {
        if !paths.is_empty() {
            return Err(Refusal::new(Status::WrongLength, 0));
        }
        let resetting = worlds.clone().find(|&world| self.episode(world).is_none());
        resetting.map_or(Ok(()), |world| {
            Err(Refusal::new(Status::Resetting, world as u64))
        })
    }

    fn check_batch(
        &self,
        worlds: Range<usize>,
        request: &StepRequest,
        paths: &[u8],
    ) -> Result<Batch, Refusal> {
        let n_moves = self.checked.config.moves;
        if request.n_moves as usize != n_moves {
            return Err(Refusal::new(Status::WrongPathLength, n_moves as u64));
        }
        let expected = worlds.len() * n_moves;
        if paths.len() != expected {
            return Err(Refusal::new(Status::WrongLength, expected as u64));
        }
        let moves = path_from_bytes(paths);
        let moves =
            moves.map_err(|MoveError { index, .. }| Refusal::new(Status::BadMove, index as u64))?;
        let asks_full = request.flags & FLAG_FULL_COVERAGE != 0;
        let coverage = self.checked.config.coverage.coverage(asks_full);
        let coverage = coverage.map_err(|status| Refusal::new(status, 0))?;
        Ok(Batch {
            worlds,
            coverage,
            moves,
            n_moves,
        })
    }

    fn check_ready(&self, worlds: &Range<usize>) -> Result<(), Refusal> {
        for world in worlds.clone() {
            match self.episode(world) {
                None => return Err(Refusal::new(Status::Resetting, world as u64)),
                Some(episode) if episode.is_over() => {
                    return Err(Refusal::new(Status::EpisodeOver, world as u64));
                }
                Some(_) => {}
            }
        }
        Ok(())
    }

    fn run(&mut self, batch: Batch) {
        let (rules, slots) = (&self.rules, &mut self.slots[batch.worlds.clone()]);
        let step = |(slot, path): (&mut Slot, &[Move])| {
            if let Slot::Ready(episode) = slot {
                episode.step(rules, path, batch.coverage);
            }
        };
        if slots.len() * rules.shape.n_cells() >= PARALLEL_CELLS {
            let paths = batch.moves.par_chunks(batch.n_moves);
            self.threads
                .install(|| slots.par_iter_mut().zip(paths).for_each(step));
        } else {
            let paths = batch.moves.chunks(batch.n_moves);
            slots.iter_mut().zip(paths).for_each(step);
        }
        self.n_steps += batch.worlds.len() as u64;
    }

    fn write_worlds(&self, worlds: Range<usize>, payload: &mut Vec<u8>) {
        for episode in worlds.clone().filter_map(|world| self.episode(world)) {
            payload.extend_from_slice(bytemuck::bytes_of(episode.result()));
        }
        for episode in worlds.filter_map(|world| self.episode(world)) {
            payload.extend_from_slice(episode.frame().as_bytes());
        }
    }

    fn try_control(
        &mut self,
        now: Instant,
        client: ClientId,
        version: u32,
        text: &[u8],
        surroundings: &Surroundings,
    ) -> Result<Outcome, Reply> {
        if version != VERSION {
            return Err(Reply::refusal(Status::VersionMismatch, VERSION.into()));
        }
        Ok(match parse(text)? {
            Request::Hello { protocol, .. } if protocol != VERSION => {
                return Err(Reply::refusal(Status::VersionMismatch, VERSION.into()));
            }
            Request::Hello { .. } => Outcome::Answer(Reply::Hello(Box::new(self.info()))),
            Request::Acquire {
                first_world,
                n_worlds,
                takeover,
                ttl_millis,
            } => {
                let worlds = self.range(first_world, n_worlds).map_err(refusal)?;
                let time_to_live = self.time_to_live(ttl_millis);
                self.acquire(
                    now,
                    Claim {
                        client,
                        worlds,
                        takeover,
                        time_to_live,
                    },
                )?
            }
            Request::Renew { lease } => {
                let worlds = self
                    .leases
                    .renew(now, lease, client)
                    .map_err(refusal)?
                    .worlds
                    .clone()
                    .collect();
                Outcome::Later(
                    Vec::new(),
                    Awaited {
                        worlds,
                        lease: Some((lease, client)),
                    },
                )
            }
            Request::Release { lease } => {
                self.leases.release(now, lease, client).map_err(refusal)?;
                Outcome::Answer(Reply::Done)
            }
            Request::Reset { lease, worlds } => self.order_resets(now, client, lease, &worlds)?,
            Request::Status => Outcome::Answer(Reply::Status(self.status(surroundings))),
            Request::Shutdown => Outcome::Shutdown,
        })
    }

    fn time_to_live(&self, ttl_millis: Option<u64>) -> Duration {
        let millis = ttl_millis.unwrap_or(self.checked.config.lease_millis);
        Duration::from_millis(millis).clamp(SHORTEST_LEASE, LONGEST_LEASE)
    }

    fn acquire(&mut self, now: Instant, claim: Claim) -> Result<Outcome, Reply> {
        let (token, client) = ((self.next_token)(), claim.client);
        let worlds = self
            .leases
            .acquire(now, claim, token)
            .map_err(refusal)?
            .worlds
            .clone()
            .collect();
        Ok(Outcome::Later(
            Vec::new(),
            Awaited {
                worlds,
                lease: Some((token, client)),
            },
        ))
    }

    fn order_resets(
        &mut self,
        now: Instant,
        client: ClientId,
        lease: u64,
        worlds: &[WorldSeed],
    ) -> Result<Outcome, Reply> {
        for (index, WorldSeed { world, .. }) in worlds.iter().enumerate() {
            let range = self.range(*world, 1).map_err(refusal)?;
            self.leases
                .use_lease(now, lease, client, &range)
                .map_err(refusal)?;
            if self.episode(range.start).is_none() {
                return Err(Reply::refusal(Status::Resetting, (*world).into()));
            }
            if worlds[..index]
                .iter()
                .any(|earlier| earlier.world == *world)
            {
                return Err(malformed(format!(
                    "reset: expected each world once, got world {world} twice"
                )));
            }
        }
        let orders = worlds
            .iter()
            .filter_map(|order| self.take_for_reset(order))
            .collect();
        let worlds = worlds.iter().map(|order| order.world as usize).collect();
        Ok(Outcome::Later(
            orders,
            Awaited {
                worlds,
                lease: None,
            },
        ))
    }

    fn take_for_reset(&mut self, order: &WorldSeed) -> Option<ResetOrder> {
        let world = order.world as usize;
        let last = *self.episode(world)?.result();
        match std::mem::replace(&mut self.slots[world], Slot::Resetting(last)) {
            Slot::Ready(episode) => Some(ResetOrder {
                world,
                episode: Some(episode),
                seed: order.seed.unwrap_or_else(|| next_seed(&last)),
            }),
            Slot::Resetting(_) => None,
        }
    }

    fn world_info(&self, world: usize) -> WorldInfo {
        let result = match &self.slots[world] {
            Slot::Ready(episode) => episode.result(),
            Slot::Resetting(last) => last,
        };
        let StepResult {
            step,
            seed,
            episode,
            row,
            col,
            ..
        } = *result;
        WorldInfo {
            world: world as u32,
            step,
            seed,
            episode,
            robot: [row, col],
        }
    }

    fn info(&self) -> ServerInfo {
        let (config, file) = (&self.checked.config, self.checked.model.file());
        ServerInfo {
            protocol: VERSION,
            build: env!("CARGO_PKG_VERSION").into(),
            pid: std::process::id(),
            height: config.height,
            width: config.width,
            n_moves: config.moves,
            n_worlds: config.worlds,
            n_observations: file.observations.len(),
            observations: file
                .observations
                .iter()
                .map(|observation| observation.name.clone())
                .collect(),
            model: config
                .reveal_model
                .then(|| toml::to_string(file).expect("invariant: model files serialise")),
            burn_in: config.burn_in,
            max_steps: config.max_steps,
            max_clients: MAX_CLIENTS,
            coverage: config.coverage,
            publish_truth: config.publish_truth,
            lease_millis: config.lease_millis,
        }
    }

    fn status(&self, surroundings: &Surroundings) -> ServerStatus {
        let world_status = |world| WorldStatus {
            info: self.world_info(world),
            holder_pid: self.leases.holder(world).map(|lease| lease.client.pid),
            resetting: self.episode(world).is_none(),
        };
        ServerStatus {
            pid: std::process::id(),
            uptime_millis: surroundings.uptime.as_millis() as u64,
            n_steps: self.n_steps,
            steps_per_second: surroundings.steps_per_second,
            n_refused: self.n_refused,
            n_clients: surroundings.n_clients,
            n_observers: surroundings.n_observers,
            worlds: (0..self.slots.len()).map(world_status).collect(),
        }
    }
}

fn parse(text: &[u8]) -> Result<Request, Reply> {
    if text.len() > MAX_CONTROL_BYTES {
        return Err(malformed(format!(
            "expected at most {MAX_CONTROL_BYTES} bytes, got {}",
            text.len()
        )));
    }
    serde_json::from_slice(text).map_err(|error| malformed(error.to_string()))
}

fn malformed(problem: String) -> Reply {
    let message = format!("{}: {problem}", Status::Malformed.explain(0));
    Reply::Error {
        status: Status::Malformed,
        detail: 0,
        message,
    }
}

fn refusal(refusal: Refusal) -> Reply {
    Reply::refusal(refusal.status, refusal.detail)
}

/// The seed after an episode whose reset names none; below 2^53, which every JSON reader holds.
fn next_seed(last: &StepResult) -> u64 {
    stream(last.seed, Purpose::Episode, last.episode).next_u64() >> 11
}

impl ResetOrder {
    /// Brings the world to k = 0: the slow part, for any thread.
    pub fn carry_out(self, rules: &Rules) -> (usize, Box<Episode>) {
        let episode = match self.episode {
            None => Box::new(Episode::new(rules, self.seed)),
            Some(mut episode) => {
                episode.reset(rules, self.seed);
                episode
            }
        };
        (self.world, episode)
    }
}
