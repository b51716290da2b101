//! Control requests: parsing, checks, and answers, some of which wait until worlds are ready.

use super::lease::{Claim, ClientId};
use super::outcome::{Outcome, PendingReply, ServerStats, malformed, refusal};
use super::state::{ResetJob, Simulator, Slot, cells};
use crate::config::Checked;
use crate::snapshot::Settings;
use crate::world::WorldOutcome;
use emberwatch_messages::capacity::MAX_CLIENTS;
use emberwatch_messages::control::{
    AirspaceInfo, LeaseInfo, RecordedWorld, Reply, Request, ServerInfo, ServerStatus, WorldSeed,
    WorldStatus, parse,
};
use emberwatch_messages::message::{Status, VERSION};
use emberwatch_messages::process::pid_namespace;
use emberwatch_model::CellMap;
use emberwatch_model::Model;
use emberwatch_model::randomness::{Purpose, stream};
use rand_chacha::rand_core::Rng;
use std::ops::Range;
use std::time::{Duration, Instant};

const LONGEST_LEASE: Duration = Duration::from_secs(86_400);

const SHORTEST_LEASE: Duration = Duration::from_millis(100);

impl Simulator {
    pub fn control(
        &mut self,
        now: Instant,
        client: ClientId,
        version: u32,
        text: &[u8],
        stats: &ServerStats,
    ) -> Outcome {
        let outcome =
            read(version, text).and_then(|request| self.try_control(now, client, request, stats));
        outcome.unwrap_or_else(|reply| {
            self.n_refused += 1;
            Outcome::Answer(reply)
        })
    }

    /// Returns the answer to a waiting request, or `None` if its worlds are not ready yet.
    pub fn pending_reply(&mut self, now: Instant, pending: &PendingReply) -> Option<Reply> {
        let mut worlds = pending.worlds.iter();
        if worlds.any(|&world| self.episode(world).is_none()) {
            return None;
        }
        let worlds = pending.worlds.iter();
        let worlds = worlds.map(|&world| self.world_info(world)).collect();
        let held = self.leases.robots_held(pending.lease);
        // Renews the lease, so that a burn-in longer than the lease's time to live does not end it.
        self.leases.end_wait(now, pending.lease);
        if !pending.describes_lease {
            return Some(Reply::Reset { worlds });
        }
        let lease = self.leases.renew(now, pending.lease, pending.client);
        Some(match lease {
            Ok(lease) => Reply::Lease(LeaseInfo {
                lease: pending.lease,
                ttl_millis: lease.time_to_live.as_millis() as u64,
                robots: held.iter().map(|&robot| robot as u32).collect(),
                worlds,
            }),
            Err(lost) => refusal(lost),
        })
    }

    pub fn cancel_reply(&mut self, now: Instant, pending: &PendingReply) {
        self.leases.end_wait(now, pending.lease);
    }

    fn try_control(
        &mut self,
        now: Instant,
        client: ClientId,
        request: Request,
        stats: &ServerStats,
    ) -> Result<Outcome, Reply> {
        Ok(match request {
            Request::Hello { .. } => Outcome::Answer(Reply::Hello(Box::new(self.info()))),
            Request::Acquire {
                first_robot,
                n_robots,
                takeover,
                ttl_millis,
            } => {
                let robots = self.robot_range(first_robot, n_robots).map_err(refusal)?;
                self.acquire(now, client, robots, takeover, ttl_millis)?
            }
            Request::Renew { lease } => self.renew(now, client, lease)?,
            Request::Release { lease } => self.release(now, client, lease)?,
            Request::Reset { lease, worlds } => self.reset(now, client, lease, &worlds)?,
            Request::Snapshot {
                first_world,
                n_worlds,
                path,
            } => self.snapshot_job(first_world, n_worlds, path)?,
            Request::Restore {
                lease,
                first_world,
                n_worlds,
                from,
                path,
            } => self.restore_job(now, client, lease, (first_world, n_worlds, from), path)?,
            Request::Fork { lease, from, to } => self.fork(now, client, lease, (from, to))?,
            Request::LeaveBelief(part) => self.leave_belief(now, client, &part)?,
            Request::Belief { robot, offset } => self.belief(robot, offset)?,
            Request::Status {} => Outcome::Answer(Reply::Status(self.status(stats))),
            Request::Shutdown {} => Outcome::Shutdown,
        })
    }

    fn time_to_live(&self, ttl_millis: Option<u64>) -> Duration {
        let millis = ttl_millis.unwrap_or(self.checked.config.lease_millis);
        Duration::from_millis(millis).clamp(SHORTEST_LEASE, LONGEST_LEASE)
    }

    fn acquire(
        &mut self,
        now: Instant,
        client: ClientId,
        robots: Range<usize>,
        takeover: bool,
        ttl_millis: Option<u64>,
    ) -> Result<Outcome, Reply> {
        let claim = Claim {
            client,
            robots,
            takeover,
            time_to_live: self.time_to_live(ttl_millis),
        };
        let token = (self.next_token)();
        self.leases.acquire(now, claim, token).map_err(refusal)?;
        self.settle(now);
        Ok(self.lease_reply(token, client))
    }

    fn renew(&mut self, now: Instant, client: ClientId, lease: u64) -> Result<Outcome, Reply> {
        self.leases.renew(now, lease, client).map_err(refusal)?;
        Ok(self.lease_reply(lease, client))
    }

    fn release(&mut self, now: Instant, client: ClientId, lease: u64) -> Result<Outcome, Reply> {
        self.leases.release(now, lease, client).map_err(refusal)?;
        self.settle(now);
        Ok(Outcome::Answer(Reply::Done))
    }

    /// Makes a request wait until its worlds are ready. The lease does not expire meanwhile.
    fn pending(&mut self, jobs: Vec<ResetJob>, pending: PendingReply) -> Outcome {
        self.leases.begin_wait(pending.lease);
        Outcome::Pending(jobs, pending)
    }

    fn lease_reply(&mut self, lease: u64, client: ClientId) -> Outcome {
        let robots = self.leases.robots_held(lease);
        let mut worlds: Vec<usize> = robots
            .iter()
            .map(|robot| robot / self.spec.rules.n_robots)
            .collect();
        worlds.dedup();
        let pending = PendingReply {
            worlds,
            lease,
            client,
            describes_lease: true,
        };
        self.pending(Vec::new(), pending)
    }

    fn reset(
        &mut self,
        now: Instant,
        client: ClientId,
        lease: u64,
        worlds: &[WorldSeed],
    ) -> Result<Outcome, Reply> {
        if worlds.is_empty() {
            self.leases.renew(now, lease, client).map_err(refusal)?;
        }
        for (index, WorldSeed { world, .. }) in worlds.iter().enumerate() {
            let range = self.range(*world, 1).map_err(refusal)?;
            self.leases
                .use_world(now, lease, client, self.robots_of(range.start))
                .map_err(refusal)?;
            if self.episode(range.start).is_none() {
                return Err(Reply::refusal(Status::Resetting, (*world).into()));
            }
            if worlds[..index]
                .iter()
                .any(|earlier| earlier.world == *world)
            {
                let problem = format!("reset: expected each world once, got world {world} twice");
                return Err(malformed(&problem));
            }
        }
        let jobs = worlds
            .iter()
            .filter_map(|world| self.take_for_reset(now, world))
            .collect();
        let worlds = worlds.iter().map(|world| world.world as usize).collect();
        let pending = PendingReply {
            worlds,
            lease,
            client,
            describes_lease: false,
        };
        Ok(self.pending(jobs, pending))
    }

    fn take_for_reset(&mut self, now: Instant, to: &WorldSeed) -> Option<ResetJob> {
        let world = to.world as usize;
        let before = self.episode(world)?;
        let (last, cells) = (*before.outcome(), cells(before));
        let seed = to.seed.unwrap_or_else(|| next_seed(&last));
        let episode = last.episode.wrapping_add(1);
        let slot = Slot::Resetting {
            last,
            cells,
            seed,
            episode,
        };
        self.refuse_waiting(now, world);
        match std::mem::replace(&mut self.places[world].slot, slot) {
            Slot::Ready(before) => Some(ResetJob {
                world,
                before: Some(before),
                episode,
                seed,
            }),
            Slot::Resetting { .. } => None,
        }
    }

    pub fn info(&self) -> ServerInfo {
        self.checked.info()
    }

    fn status(&self, stats: &ServerStats) -> ServerStatus {
        let holder_pid = |robot| self.leases.holder(robot).map(|lease| lease.client.pid);
        let world_status = |world: usize| WorldStatus {
            info: self.world_info(world),
            holder_pids: self.robots_of(world).map(holder_pid).collect(),
            n_paths: self.places[world].barrier.ready.count_ones(),
            resetting: self.episode(world).is_none(),
        };
        ServerStatus {
            pid: std::process::id(),
            uptime_millis: stats.uptime.as_millis() as u64,
            n_steps: self.n_steps,
            steps_per_second: stats.steps_per_second,
            n_refused: self.n_refused,
            n_clients: stats.n_clients,
            n_observers: stats.n_observers,
            worlds: self.worlds().map(world_status).collect(),
        }
    }
}

impl Checked {
    /// Returns the answer to `hello` of a server with these settings.
    pub fn info(&self) -> ServerInfo {
        let (config, file) = (&self.config, self.model.file());
        let recorded = &self.recorded;
        ServerInfo {
            protocol: VERSION,
            build: env!("CARGO_PKG_VERSION").into(),
            pid: std::process::id(),
            pid_namespace: pid_namespace(),
            height: config.world.height,
            width: config.world.width,
            n_moves: config.world.moves,
            n_worlds: config.worlds,
            n_robots: config.world.robots,
            n_observations: self.model.n_observations(),
            observations: self.model.observation_names(),
            model: (config.reveal_model && recorded.is_none())
                .then(|| toml::to_string(file).expect("invariant: model files serialise")),
            task: self.task.as_ref().map(|task| task.name.clone()),
            worlds_fingerprint: Some(Settings::of(self).worlds_fingerprint()),
            airspace: airspace_info(&self.model),
            recorded_world: recorded.as_ref().map(|states| RecordedWorld {
                description: config.reveal_model.then(|| states.description.clone()),
                n_sequences: states.recorded.n_sequences(),
                n_steps: states.recorded.n_steps(),
            }),
            burn_in: config.world.burn_in,
            max_steps: config.world.max_steps,
            max_clients: MAX_CLIENTS,
            coverage: config.coverage,
            publish_truth: config.publish_truth,
            lease_millis: config.lease_millis,
            deadline_millis: config.deadline_millis,
        }
    }
}

/// Describes no-fly cells and the sensor. Returns `None` if there are no no-fly cells and the sensor sees only the
/// path.
fn airspace_info(model: &Model) -> Option<AirspaceInfo> {
    let info = AirspaceInfo {
        radius: model.radius(),
        no_fly: model.file().no_fly.as_ref().and_then(CellMap::rows),
    };
    (info.radius > 0 || info.no_fly.is_some()).then_some(info)
}

fn read(version: u32, text: &[u8]) -> Result<Request, Reply> {
    if version != VERSION {
        return Err(Reply::version_mismatch(version));
    }
    match parse(text).map_err(|message| Reply::error(Status::Malformed, 0, message))? {
        Request::Hello { protocol, .. } if protocol != VERSION => {
            Err(Reply::version_mismatch(protocol))
        }
        request => Ok(request),
    }
}

/// Returns the seed of the next episode if a reset gives none. The seed is below 2^53, so that every JSON reader
/// represents it exactly.
fn next_seed(last: &WorldOutcome) -> u64 {
    stream(last.seed, Purpose::Episode, last.episode).next_u64() >> 11
}
