//! Control requests about whole worlds (snapshot, restore, fork), and about stored beliefs.

use super::beliefs::BeliefPart;
use super::lease::{ClientId, Refusal};
use super::outcome::{Outcome, PendingFile, malformed, refusal};
use super::state::{ResetJob, Simulator, Slot};
use crate::snapshot::{Done, FileError, Job, NewEpisode, SnapshotError, SnapshotWorld, encode};
use crate::world::{Episode, WorldOutcome};
use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use emberwatch_messages::control::{LeftPart, MAX_BELIEF_PART, Reply};
use emberwatch_messages::message::Status;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::Instant;

impl Simulator {
    pub fn snapshot(&self, worlds: Range<usize>) -> Result<Vec<u8>, SnapshotError> {
        let places = self.places[worlds].iter();
        let worlds: Vec<_> = places
            .map(|place| match &place.slot {
                Slot::Ready(episode) => SnapshotWorld::Ready(&**episode),
                &Slot::Resetting { seed, episode, .. } => {
                    SnapshotWorld::New(NewEpisode { seed, episode })
                }
            })
            .collect();
        encode(&self.spec.settings, &worlds)
    }

    /// Starts a world with the state from a snapshot. Returns the reset job if the saved world was still in its
    /// burn-in.
    pub fn start_with(
        &mut self,
        world: usize,
        restored: SnapshotWorld<Box<Episode>>,
    ) -> Option<ResetJob> {
        match restored {
            SnapshotWorld::Ready(episode) => {
                self.put(world, episode);
                None
            }
            SnapshotWorld::New(NewEpisode { seed, episode }) => {
                let job = ResetJob {
                    world,
                    before: None,
                    episode,
                    seed,
                };
                let n_robots = self.spec.rules.n_robots;
                self.places[world].slot = Slot::resetting(&job, n_robots);
                Some(job)
            }
        }
    }

    pub fn file_reply(
        &mut self,
        now: Instant,
        pending: &PendingFile,
        outcome: Result<Done, FileError>,
    ) -> Reply {
        match outcome {
            Ok(Done::Loaded(episodes)) => self.finish_restore(now, pending, episodes),
            Ok(Done::Saved { path, n_bytes }) => saved(pending, &path, n_bytes),
            Err(error) => {
                self.cancel_file(now, pending);
                Reply::error(Status::BadFile, 0, error.to_string())
            }
        }
    }

    fn finish_restore(
        &mut self,
        now: Instant,
        pending: &PendingFile,
        restored: Vec<SnapshotWorld<Box<Episode>>>,
    ) -> Reply {
        let PendingFile::Restored {
            lease,
            client,
            worlds,
        } = pending
        else {
            return malformed("expected a pending restore, got a pending snapshot");
        };
        self.leases.end_wait(now, *lease);
        let may = self.check_replaceable(now, *lease, *client, worlds);
        if let Err(lost) = may {
            return refusal(lost);
        }
        let episodes = restored.into_iter().map(|world| match world {
            SnapshotWorld::Ready(episode) => Some(episode),
            SnapshotWorld::New(_) => None,
        });
        let Some(episodes) = episodes.collect::<Option<Vec<Box<Episode>>>>() else {
            let message = "snapshot file: expected worlds after their burn-in, got one during it";
            return Reply::error(Status::BadFile, 0, message.into());
        };
        for (world, episode) in worlds.clone().zip(episodes) {
            self.refuse_waiting(now, world);
            self.put(world, episode);
        }
        self.restored(worlds.clone())
    }

    /// Ends the wait of a request for a file, when the file job failed or the client has stopped waiting.
    pub fn cancel_file(&mut self, now: Instant, pending: &PendingFile) {
        if let PendingFile::Restored { lease, .. } = pending {
            self.leases.end_wait(now, *lease);
        }
    }

    pub(super) fn snapshot_job(&self, first: u32, n: u32, path: String) -> Result<Outcome, Reply> {
        let worlds = self.range(first, n).map_err(refusal)?;
        let path = absolute(path)?;
        self.check_present(&worlds).map_err(refusal)?;
        let bytes = self
            .snapshot(worlds.clone())
            .map_err(|error| Reply::error(Status::BadFile, 0, error.to_string()))?;
        let worlds = worlds.map(|world| self.world_info(world)).collect();
        let pending = PendingFile::Saved(worlds);
        Ok(Outcome::File(Job::Save { path, bytes }, pending))
    }

    pub(super) fn restore_job(
        &mut self,
        now: Instant,
        client: ClientId,
        lease: u64,
        (first, n, from): (u32, u32, u32),
        path: String,
    ) -> Result<Outcome, Reply> {
        let worlds = self.range(first, n).map_err(refusal)?;
        let path = absolute(path)?;
        self.check_replaceable(now, lease, client, &worlds)
            .map_err(refusal)?;
        self.leases.begin_wait(lease);
        let from = from as usize..from as usize + n as usize;
        let pending = PendingFile::Restored {
            lease,
            client,
            worlds,
        };
        Ok(Outcome::File(Job::Load { path, worlds: from }, pending))
    }

    pub(super) fn fork(
        &mut self,
        now: Instant,
        client: ClientId,
        lease: u64,
        (from, to): (u32, u32),
    ) -> Result<Outcome, Reply> {
        let source = self.range(from, 1).map_err(refusal)?;
        let target = self.range(to, 1).map_err(refusal)?;
        self.check_replaceable(now, lease, client, &target)
            .map_err(refusal)?;
        self.check_present(&source).map_err(refusal)?;
        self.refuse_waiting(now, target.start);
        if let Some(episode) = self.episode(source.start).cloned() {
            self.put(target.start, Box::new(episode));
        }
        let reply = self.restored(target.clone());
        Ok(Outcome::Changed(target, reply))
    }

    pub(super) fn leave_belief(
        &mut self,
        now: Instant,
        client: ClientId,
        left: &LeftPart,
    ) -> Result<Outcome, Reply> {
        let robots = self.robot_range(left.robot, 1).map_err(refusal)?;
        self.leases
            .use_lease(now, left.lease, client, &robots)
            .map_err(refusal)?;
        let at = self.present(&robots)?;
        if (left.episode, left.step) != (at.episode, at.step) {
            return Err(malformed(&format!(
                "episode and step: expected {} and {}, as in the world, got {} and {}",
                at.episode, at.step, left.episode, left.step
            )));
        }
        if left.kind.len() > 256 {
            let got = left.kind.len();
            return Err(malformed(&format!(
                "kind: expected at most 256 bytes, got {got}"
            )));
        }
        let bytes = BASE64.decode(&left.data);
        let bytes =
            bytes.map_err(|error| malformed(&format!("data: expected base64, got {error}")))?;
        let part = BeliefPart {
            kind: &left.kind,
            offset: left.offset,
            length: left.length,
            bytes: &bytes,
        };
        let added = self.beliefs.add(robots.start, &at, &part);
        added.map_err(|problem| malformed(&problem))?;
        Ok(Outcome::Answer(Reply::Done))
    }

    pub(super) fn belief(&self, robot: u32, offset: u64) -> Result<Outcome, Reply> {
        let robots = self.robot_range(robot, 1).map_err(refusal)?;
        let at = self.present(&robots)?;
        let Some((info, bytes)) = self.beliefs.of(robots.start, &at) else {
            let message = format!("no belief is stored for robot {robot} at step {}", at.step);
            return Err(Reply::error(Status::NotKept, at.step, message));
        };
        let start = usize::try_from(offset).map_or(bytes.len(), |offset| offset.min(bytes.len()));
        let end = bytes.len().min(start + MAX_BELIEF_PART);
        Ok(Outcome::Answer(Reply::Belief {
            info: info.clone(),
            offset: start as u64,
            data: BASE64.encode(&bytes[start..end]),
        }))
    }

    fn check_replaceable(
        &mut self,
        now: Instant,
        lease: u64,
        client: ClientId,
        worlds: &Range<usize>,
    ) -> Result<(), Refusal> {
        for world in worlds.clone() {
            let robots = self.robots_of(world);
            self.leases.use_world(now, lease, client, robots)?;
        }
        self.check_present(worlds)
    }

    fn present(&self, robots: &Range<usize>) -> Result<WorldOutcome, Reply> {
        let world = self.worlds_of(robots).start;
        let episode = self.episode(world);
        let result = episode.map(|episode| *episode.outcome());
        result.ok_or_else(|| Reply::refusal(Status::Resetting, world as u64))
    }

    fn restored(&self, worlds: Range<usize>) -> Reply {
        Reply::Restored {
            worlds: worlds.map(|world| self.world_info(world)).collect(),
        }
    }
}

fn absolute(path: String) -> Result<PathBuf, Reply> {
    if Path::new(&path).is_absolute() && !path.contains('\0') {
        return Ok(path.into());
    }
    Err(malformed(&format!(
        "path: expected an absolute path, got {path:?}"
    )))
}

/// Returns the answer to a snapshot request. It describes the worlds as they are in the file.
fn saved(pending: &PendingFile, path: &Path, n_bytes: usize) -> Reply {
    let PendingFile::Saved(worlds) = pending else {
        return malformed("expected a pending snapshot, got a pending restore");
    };
    Reply::Snapshot {
        path: path.display().to_string(),
        n_bytes: n_bytes as u64,
        worlds: worlds.clone(),
    }
}
