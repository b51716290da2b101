//! Control requests about worlds as a whole: snapshot, restore, fork, and beliefs that are left.

use super::control::{Outcome, malformed, refusal};
use super::{ResetOrder, Simulator, Slot};
use crate::beliefs::Part;
use crate::episode::Episode;
use crate::files::{Job, Place};
use crate::lease::ClientId;
use crate::snapshot::{Beginning, RestoredWorld, SnapshotError, WorldToWrite, encode};
use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use protocol::control::{LeftPart, MAX_BELIEF_PART, Reply, WorldInfo};
use protocol::message::{Status, StepResult};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Who waits for a file, and what for.
#[derive(Debug)]
pub enum FileOrder {
    /// Worlds that were written.
    Saved(Vec<WorldInfo>),
    /// Worlds that are to be put in the place of others.
    Restored {
        /// Under this lease.
        lease: u64,
        /// Of this client.
        client: ClientId,
        /// Those others.
        worlds: Range<usize>,
    },
}

impl Simulator {
    /// What worlds of a file must fit.
    pub fn place(&self) -> Place {
        Place {
            settings: self.settings.clone(),
            rules: self.rules.clone(),
        }
    }

    /// Worlds as the bytes of a snapshot file.
    ///
    /// # Errors
    /// [`SnapshotError::TooLarge`].
    pub fn snapshot(&self, worlds: Range<usize>) -> Result<Vec<u8>, SnapshotError> {
        let slots = self.slots[worlds].iter();
        let worlds: Vec<_> = slots
            .map(|slot| match slot {
                Slot::Ready(episode) => WorldToWrite::Ready(episode),
                &Slot::Resetting { seed, episode, .. } => {
                    WorldToWrite::Beginning(Beginning { seed, episode })
                }
            })
            .collect();
        encode(&self.settings, &worlds)
    }

    /// Begins with a world of a file; returns the reset that it still needs.
    pub fn begin_with(&mut self, world: usize, restored: RestoredWorld) -> Option<ResetOrder> {
        match restored {
            RestoredWorld::Ready(episode) => {
                self.put(world, episode);
                None
            }
            RestoredWorld::Beginning(Beginning { seed, episode }) => {
                let order = ResetOrder {
                    world,
                    before: None,
                    episode,
                    seed,
                };
                self.slots[world] = Slot::resetting(&order);
                Some(order)
            }
        }
    }

    /// Puts worlds of a file in the place of those that a client waits for.
    pub fn finish_restore(
        &mut self,
        now: Instant,
        order: &FileOrder,
        restored: Vec<RestoredWorld>,
    ) -> Reply {
        let FileOrder::Restored {
            lease,
            client,
            worlds,
        } = order
        else {
            return malformed("expected worlds to restore".into());
        };
        self.leases.end_wait(now, *lease);
        let may = self.leases.use_lease(now, *lease, *client, worlds);
        if let Err(lost) = may.and_then(|()| self.check_present(worlds)) {
            return refusal(lost);
        }
        let episodes = restored.into_iter().map(|world| match world {
            RestoredWorld::Ready(episode) => Some(episode),
            RestoredWorld::Beginning(_) => None,
        });
        let Some(episodes) = episodes.collect::<Option<Vec<Box<Episode>>>>() else {
            return Reply::Error {
                status: Status::BadFile,
                detail: 0,
                message: "snapshot file: expected worlds at a step, got one in its burn-in".into(),
            };
        };
        for (world, episode) in worlds.clone().zip(episodes) {
            self.put(world, episode);
        }
        self.restored(worlds.clone())
    }

    /// Takes note that a file is not waited for any more, or that nothing came of it.
    pub fn forget_file(&mut self, now: Instant, order: &FileOrder) {
        if let FileOrder::Restored { lease, .. } = order {
            self.leases.end_wait(now, *lease);
        }
    }

    /// The answer to a snapshot that was written. The worlds may have gone on meanwhile; it tells where
    /// they were.
    pub fn saved(&self, order: &FileOrder, path: &Path, n_bytes: usize) -> Reply {
        let FileOrder::Saved(worlds) = order else {
            return malformed("expected worlds that were saved".into());
        };
        Reply::Snapshot {
            path: path.display().to_string(),
            n_bytes: n_bytes as u64,
            worlds: worlds.clone(),
        }
    }

    pub(super) fn order_snapshot(
        &self,
        first: u32,
        n: u32,
        path: String,
    ) -> Result<Outcome, Reply> {
        let worlds = self.range(first, n).map_err(refusal)?;
        let path = absolute(path)?;
        self.check_present(&worlds).map_err(refusal)?;
        let bytes = self.snapshot(worlds.clone());
        let bytes = bytes.map_err(|error| Reply::Error {
            status: Status::BadFile,
            detail: 0,
            message: error.to_string(),
        })?;
        let worlds = worlds.map(|world| self.world_info(world)).collect();
        let order = FileOrder::Saved(worlds);
        Ok(Outcome::File(Job::Save { path, bytes }, order))
    }

    pub(super) fn order_restore(
        &mut self,
        now: Instant,
        client: ClientId,
        lease: u64,
        (first, n, from): (u32, u32, u32),
        path: String,
    ) -> Result<Outcome, Reply> {
        let worlds = self.range(first, n).map_err(refusal)?;
        let path = absolute(path)?;
        self.leases
            .use_lease(now, lease, client, &worlds)
            .map_err(refusal)?;
        self.check_present(&worlds).map_err(refusal)?;
        self.leases.begin_wait(lease);
        let from = from as usize..from as usize + n as usize;
        let order = FileOrder::Restored {
            lease,
            client,
            worlds,
        };
        Ok(Outcome::File(Job::Load { path, worlds: from }, order))
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
        self.leases
            .use_lease(now, lease, client, &target)
            .map_err(refusal)?;
        for worlds in [&source, &target] {
            self.check_present(worlds).map_err(refusal)?;
        }
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
        let worlds = self.range(left.world, 1).map_err(refusal)?;
        self.leases
            .use_lease(now, left.lease, client, &worlds)
            .map_err(refusal)?;
        let at = self.present(worlds.start)?;
        if (left.episode, left.step) != (at.episode, at.step) {
            return Err(wrong(&format!(
                "episode and step: expected {} and {}, where the world stands, got {} and {}",
                at.episode, at.step, left.episode, left.step
            )));
        }
        if left.kind.len() > 256 {
            let got = left.kind.len();
            return Err(wrong(&format!(
                "kind: expected at most 256 bytes, got {got}"
            )));
        }
        let bytes = BASE64.decode(&left.data);
        let bytes = bytes.map_err(|error| wrong(&format!("data: expected base64, got {error}")))?;
        let part = Part {
            kind: &left.kind,
            offset: left.offset,
            length: left.length,
            bytes: &bytes,
        };
        let added = self.beliefs.add(worlds.start, &at, &part);
        added.map_err(|problem| wrong(&problem))?;
        Ok(Outcome::Answer(Reply::Done))
    }

    pub(super) fn belief(&self, world: u32, offset: u64) -> Result<Outcome, Reply> {
        let world = self.range(world, 1).map_err(refusal)?.start;
        let at = self.present(world)?;
        let Some((info, bytes)) = self.beliefs.of(world, &at) else {
            return Err(Reply::Error {
                status: Status::NotKept,
                detail: at.step,
                message: format!("no belief was left about world {world} at step {}", at.step),
            });
        };
        let start = usize::try_from(offset).map_or(bytes.len(), |offset| offset.min(bytes.len()));
        let end = bytes.len().min(start + MAX_BELIEF_PART);
        Ok(Outcome::Answer(Reply::Belief {
            info: info.clone(),
            offset: start as u64,
            data: BASE64.encode(&bytes[start..end]),
        }))
    }

    pub(super) fn put(&mut self, world: usize, episode: Box<Episode>) {
        self.slots[world] = Slot::Ready(episode);
        self.beliefs.forget(world);
    }

    fn present(&self, world: usize) -> Result<StepResult, Reply> {
        let episode = self.episode(world);
        let result = episode.map(|episode| *episode.result());
        result.ok_or_else(|| Reply::refusal(Status::Resetting, world as u64))
    }

    fn restored(&self, worlds: Range<usize>) -> Reply {
        Reply::Restored {
            worlds: worlds.map(|world| self.world_info(world)).collect(),
        }
    }
}

fn absolute(path: String) -> Result<PathBuf, Reply> {
    if path.starts_with('/') && !path.contains('\0') {
        return Ok(path.into());
    }
    Err(wrong(&format!(
        "path: expected an absolute one, got {path:?}"
    )))
}

fn wrong(problem: &str) -> Reply {
    malformed(format!("{}: {problem}", Status::Malformed.explain(0)))
}
