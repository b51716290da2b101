//! Runs resets on separate threads, so that one client's burn-in never delays another client's step.

use super::completions::{CompletionSender, Completions, completions};
use emberwatch_protocol::channels::ChannelError;
use emberwatch_sim::simulator::ResetJob;
use emberwatch_sim::world::{Episode, Rules};
use rayon::ThreadPool;
use std::os::fd::BorrowedFd;
use std::sync::Arc;

pub struct Resets {
    threads: ThreadPool,
    rules: Arc<Rules>,
    finished: Completions<(usize, Box<Episode>)>,
    sender: CompletionSender<(usize, Box<Episode>)>,
}

impl Resets {
    pub fn new(threads: ThreadPool, rules: Rules) -> Result<Self, ChannelError> {
        let (sender, finished) = completions()?;
        Ok(Self {
            threads,
            rules: Arc::new(rules),
            finished,
            sender,
        })
    }

    pub fn start(&self, jobs: Vec<ResetJob>) {
        for job in jobs {
            let (rules, sender) = (self.rules.clone(), self.sender.clone());
            self.threads.spawn(move || sender.send(job.run(&rules)));
        }
    }

    pub fn finished(&self) -> Vec<(usize, Box<Episode>)> {
        self.finished.take()
    }

    pub fn descriptor(&self) -> BorrowedFd<'_> {
        self.finished.descriptor()
    }
}
