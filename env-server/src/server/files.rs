//! Snapshot files are written and read on a thread of its own, so that no disk delays a step.

use super::completions::{Completions, completions};
use emberwatch_protocol::limits::threads::spawn;
use emberwatch_sim::snapshot::{Done, FileError, Job, WorldSpec};
use std::os::fd::BorrowedFd;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

/// Most jobs at a time.
const MAX_JOBS: u64 = 16;

/// A job's number and result.
pub type FileResult = (u64, Result<Done, FileError>);

/// The thread that works on files.
pub struct Files {
    jobs: Option<Sender<(u64, Job)>>,
    n_jobs: u64,
    n_done: u64,
    finished: Completions<FileResult>,
}

impl Files {
    /// Starts the thread.
    ///
    /// # Errors
    /// If the system gives no descriptor, or starts no thread.
    pub fn start(spec: WorldSpec) -> anyhow::Result<Self> {
        let (sender, finished) = completions()?;
        let (jobs, queue) = channel::<(u64, Job)>();
        let work = move || {
            for (number, job) in queue {
                sender.send((number, job.run(&spec)));
            }
        };
        spawn("files", work)?;
        Ok(Self {
            jobs: Some(jobs),
            n_jobs: 0,
            n_done: 0,
            finished,
        })
    }

    /// Queues a job; returns its number.
    pub fn add(&mut self, job: Job) -> u64 {
        self.n_jobs += 1;
        if let Some(jobs) = &self.jobs {
            let _ = jobs.send((self.n_jobs, job));
        }
        self.n_jobs
    }

    /// Whether there is room for another job: those of clients that gave up are still done.
    pub fn has_room(&self) -> bool {
        self.n_jobs - self.n_done < MAX_JOBS
    }

    /// The jobs that are done since the last call.
    pub fn finished(&mut self) -> Vec<FileResult> {
        let finished = self.finished.take();
        self.n_done += finished.len() as u64;
        finished
    }

    /// Waits until all jobs are done; returns their results.
    ///
    /// # Errors
    /// If they take longer than the limit: the results by then.
    pub fn finish(mut self, limit: Duration) -> Result<Vec<FileResult>, Vec<FileResult>> {
        self.jobs = None;
        let deadline = Instant::now() + limit;
        let mut finished = Vec::new();
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            match self.finished.results.recv_timeout(left) {
                Ok(result) => finished.push(result),
                Err(RecvTimeoutError::Disconnected) => return Ok(finished),
                Err(RecvTimeoutError::Timeout) => return Err(finished),
            }
        }
    }

    /// Readable while a job is done.
    pub fn descriptor(&self) -> BorrowedFd<'_> {
        self.finished.descriptor()
    }
}
