//! Snapshots that a server writes of its own accord, and begins with.

use crate::config::Checked;
use crate::files::{Done, Files, Job, Place};
use crate::snapshot::folder::{FileError, Folder, Outlives, refused};
use crate::snapshot::{RestoredWorld, SnapshotError};
use crate::throttle::Throttle;
use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Least time between two snapshots that outlive a loss of power: to wait for the disk each time would slow the steps
/// down.
const SYNC_INTERVAL: Duration = Duration::from_secs(5);

/// When to write the next one, and where.
pub struct Autosave {
    folder: Folder,
    keep: usize,
    /// World steps between two.
    every: u64,
    /// World steps at which the next is due.
    due: u64,
    /// The job that writes one, and what that outlives.
    writing: Option<(u64, Outlives)>,
    /// The last that outlives a loss of power, and when it was written.
    safe: Option<(Instant, PathBuf)>,
    failures: Throttle,
}

impl Autosave {
    /// As the settings say; `None` if they want none.
    ///
    /// # Errors
    /// [`FileError`] if the folder cannot be written to.
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

    /// Whether one is to be written after so many world steps. Never two at once: a disk that is too
    /// slow gets fewer.
    pub fn is_due(&self, n_steps: u64) -> bool {
        n_steps >= self.due && self.writing.is_none()
    }

    /// Lets one go.
    pub fn skip(&mut self, n_steps: u64) {
        self.due = n_steps.saturating_add(self.every);
    }

    /// Orders one; the last of a run outlives a loss of power in any case.
    pub fn order(&mut self, n_steps: u64, bytes: Vec<u8>, is_last: bool, files: &mut Files) {
        self.skip(n_steps);
        let safe = self.safe.as_ref();
        let outlives = outlives(safe.map(|(at, _)| at.elapsed()), is_last);
        let job = files.order(Job::Autosave {
            folder: self.folder.clone(),
            outlives,
            keep: self.keep,
            spared: safe.map(|(_, path)| path.clone()),
            bytes,
        });
        self.writing = Some((job, outlives));
    }

    /// Takes note of what came of a job; returns whether it was one of these.
    pub fn is_done(&mut self, job: u64, outcome: &Result<Done, FileError>) -> bool {
        let Some((_, outlives)) = self.writing.take_if(|(own, _)| *own == job) else {
            return false;
        };
        match outcome {
            Ok(Done::Saved { path, .. }) if outlives == Outlives::PowerLoss => {
                self.safe = Some((Instant::now(), path.clone()));
            }
            Ok(_) => {}
            Err(error) => self.warn(error),
        }
        true
    }

    /// Says, now and then, that one was not written.
    pub fn warn(&mut self, error: &dyn Display) {
        if let Some(unsaid) = self.failures.pass(Instant::now()) {
            tracing::warn!(unsaid, "not saved: {error}");
        }
    }
}

/// What the next snapshot must outlive; `age`: time since the last that outlives a loss of power, if there is one.
fn outlives(age: Option<Duration>, is_last: bool) -> Outlives {
    match age {
        Some(age) if age < SYNC_INTERVAL && !is_last => Outlives::Kills,
        _ => Outlives::PowerLoss,
    }
}

/// Worlds that a server begins with.
pub struct FirstWorlds {
    /// Their file.
    pub path: PathBuf,
    /// All of them.
    pub worlds: Vec<RestoredWorld>,
}

/// The worlds that the settings want a server to begin with; `None`: new ones.
///
/// # Errors
/// [`FileError`]; in a folder, damaged files are passed over as long as there is one that is whole.
pub fn first_worlds(checked: &Checked, place: &Place) -> Result<Option<FirstWorlds>, FileError> {
    if checked.config.restore.is_empty() {
        return Ok(None);
    }
    let path = Path::new(&checked.config.restore);
    let files = if path.is_dir() {
        let folder = Folder::new(path, &checked.instance);
        let files = folder.files()?;
        if files.is_empty() {
            say_what_is_there(&folder, path);
        }
        files.into_iter().rev().map(|(_, path)| path).collect()
    } else {
        vec![path.to_owned()]
    };
    let mut damaged = None;
    for path in files {
        match place.load(&path, None) {
            Ok(worlds) if worlds.len() == checked.config.worlds as usize => {
                return Ok(Some(FirstWorlds { path, worlds }));
            }
            Ok(worlds) => {
                let (expected, got) = (checked.config.worlds.to_string(), worlds.len());
                return Err(refused(&path, SnapshotError::Worlds { expected, got }));
            }
            Err(error) if error.is_damaged => {
                tracing::warn!("{error}");
                damaged.get_or_insert(error);
            }
            Err(error) => return Err(error),
        }
    }
    damaged.map_or(Ok(None), Err)
}

/// Says why nothing of a folder is restored. An empty one is that of a first start, and so may be one with other
/// instances' files; but these may also be those that were meant.
fn say_what_is_there(folder: &Folder, path: &Path) {
    let (path, expected) = (path.display(), folder.pattern());
    match &folder.snapshots()[..] {
        [] => tracing::info!(folder = %path, "nothing to restore: the worlds begin anew"),
        [first, ..] => tracing::warn!(
            "--restore {path}: expected snapshots of this instance, {expected}, got others, such as {first}: the \
             worlds begin anew; to restore one of these, name its file, or its instance with --instance"
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_the_last_and_one_in_a_while_outlive_a_loss_of_power() {
        let (soon, late) = (SYNC_INTERVAL / 2, SYNC_INTERVAL);
        assert_eq!(outlives(None, false), Outlives::PowerLoss);
        assert_eq!(outlives(Some(soon), false), Outlives::Kills);
        assert_eq!(outlives(Some(late), false), Outlives::PowerLoss);
        assert_eq!(outlives(Some(soon), true), Outlives::PowerLoss);
    }
}
