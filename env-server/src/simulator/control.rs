//! Control requests: parse, check, answer now or when worlds are ready.

use super::{FileOrder, ResetOrder, Simulator, Slot};
use crate::files::Job;
use crate::lease::{Claim, ClientId, Refusal};
use protocol::channels::MAX_CLIENTS;
use protocol::control::{
    LeaseInfo, Reply, Request, ServerInfo, ServerStatus, WorldInfo, WorldSeed, WorldStatus, parse,
};
use protocol::message::{Status, StepResult, VERSION};
use protocol::randomness::{Purpose, stream};
use rand_chacha::rand_core::Rng;
use std::ops::Range;
use std::time::{Duration, Instant};

/// Longest lease a client may ask for: a day.
const LONGEST_LEASE: Duration = Duration::from_secs(86_400);

/// Shortest lease a client may ask for.
const SHORTEST_LEASE: Duration = Duration::from_millis(100);

/// What a control request leads to.
pub enum Outcome {
    /// An answer now.
    Answer(Reply),
    /// Resets to carry out, and an answer when the worlds it names are ready.
    Later(Vec<ResetOrder>, Awaited),
    /// Worlds to publish, and an answer now.
    Changed(Range<usize>, Reply),
    /// Work on a file, and an answer when it is done.
    File(Job, FileOrder),
    /// An answer now, then the end of the server.
    Shutdown,
}

/// An answer that waits until worlds have been reset.
pub struct Awaited {
    worlds: Vec<usize>,
    lease: u64,
    client: ClientId,
    /// Whether to tell of the lease, or of the worlds alone.
    tells_lease: bool,
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

impl Simulator {
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
        // Waiting is use: a burn-in longer than the lease must not end it.
        self.leases.end_wait(now, awaited.lease);
        if !awaited.tells_lease {
            return Some(Reply::Reset { worlds });
        }
        Some(
            match self.leases.renew(now, awaited.lease, awaited.client) {
                Ok(lease) => Reply::Lease(LeaseInfo {
                    lease: awaited.lease,
                    ttl_millis: lease.time_to_live.as_millis() as u64,
                    worlds,
                }),
                Err(lost) => refusal(lost),
            },
        )
    }

    /// Takes note that nobody waits for an answer any more.
    pub fn forget_awaited(&mut self, now: Instant, awaited: &Awaited) {
        self.leases.end_wait(now, awaited.lease);
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
            return Err(mismatch(version));
        }
        Ok(match parse(text).map_err(malformed)? {
            Request::Hello { protocol, .. } if protocol != VERSION => {
                return Err(mismatch(protocol));
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
                self.leases.renew(now, lease, client).map_err(refusal)?;
                self.tell_lease(lease, client)
            }
            Request::Release { lease } => {
                self.leases.release(now, lease, client).map_err(refusal)?;
                Outcome::Answer(Reply::Done)
            }
            Request::Reset { lease, worlds } => self.order_resets(now, client, lease, &worlds)?,
            Request::Snapshot {
                first_world,
                n_worlds,
                path,
            } => self.order_snapshot(first_world, n_worlds, path)?,
            Request::Restore {
                lease,
                first_world,
                n_worlds,
                from,
                path,
            } => self.order_restore(now, client, lease, (first_world, n_worlds, from), path)?,
            Request::Fork { lease, from, to } => self.fork(now, client, lease, (from, to))?,
            Request::LeaveBelief(part) => self.leave_belief(now, client, &part)?,
            Request::Belief { world, offset } => self.belief(world, offset)?,
            Request::Status {} => Outcome::Answer(Reply::Status(self.status(surroundings))),
            Request::Shutdown {} => Outcome::Shutdown,
        })
    }

    fn time_to_live(&self, ttl_millis: Option<u64>) -> Duration {
        let millis = ttl_millis.unwrap_or(self.checked.config.lease_millis);
        Duration::from_millis(millis).clamp(SHORTEST_LEASE, LONGEST_LEASE)
    }

    fn acquire(&mut self, now: Instant, claim: Claim) -> Result<Outcome, Reply> {
        let (token, client) = ((self.next_token)(), claim.client);
        self.leases.acquire(now, claim, token).map_err(refusal)?;
        Ok(self.tell_lease(token, client))
    }

    /// An answer when its worlds are ready; the lease lives until then.
    fn later(&mut self, orders: Vec<ResetOrder>, awaited: Awaited) -> Outcome {
        self.leases.begin_wait(awaited.lease);
        Outcome::Later(orders, awaited)
    }

    /// The worlds of a lease, once they are ready.
    fn tell_lease(&mut self, lease: u64, client: ClientId) -> Outcome {
        let awaited = Awaited {
            worlds: self.leases.worlds_held(lease),
            lease,
            client,
            tells_lease: true,
        };
        self.later(Vec::new(), awaited)
    }

    fn order_resets(
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
                    "{}: reset: expected each world once, got world {world} twice",
                    Status::Malformed.explain(0)
                )));
            }
        }
        let orders = worlds
            .iter()
            .filter_map(|order| self.take_for_reset(order))
            .collect();
        let worlds = worlds.iter().map(|order| order.world as usize).collect();
        let awaited = Awaited {
            worlds,
            lease,
            client,
            tells_lease: false,
        };
        Ok(self.later(orders, awaited))
    }

    fn take_for_reset(&mut self, order: &WorldSeed) -> Option<ResetOrder> {
        let world = order.world as usize;
        let last = *self.episode(world)?.result();
        let seed = order.seed.unwrap_or_else(|| next_seed(&last));
        let episode = last.episode.wrapping_add(1);
        let slot = Slot::Resetting {
            last,
            seed,
            episode,
        };
        match std::mem::replace(&mut self.slots[world], slot) {
            Slot::Ready(before) => Some(ResetOrder {
                world,
                before: Some(before),
                episode,
                seed,
            }),
            Slot::Resetting { .. } => None,
        }
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

/// The refusal of a client that speaks another version.
fn mismatch(client: u32) -> Reply {
    let (status, detail) = (Status::VersionMismatch, u64::from(VERSION));
    let message = Status::version_mismatch(client, detail);
    Reply::Error {
        status,
        detail,
        message,
    }
}

pub(super) fn malformed(message: String) -> Reply {
    Reply::Error {
        status: Status::Malformed,
        detail: 0,
        message,
    }
}

pub(super) fn refusal(refusal: Refusal) -> Reply {
    Reply::refusal(refusal.status, refusal.detail)
}

/// The seed after an episode whose reset names none; below 2^53, which every JSON reader holds.
fn next_seed(last: &StepResult) -> u64 {
    stream(last.seed, Purpose::Episode, last.episode).next_u64() >> 11
}
