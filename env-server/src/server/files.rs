//! Writes and reads snapshot files on a separate thread, so that the disk never delays a step.

use super::completions::{Completions, completions};
use emberwatch_protocol::limits::threads::spawn;
use emberwatch_sim::snapshot::{Done, FileError, Job, WorldSpec};
use std::os::fd::BorrowedFd;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

const MAX_JOBS: u64 = 16;

pub type FileResult = (u64, Result<Done, FileError>);

pub struct Files {
    jobs: Option<Sender<(u64, Job)>>,
    n_jobs: u64,
    n_done: u64,
    finished: Completions<FileResult>,
}

impl Files {
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

    pub fn add(&mut self, job: Job) -> u64 {
        self.n_jobs += 1;
        if let Some(jobs) = &self.jobs {
            let _ = jobs.send((self.n_jobs, job));
        }
        self.n_jobs
    }

    /// Returns whether another job can be queued. A job occupies the queue until it is done, even if its client has
    /// stopped waiting.
    pub fn has_capacity(&self) -> bool {
        self.n_jobs - self.n_done < MAX_JOBS
    }

    pub fn finished(&mut self) -> Vec<FileResult> {
        let finished = self.finished.take();
        self.n_done += finished.len() as u64;
        finished
    }

    /// Waits until all jobs are done and returns their results.
    ///
    /// # Errors
    /// If the jobs take longer than `limit`. The error contains the results so far.
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

    pub fn descriptor(&self) -> BorrowedFd<'_> {
        self.finished.descriptor()
    }
}
