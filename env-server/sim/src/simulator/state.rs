//! The state of a simulator: worlds, leases, and waiting requests.

use super::barrier::{Barrier, Waiter};
use super::beliefs::Beliefs;
use super::lease::{Leases, Refusal};
use crate::config::Checked;
use crate::snapshot::WorldSpec;
use crate::world::{Episode, Robot, Rules, WorldOutcome};
use emberwatch_messages::control::WorldInfo;
use emberwatch_messages::message::Status;
use emberwatch_model::ModelError;
use rayon::ThreadPool;
use std::collections::{HashSet, VecDeque};
use std::ops::Range;
use std::time::Instant;

/// All worlds and leases of a server. It answers requests without I/O and without a clock.
pub struct Simulator {
    pub(super) checked: Checked,
    pub(super) spec: WorldSpec,
    pub(super) beliefs: Beliefs,
    pub(super) places: Vec<Place>,
    pub(super) leases: Leases,
    pub(super) waiting_worlds: Vec<usize>,
    /// Step requests that have stopped waiting but are not answered yet. A request that is to be refused has an `Err`.
    pub(super) settled: VecDeque<(Waiter, Result<(), Refusal>)>,
    /// Worlds that moved for another reason than a step request, such as a deadline.
    pub(super) moved: Vec<usize>,
    pub(super) n_tickets: u64,
    pub(super) threads: ThreadPool,
    pub(super) next_token: Box<dyn FnMut() -> u64 + Send>,
    pub(super) n_steps: u64,
    pub(super) n_refused: u64,
}

pub(super) struct Place {
    pub slot: Slot,
    pub barrier: Barrier,
}

pub(super) enum Slot {
    Ready(Box<Episode>),
    /// A world in its burn-in. `last` and `cells` are its outcome and its robots' cells before the reset.
    Resetting {
        last: WorldOutcome,
        cells: Vec<[u32; 2]>,
        seed: u64,
        episode: u64,
    },
}

pub struct ResetJob {
    pub world: usize,
    pub before: Option<Box<Episode>>,
    /// Number of the new episode. Used only if there is no previous episode.
    pub episode: u64,
    pub seed: u64,
}

impl Simulator {
    /// Creates the worlds of a server, and the jobs for their first burn-in. `next_token` generates lease tokens.
    pub fn new(
        checked: Checked,
        threads: ThreadPool,
        next_token: Box<dyn FnMut() -> u64 + Send>,
    ) -> Result<(Self, Vec<ResetJob>), ModelError> {
        let config = &checked.config;
        let (n_worlds, team) = (config.worlds as usize, config.world.robots as usize);
        let start = |world: usize| ResetJob {
            world,
            before: None,
            episode: 0,
            seed: config.seed.wrapping_add(world as u64),
        };
        let jobs: Vec<ResetJob> = (0..n_worlds).map(start).collect();
        let place = |job| Place {
            slot: Slot::resetting(job, team),
            barrier: Barrier::new(team, config.world.moves),
        };
        let (n_robots, n_cells) = (n_worlds * team, checked.shape.n_cells());
        let simulator = Self {
            spec: WorldSpec::of(&checked)?,
            beliefs: Beliefs::new(n_robots, n_cells, checked.model.n_states()),
            places: jobs.iter().map(place).collect(),
            leases: Leases::new(n_robots),
            checked,
            waiting_worlds: Vec::new(),
            settled: VecDeque::new(),
            moved: Vec::new(),
            n_tickets: 0,
            threads,
            next_token,
            n_steps: 0,
            n_refused: 0,
        };
        Ok((simulator, jobs))
    }

    pub fn put(&mut self, world: usize, episode: Box<Episode>) {
        self.places[world].slot = Slot::Ready(episode);
        self.beliefs.forget(self.robots_of(world));
    }

    pub fn spec(&self) -> &WorldSpec {
        &self.spec
    }

    pub fn is_recorded(&self) -> bool {
        self.checked.recorded.is_some()
    }

    /// Ends expired leases and moves worlds whose deadline has passed. Returns the process id of each expired lease.
    pub fn tick(&mut self, now: Instant) -> Vec<u32> {
        let expired = self.leases.expire(now);
        self.settle(now);
        expired.iter().map(|lease| lease.client.pid).collect()
    }

    /// Ends the leases of a process that has died, and returns their number.
    pub fn end_of_process(&mut self, now: Instant, pid: u32) -> usize {
        let n_leases = self.leases.end_of_process(pid).len();
        self.settle(now);
        n_leases
    }

    /// Ends the leases of closed connections, whose node is not in `nodes`, and returns their number.
    pub fn end_of_connections(&mut self, now: Instant, nodes: &HashSet<u128>) -> usize {
        let n_leases = self.leases.end_of_nodes_except(nodes).len();
        self.settle(now);
        n_leases
    }

    /// Returns the episode of a world, or `None` if the world does not exist or is being reset.
    pub fn episode(&self, world: usize) -> Option<&Episode> {
        match &self.places.get(world)?.slot {
            Slot::Ready(episode) => Some(episode),
            Slot::Resetting { .. } => None,
        }
    }

    pub fn worlds(&self) -> Range<usize> {
        0..self.places.len()
    }

    pub fn n_steps(&self) -> u64 {
        self.n_steps
    }

    pub(super) fn range(&self, first: u32, n_worlds: u32) -> Result<Range<usize>, Refusal> {
        checked(first, n_worlds, self.places.len(), Status::NoSuchWorld)
    }

    pub(super) fn robot_range(&self, first: u32, n_robots: u32) -> Result<Range<usize>, Refusal> {
        let n_all = self.places.len() * self.spec.rules.n_robots;
        checked(first, n_robots, n_all, Status::NoSuchRobot)
    }

    pub fn worlds_of(&self, robots: &Range<usize>) -> Range<usize> {
        let team = self.spec.rules.n_robots;
        robots.start / team..robots.end.div_ceil(team)
    }

    pub(super) fn robots_of(&self, world: usize) -> Range<usize> {
        let team = self.spec.rules.n_robots;
        world * team..(world + 1) * team
    }

    pub(super) fn check_present(&self, worlds: &Range<usize>) -> Result<(), Refusal> {
        let resetting = worlds.clone().find(|&world| self.episode(world).is_none());
        resetting.map_or(Ok(()), |world| {
            Err(Refusal::new(Status::Resetting, world as u64))
        })
    }

    pub(super) fn world_info(&self, world: usize) -> WorldInfo {
        let (outcome, robots) = match &self.places[world].slot {
            Slot::Ready(episode) => (episode.outcome(), cells(episode)),
            Slot::Resetting { last, cells, .. } => (last, cells.clone()),
        };
        WorldInfo {
            world: world as u32,
            step: outcome.step,
            seed: outcome.seed,
            episode: outcome.episode,
            robots,
        }
    }
}

fn checked(first: u32, n: u32, n_all: usize, otherwise: Status) -> Result<Range<usize>, Refusal> {
    let (first, end) = (first as usize, first as usize + n as usize);
    if first < end && end <= n_all {
        return Ok(first..end);
    }
    Err(Refusal::new(otherwise, n_all as u64))
}

/// Intersects `robots` with the robots of a world. Returns a range of indices within the world.
pub(super) fn within(robots: &Range<usize>, of_world: Range<usize>) -> Range<usize> {
    let (first, end) = (of_world.start, of_world.end);
    robots.start.max(first) - first..robots.end.min(end) - first
}

pub(super) fn cells(episode: &Episode) -> Vec<[u32; 2]> {
    let robots = episode.robots().iter();
    let cells = robots.map(Robot::cell);
    cells
        .map(|cell| [cell.row as u32, cell.col as u32])
        .collect()
}

impl Slot {
    pub(super) fn resetting(job: &ResetJob, n_robots: usize) -> Self {
        Self::Resetting {
            last: WorldOutcome::default(),
            cells: vec![[0, 0]; n_robots],
            seed: job.seed,
            episode: job.episode,
        }
    }
}

impl ResetJob {
    /// Simulates the burn-in. This is the slow part of a reset, and any thread can run it.
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
