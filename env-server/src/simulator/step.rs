//! Step requests: check the whole, then step, observe or recall.
//!
//! A refusal changes nothing. What a client sends is bytes and numbers it chose freely: nothing here may panic on them.

use super::lease::{ClientId, Refusal};
use super::state::{Simulator, Slot};
use crate::world::PastStep;
use protocol::message::{FLAG_FULL_COVERAGE, Operation, Status, StepReply, StepRequest, VERSION};
use protocol::path::{MoveError, path_from_bytes};
use protocol::{Coverage, Move};
use rayon::iter::{IndexedParallelIterator, IntoParallelRefMutIterator, ParallelIterator};
use rayon::slice::ParallelSlice;
use std::ops::Range;
use std::time::Instant;

/// Cells of a batch from which on it is stepped by several threads: below it, waking them (tens of
/// microseconds) costs more than it saves at about 1 ns a cell.
const PARALLEL_CELLS: usize = 1 << 17;

/// A step request whose numbers were checked.
struct Batch {
    worlds: Range<usize>,
    coverage: Coverage,
    /// One path after the other.
    moves: Vec<Move>,
    n_moves: usize,
}

impl Simulator {
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
            height: self.spec.rules.shape.height() as u32,
            width: self.spec.rules.shape.width() as u32,
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

    /// The worlds of a step request that was answered with `Ok`.
    pub fn worlds_of(&self, reply: &StepReply) -> Range<usize> {
        let first = reply.first_world as usize;
        first..first + reply.n_worlds as usize
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

    fn check_observation(&self, worlds: &Range<usize>, paths: &[u8]) -> Result<(), Refusal> {
        if !paths.is_empty() {
            return Err(Refusal::new(Status::WrongLength, 0));
        }
        self.check_present(worlds)
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
        let (rules, slots) = (&self.spec.rules, &mut self.slots[batch.worlds.clone()]);
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
        let past: Vec<&PastStep> = episodes
            .filter_map(|episode| episode.recall(step).ok())
            .collect();
        for past in &past {
            payload.extend_from_slice(bytemuck::bytes_of(&past.result));
        }
        for past in &past {
            let start = payload.len();
            payload.resize(start + self.spec.rules.shape.n_cells(), 0);
            past.write_frame(&mut payload[start..]);
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
