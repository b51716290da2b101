//! The worlds and leases of a server.

use super::beliefs::Beliefs;
use super::lease::{Leases, Refusal};
use crate::config::Checked;
use crate::snapshot::WorldSpec;
use crate::world::{Episode, Rules};
use protocol::control::WorldInfo;
use protocol::message::{Status, StepResult};
use protocol::model::ModelError;
use rayon::ThreadPool;
use std::collections::HashSet;
use std::ops::Range;
use std::time::Instant;

/// All worlds and leases of a server: requests in, answers out, no I/O and no clock.
pub struct Simulator {
    pub(super) checked: Checked,
    pub(super) spec: WorldSpec,
    pub(super) beliefs: Beliefs,
    pub(super) slots: Vec<Slot>,
    pub(super) leases: Leases,
    pub(super) threads: ThreadPool,
    pub(super) next_token: Box<dyn FnMut() -> u64>,
    pub(super) n_steps: u64,
    pub(super) n_refused: u64,
}

/// A world, or what is known of it during its burn-in.
pub(super) enum Slot {
    Ready(Box<Episode>),
    /// `last` is its result before.
    Resetting {
        last: StepResult,
        seed: u64,
        episode: u64,
    },
}

/// A world to reset, taken out of the simulator.
pub struct ResetJob {
    pub world: usize,
    /// Its episode, if it had one before.
    pub before: Option<Box<Episode>>,
    /// The number of its new one, if it had none.
    pub episode: u64,
    pub seed: u64,
}

impl Simulator {
    /// The worlds of a server and the jobs that start them; `next_token` makes the tokens of leases.
    ///
    /// # Errors
    /// If the model does not fit the grid.
    pub fn new(
        checked: Checked,
        threads: ThreadPool,
        next_token: Box<dyn FnMut() -> u64>,
    ) -> Result<(Self, Vec<ResetJob>), ModelError> {
        let config = &checked.config;
        let spec = WorldSpec::of(&checked)?;
        let beliefs = Beliefs::new(
            config.worlds as usize,
            checked.shape.n_cells(),
            checked.model.n_states(),
        );
        let (n_worlds, first_seed) = (config.worlds as usize, config.seed);
        let start = |world: usize| ResetJob {
            world,
            before: None,
            episode: 0,
            seed: first_seed.wrapping_add(world as u64),
        };
        let jobs: Vec<ResetJob> = (0..n_worlds).map(start).collect();
        let slots = jobs.iter().map(Slot::resetting).collect();
        let leases = Leases::new(n_worlds);
        Ok((
            Self {
                checked,
                spec,
                beliefs,
                slots,
                leases,
                threads,
                next_token,
                n_steps: 0,
                n_refused: 0,
            },
            jobs,
        ))
    }

    /// Replaces a world, for example by the same one after its reset.
    pub fn put(&mut self, world: usize, episode: Box<Episode>) {
        self.slots[world] = Slot::Ready(episode);
        self.beliefs.forget(world);
    }

    /// What worlds must fit.
    pub fn spec(&self) -> &WorldSpec {
        &self.spec
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

    /// Every world.
    pub fn worlds(&self) -> Range<usize> {
        0..self.slots.len()
    }

    /// World steps so far.
    pub fn n_steps(&self) -> u64 {
        self.n_steps
    }

    pub(super) fn range(&self, first: u32, n_worlds: u32) -> Result<Range<usize>, Refusal> {
        let (first, end) = (first as usize, first as usize + n_worlds as usize);
        if first < end && end <= self.slots.len() {
            return Ok(first..end);
        }
        Err(Refusal::new(Status::NoSuchWorld, self.slots.len() as u64))
    }

    pub(super) fn check_present(&self, worlds: &Range<usize>) -> Result<(), Refusal> {
        let resetting = worlds.clone().find(|&world| self.episode(world).is_none());
        resetting.map_or(Ok(()), |world| {
            Err(Refusal::new(Status::Resetting, world as u64))
        })
    }

    pub(super) fn world_info(&self, world: usize) -> WorldInfo {
        let result = match &self.slots[world] {
            Slot::Ready(episode) => episode.result(),
            Slot::Resetting { last, .. } => last,
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
}

impl Slot {
    pub(super) fn resetting(job: &ResetJob) -> Self {
        Self::Resetting {
            last: StepResult::default(),
            seed: job.seed,
            episode: job.episode,
        }
    }
}

impl ResetJob {
    /// Simulates the burn-in: the slow part, for any thread.
    pub fn run(self, rules: &Rules) -> (usize, Box<Episode>) {
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
