//! The automatic snapshots of a server, and the snapshot that it starts with.
//!
//! All automatic snapshots survive the death of any process. Some also survive a loss of power: the first snapshot,
//! each snapshot at least five seconds after the previous one of this kind, and the server's last snapshot. The newest
//! snapshot of this kind is kept in addition to the last few snapshots.

use super::files::Files;
use emberwatch_protocol::throttle::Throttle;
use emberwatch_sim::config::Checked;
use emberwatch_sim::snapshot::{
    Done, Durability, FileError, Folder, Job, SnapshotError, SnapshotWorld, WorldSpec, load,
    refused,
};
use emberwatch_sim::world::Episode;
use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Minimum time between two snapshots that survive a loss of power. They are rare, because waiting for the disk delays
/// steps.
const SYNC_INTERVAL: Duration = Duration::from_secs(5);

pub struct Autosave {
    folder: Folder,
    keep: usize,
    every: u64,
    /// Total number of world steps at which the next snapshot is due.
    due: u64,
    writing: Option<(u64, Durability)>,
    /// The latest snapshot that survives a loss of power, and when it was written.
    safe: Option<(Instant, PathBuf)>,
    failures: Throttle,
}

impl Autosave {
    pub fn new(checked: &Checked) -> Result<Option<Self>, FileError> {
        let config = &checked.config;
        if config.snapshot_every == 0 {
            return Ok(None);
        }
        let folder = Folder::new(Path::new(&config.snapshot_dir), &checked.instance);
        folder.prepare()?;
        let n_files = folder.files()?.len();
        if n_files > 0 && config.restore.is_empty() {
            return Err(folder.not_empty(n_files));
        }
        let every = config.snapshot_every.saturating_mul(config.worlds.into());
        Ok(Some(Self {
            folder,
            keep: config.snapshot_keep as usize,
            every,
            due: every,
            writing: None,
            safe: None,
            failures: Throttle::default(),
        }))
    }

    /// Returns whether a snapshot is due after `n_steps` world steps. The next snapshot is due only after the previous
    /// one was written, so a slow disk makes snapshots rarer.
    pub fn is_due(&self, n_steps: u64) -> bool {
        n_steps >= self.due && self.writing.is_none()
    }

    pub fn skip(&mut self, n_steps: u64) {
        self.due = n_steps.saturating_add(self.every);
    }

    /// Starts to write a snapshot. The last one of a run always survives a loss of power.
    pub fn start(&mut self, n_steps: u64, bytes: Vec<u8>, is_last: bool, files: &mut Files) {
        self.skip(n_steps);
        let safe = self.safe.as_ref();
        let durability = durability(safe.map(|(at, _)| at.elapsed()), is_last);
        let job = files.add(Job::Autosave {
            folder: self.folder.clone(),
            durability,
            keep: self.keep,
            also_keep: safe.map(|(_, path)| path.clone()),
            bytes,
        });
        self.writing = Some((job, durability));
    }

    pub fn finish(&mut self, job: u64, outcome: &Result<Done, FileError>) -> bool {
        let Some((_, durability)) = self.writing.take_if(|(own, _)| *own == job) else {
            return false;
        };
        match outcome {
            Ok(Done::Saved { path, .. }) if durability == Durability::PowerLoss => {
                self.safe = Some((Instant::now(), path.clone()));
            }
            Ok(_) => {}
            Err(error) => self.warn(error),
        }
        true
    }

    pub fn warn(&mut self, error: &dyn Display) {
        if let Some(n_unsaid) = self.failures.pass(Instant::now()) {
            tracing::warn!(n_unsaid, "no snapshot was written: {error}");
        }
    }
}

/// Returns which failures the next snapshot must survive. `age` is the time since the latest snapshot that survives a
/// loss of power.
fn durability(age: Option<Duration>, is_last: bool) -> Durability {
    match age {
        Some(age) if age < SYNC_INTERVAL && !is_last => Durability::Kill,
        _ => Durability::PowerLoss,
    }
}

pub struct FirstWorlds {
    pub path: PathBuf,
    pub worlds: Vec<SnapshotWorld<Box<Episode>>>,
}

/// Loads the worlds that a server starts with. Skips damaged files in a folder. Returns `None` if the server should
/// create new worlds.
pub fn first_worlds(checked: &Checked, spec: &WorldSpec) -> Result<Option<FirstWorlds>, FileError> {
    if checked.config.restore.is_empty() {
        return Ok(None);
    }
    let path = Path::new(&checked.config.restore);
    let is_folder = path.is_dir();
    let files = if is_folder {
        let folder = Folder::new(path, &checked.instance);
        let files = folder.files()?;
        if files.is_empty() {
            log_why_none(&folder, path);
        }
        files.into_iter().rev().map(|(_, path)| path).collect()
    } else {
        vec![path.to_owned()]
    };
    let mut damaged = None;
    for path in files {
        match load(spec, &path, None) {
            Ok(worlds) if worlds.len() == checked.config.worlds as usize => {
                return Ok(Some(FirstWorlds { path, worlds }));
            }
            Ok(worlds) => {
                let error = SnapshotError::n_worlds(checked.config.worlds, worlds.len());
                return Err(refused(&path, error));
            }
            Err(error) if error.is_damaged => {
                if is_folder {
                    tracing::warn!("{error}");
                }
                damaged.get_or_insert(error);
            }
            Err(error) => return Err(error),
        }
    }
    damaged.map_or(Ok(None), Err)
}

/// Logs why no snapshot is restored from a folder. An empty folder is normal at the first start. If the folder contains
/// only snapshots of other instances, logs a warning, because the user may have meant one of these.
fn log_why_none(folder: &Folder, path: &Path) {
    let (path, expected) = (path.display(), folder.pattern());
    match &folder.snapshots()[..] {
        [] => tracing::info!(folder = %path, "nothing to restore: new worlds start"),
        [first, ..] => tracing::warn!(
            "--restore {path}: expected snapshots of this instance, {expected}, got others, such as {first}: \
             new worlds start; to restore one of these, name its file, or its instance with --instance"
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn first_last_and_five_second_snapshots_survive_power_loss() {
        let (soon, late) = (SYNC_INTERVAL / 2, SYNC_INTERVAL);
        assert_eq!(durability(None, false), Durability::PowerLoss);
        assert_eq!(durability(Some(soon), false), Durability::Kill);
        assert_eq!(durability(Some(late), false), Durability::PowerLoss);
        assert_eq!(durability(Some(soon), true), Durability::PowerLoss);
    }
}
