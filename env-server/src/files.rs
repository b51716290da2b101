//! Snapshot files are written and read here, on a thread of its own, so that no disk delays a step.

use crate::episode::Rules;
use crate::snapshot::folder::{FileError, Folder, Outlives, read, refused, write};
use crate::snapshot::{RestoredWorld, Settings, SnapshotError};
use rustix::event::{EventfdFlags, eventfd};
use rustix::io::Errno;
use std::ops::Range;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

/// Most jobs at a time.
const MAX_JOBS: u64 = 16;

/// What to do with a file.
#[derive(Debug)]
pub enum Job {
    /// Write a snapshot.
    Save {
        /// Where.
        path: PathBuf,
        /// What.
        bytes: Vec<u8>,
    },
    /// Write the next of the server's own snapshots.
    Autosave {
        /// Where.
        folder: Folder,
        /// What it must outlive.
        outlives: Outlives,
        /// How many to keep.
        keep: usize,
        /// Another one to keep.
        spared: Option<PathBuf>,
        /// What.
        bytes: Vec<u8>,
    },
    /// Read worlds of a snapshot.
    Load {
        /// Where.
        path: PathBuf,
        /// Which of its worlds.
        worlds: Range<usize>,
    },
}

/// What came of a job.
pub enum Done {
    /// A file was written.
    Saved {
        /// Where.
        path: PathBuf,
        /// Its length.
        n_bytes: usize,
    },
    /// Worlds were read.
    Loaded(Vec<RestoredWorld>),
}

/// A job's number, and what came of it.
pub type Outcome = (u64, Result<Done, FileError>);

/// What worlds must fit.
#[derive(Debug, Clone)]
pub struct Place {
    /// The server's settings.
    pub settings: Settings,
    /// Its rules.
    pub rules: Rules,
}

/// The thread that works on files.
pub struct Files {
    jobs: Option<Sender<(u64, Job)>>,
    n_jobs: u64,
    n_done: u64,
    done: Receiver<Outcome>,
    /// Readable while `done` may hold something.
    signal: Arc<OwnedFd>,
}

impl Files {
    /// Starts the thread.
    ///
    /// # Errors
    /// The system's, when it gives no event descriptor or thread.
    pub fn start(place: Place) -> std::io::Result<Self> {
        let flags = EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK;
        let signal = Arc::new(eventfd(0, flags).map_err(|errno: Errno| errno)?);
        let (jobs, orders) = channel::<(u64, Job)>();
        let (sender, done) = channel();
        let bell = signal.clone();
        let work = move || {
            for (number, job) in orders {
                // Errors mean that the server is gone, and with it whoever would read.
                let _ = sender.send((number, job.carry_out(&place)));
                let _ = rustix::io::write(&*bell, &1u64.to_ne_bytes());
            }
        };
        std::thread::Builder::new()
            .name("files".into())
            .spawn(work)?;
        Ok(Self {
            jobs: Some(jobs),
            n_jobs: 0,
            n_done: 0,
            done,
            signal,
        })
    }

    /// Orders a job; returns its number.
    pub fn order(&mut self, job: Job) -> u64 {
        self.n_jobs += 1;
        if let Some(jobs) = &self.jobs {
            let _ = jobs.send((self.n_jobs, job));
        }
        self.n_jobs
    }

    /// Whether there is room for another job: clients that give up leave theirs behind.
    pub fn has_room(&self) -> bool {
        self.n_jobs - self.n_done < MAX_JOBS
    }

    /// The jobs that are done since the last call.
    pub fn finished(&mut self) -> Vec<Outcome> {
        let _ = rustix::io::read(&*self.signal, &mut [0u8; 8]);
        let finished: Vec<Outcome> = self.done.try_iter().collect();
        self.n_done += finished.len() as u64;
        finished
    }

    /// Ends the thread once it has done its jobs, and waits for that, but no longer than a while; returns
    /// what came of them.
    ///
    /// # Errors
    /// What it had done by then.
    pub fn finish(mut self, limit: Duration) -> Result<Vec<Outcome>, Vec<Outcome>> {
        self.jobs = None;
        let deadline = Instant::now() + limit;
        let mut finished = Vec::new();
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            match self.done.recv_timeout(left) {
                Ok(outcome) => finished.push(outcome),
                Err(RecvTimeoutError::Disconnected) => return Ok(finished),
                Err(RecvTimeoutError::Timeout) => return Err(finished),
            }
        }
    }

    /// Readable while a job is done.
    pub fn descriptor(&self) -> BorrowedFd<'_> {
        self.signal.as_fd()
    }
}

impl Job {
    fn carry_out(self, place: &Place) -> Result<Done, FileError> {
        match self {
            Self::Save { path, bytes } => {
                write(&path, &bytes, Outlives::PowerLoss)?;
                let n_bytes = bytes.len();
                Ok(Done::Saved { path, n_bytes })
            }
            Self::Autosave {
                folder,
                outlives,
                keep,
                spared,
                bytes,
            } => {
                let path = folder.save(&bytes, outlives, keep, spared.as_deref())?;
                let n_bytes = bytes.len();
                Ok(Done::Saved { path, n_bytes })
            }
            Self::Load { path, worlds } => Ok(Done::Loaded(place.load(&path, Some(worlds))?)),
        }
    }
}

impl Place {
    /// Worlds of a file; `None`: all.
    ///
    /// # Errors
    /// [`FileError`].
    pub fn load(
        &self,
        path: &Path,
        worlds: Option<Range<usize>>,
    ) -> Result<Vec<RestoredWorld>, FileError> {
        let mut snapshot = read(path)?;
        if let Some(worlds) = worlds {
            let got = snapshot.worlds.len();
            if worlds.end > got {
                let expected = format!("at least {}", worlds.end);
                return Err(refused(path, SnapshotError::Worlds { expected, got }));
            }
            snapshot.worlds = snapshot.worlds.drain(worlds).collect();
        }
        let restored = snapshot.restore(&self.settings, &self.rules);
        restored.map_err(|error| refused(path, error))
    }
}
