//! Resets run here, on threads of their own, so that one client's burn-in never delays another's
//! step.

use crate::episode::{Episode, Rules};
use crate::simulator::ResetOrder;
use rayon::ThreadPool;
use rustix::event::{EventfdFlags, eventfd};
use rustix::io::Errno;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};

/// Resets under way.
pub struct Resets {
    threads: ThreadPool,
    rules: Arc<Rules>,
    done: Receiver<(usize, Box<Episode>)>,
    sender: Sender<(usize, Box<Episode>)>,
    /// Readable while `done` may hold something.
    signal: Arc<OwnedFd>,
}

impl Resets {
    /// Nothing under way.
    ///
    /// # Errors
    /// The system's, when it gives no event descriptor.
    pub fn new(threads: ThreadPool, rules: Rules) -> Result<Self, Errno> {
        let signal = Arc::new(eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?);
        let (sender, done) = channel();
        Ok(Self {
            threads,
            rules: Arc::new(rules),
            done,
            sender,
            signal,
        })
    }

    /// Starts the resets.
    pub fn start(&self, orders: Vec<ResetOrder>) {
        for order in orders {
            let (rules, sender, signal) =
                (self.rules.clone(), self.sender.clone(), self.signal.clone());
            self.threads.spawn(move || {
                // Errors mean that the server is gone, and with it whoever would read.
                let _ = sender.send(order.carry_out(&rules));
                let _ = rustix::io::write(&*signal, &1u64.to_ne_bytes());
            });
        }
    }

    /// The worlds that have been reset since the last call.
    pub fn finished(&self) -> Vec<(usize, Box<Episode>)> {
        let _ = rustix::io::read(&*self.signal, &mut [0u8; 8]);
        self.done.try_iter().collect()
    }

    /// Readable while a reset has finished.
    pub fn descriptor(&self) -> BorrowedFd<'_> {
        self.signal.as_fd()
    }
}
