//! A channel for results of other threads, with a descriptor that wakes the server's loop.

use emberwatch_protocol::channels::{ChannelError, call_error};
use rustix::event::{EventfdFlags, eventfd};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};

pub struct Completions<T> {
    pub results: Receiver<T>,
    signal: Arc<OwnedFd>,
}

pub struct CompletionSender<T> {
    results: Sender<T>,
    signal: Arc<OwnedFd>,
}

pub fn completions<T>() -> Result<(CompletionSender<T>, Completions<T>), ChannelError> {
    let signal = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK);
    let signal = Arc::new(signal.map_err(|errno| call_error("eventfd2", errno))?);
    let (sender, results) = channel();
    let sender = CompletionSender {
        results: sender,
        signal: signal.clone(),
    };
    Ok((sender, Completions { results, signal }))
}

impl<T> CompletionSender<T> {
    /// Sends a result. Does nothing if the server has ended.
    pub fn send(&self, result: T) {
        let _ = self.results.send(result);
        let _ = rustix::io::write(&*self.signal, &1u64.to_ne_bytes());
    }
}

impl<T> Clone for CompletionSender<T> {
    fn clone(&self) -> Self {
        Self {
            results: self.results.clone(),
            signal: self.signal.clone(),
        }
    }
}

impl<T> Completions<T> {
    pub fn take(&self) -> Vec<T> {
        let _ = rustix::io::read(&*self.signal, &mut [0u8; 8]);
        self.results.try_iter().collect()
    }

    pub fn descriptor(&self) -> BorrowedFd<'_> {
        self.signal.as_fd()
    }
}
