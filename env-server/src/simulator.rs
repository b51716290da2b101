//! All worlds and leases of a server: requests in, answers out, no I/O and no clock.
//!
//! Every request is checked whole before anything changes; a refusal changes nothing. What a client
//! sends is bytes and numbers it chose freely: nothing here may panic on them.

mod control;
mod stored;

pub use control::{Awaited, Outcome, Surroundings};
pub use stored::FileOrder;

use crate::beliefs::Beliefs;
use crate::config::Checked;
use crate::episode::{Episode, Rules};
use crate::history::Seen;
use crate::lease::{ClientId, Leases, Refusal};
use crate::snapshot::Settings;
use protocol::message::{
    FLAG_FULL_COVERAGE, Operation, Status, StepReply, StepRequest, StepResult, VERSION,
};
use protocol::model::ModelError;
use protocol::path::{MoveError, path_from_bytes};
use protocol::{Coverage, Move};
use rayon::ThreadPool;
use rayon::iter::{IndexedParallelIterator, IntoParallelRefMutIterator, ParallelIterator};
use rayon::slice::ParallelSlice;
use std::collections::HashSet;
use std::ops::Range;
use std::time::Instant;

/// Cells of a batch from which on it is stepped by several threads: below it, waking them (tens of
/// microseconds) costs more than it saves at about 1 ns a cell.
const PARALLEL_CELLS: usize = 1 << 17;

/// Worlds and leases.
pub struct Simulator {
    checked: Checked,
    rules: Rules,
    settings: Settings,
    beliefs: Beliefs,
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
    Resetting {
        last: StepResult,
        seed: u64,
        episode: u64,
    },
}

/// A world to reset, taken out of the simulator.
pub struct ResetOrder {
    /// The world.
    pub world: usize,
    /// Its episode, if it had one before.
    pub before: Option<Box<Episode>>,
    /// The number of its new one, if it had none.
    pub episode: u64,
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
        let mut rules = Rules::new(
            &checked.model,
            checked.shape,
            config.burn_in,
            config.max_steps,
            config.start,
        )?;
        (rules.history, rules.n_moves) = (config.history as usize, config.moves);
        let settings = Settings::of(&checked);
        let beliefs = Beliefs::new(config.worlds as usize, checked.shape.n_cells());
        let (n_worlds, first_seed) = (config.worlds as usize, config.seed);
        let start = |world: usize| ResetOrder {
            world,
            before: None,
            episode: 0,
            seed: first_seed.wrapping_add(world as u64),
        };
        let orders: Vec<ResetOrder> = (0..n_worlds).map(start).collect();
        let slots = orders.iter().map(Slot::resetting).collect();
        let leases = Leases::new(n_worlds);
        Ok((
            Self {
                checked,
                rules,
                settings,
                beliefs,
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
            Ok((operation, worlds)) => {
                let n_worlds = worlds.len() as u32;
                match operation {
                    Operation::Recall => self.write_past(worlds, request.step, payload),
                    _ => self.write_worlds(worlds, payload),
                }
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

    /// Puts a world that was reset back, or one that a server begins with.
    pub fn finish_reset(&mut self, world: usize, episode: Box<Episode>) {
        self.put(world, episode);
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

    /// Ends the leases of connections that were closed: of nodes that are not among these.
    pub fn end_of_connections(&mut self, nodes: &HashSet<u128>) -> usize {
        self.leases.end_of_nodes_except(nodes).len()
    }

    /// The episode of a world that is not being reset.
    pub fn episode(&self, world: usize) -> Option<&Episode> {
        match self.slots.get(world)? {
            Slot::Ready(episode) => Some(episode),
            Slot::Resetting { .. } => None,
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
    ) -> Result<(Operation, Range<usize>), Refusal> {
        if request.version != VERSION {
            return Err(Refusal::new(Status::VersionMismatch, VERSION.into()));
        }
        let operation = Operation::try_from(request.operation);
        let operation = operation
            .map_err(|unknown| Refusal::new(Status::UnknownOperation, unknown.value.into()))?;
        let worlds = self.range(request.first_world, request.n_worlds)?;
        match operation {
            Operation::Observe => self.check_observation(&worlds, paths)?,
            Operation::Recall => {
                self.check_observation(&worlds, paths)?;
                self.check_kept(&worlds, request.step)?;
            }
            Operation::Step => {
                let batch = self.check_batch(worlds.clone(), request, paths)?;
                self.leases.use_lease(now, request.lease, client, &worlds)?;
                self.check_ready(&worlds)?;
                self.run(batch);
            }
        }
        Ok((operation, worlds))
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
        self.check_present(worlds)
    }

    fn check_present(&self, worlds: &Range<usize>) -> Result<(), Refusal> {
        let resetting = worlds.clone().find(|&world| self.episode(world).is_none());
        resetting.map_or(Ok(()), |world| {
            Err(Refusal::new(Status::Resetting, world as u64))
        })
    }

    fn check_kept(&self, worlds: &Range<usize>, step: u64) -> Result<(), Refusal> {
        let mut episodes = worlds.clone().filter_map(|world| self.episode(world));
        let missing = episodes.find_map(|episode| episode.recall(step).err());
        missing.map_or(Ok(()), |nearest| {
            Err(Refusal::new(Status::NotKept, nearest))
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
        if request.flags & !FLAG_FULL_COVERAGE != 0 {
            return Err(Refusal::new(Status::UnknownFlags, request.flags.into()));
        }
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

    fn write_past(&self, worlds: Range<usize>, step: u64, payload: &mut Vec<u8>) {
        let episodes = worlds.filter_map(|world| self.episode(world));
        let seen: Vec<&Seen> = episodes
            .filter_map(|episode| episode.recall(step).ok())
            .collect();
        for seen in &seen {
            payload.extend_from_slice(bytemuck::bytes_of(&seen.result));
        }
        for seen in &seen {
            let start = payload.len();
            payload.resize(start + self.rules.shape.n_cells(), 0);
            seen.write_frame(&mut payload[start..]);
        }
    }

    fn write_worlds(&self, worlds: Range<usize>, payload: &mut Vec<u8>) {
        for episode in worlds.clone().filter_map(|world| self.episode(world)) {
            payload.extend_from_slice(bytemuck::bytes_of(episode.result()));
        }
        for episode in worlds.filter_map(|world| self.episode(world)) {
            payload.extend_from_slice(episode.frame().as_bytes());
        }
    }
}

impl Slot {
    /// A world on its way through the burn-in of a new one.
    fn resetting(order: &ResetOrder) -> Self {
        Self::Resetting {
            last: StepResult::default(),
            seed: order.seed,
            episode: order.episode,
        }
    }
}

impl ResetOrder {
    /// Brings the world to k = 0: the slow part, for any thread.
    pub fn carry_out(self, rules: &Rules) -> (usize, Box<Episode>) {
        let episode = match self.before {
            None => Box::new(Episode::numbered(rules, self.seed, self.episode)),
            Some(mut episode) => {
                episode.reset(rules, self.seed);
                episode
            }
        };
        (self.world, episode)
    }
}

#[cfg(test)]
mod tests;
