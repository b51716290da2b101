//! Which processes the clients are and whether they run, and a thread that removes the files of dead ones.

use crate::simulator::ClientId;
use crate::throttle::Throttle;
use iceoryx2::prelude::PayloadHeader;
use iceoryx2::service::header::request_response::RequestHeader;
use protocol::channels::Ipc;
use protocol::cleanup::remove_leftovers;
use protocol::program::WatchedProcess;
use protocol::wait::sleep_until_readable;
use rustix::io::Errno;
use std::collections::HashMap;
use std::os::fd::BorrowedFd;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Nodes remembered before the table is emptied: bounds the memory that a client that always reconnects can take.
const MAX_KNOWN_NODES: usize = 1024;

/// How often to clean up without a request: for observers, whose death is not reported.
const CLEANUP_INTERVAL: Duration = Duration::from_secs(2);

/// The processes behind requests.
#[derive(Default)]
pub struct Clients {
    nodes: HashMap<u128, u32>,
    processes: HashMap<u32, WatchedProcess>,
    unwatched: Throttle,
}

/// Removes the files of dead processes. It is a thread because one dead process costs milliseconds, and steps must not
/// wait for that.
pub struct Cleaner {
    requests: Option<Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Clients {
    /// The process behind a request; watches it from now on.
    pub fn identify(&mut self, header: &RequestHeader) -> ClientId {
        let node_id = header.node_id();
        let node = node_id.value();
        if let Some(&pid) = self.nodes.get(&node) {
            return ClientId { node, pid };
        }
        let pid = node_id.pid::<Ipc>().map_or(0, |id| id.value() as u32);
        if self.nodes.len() == MAX_KNOWN_NODES {
            self.nodes.clear();
        }
        if self.watch(pid) {
            self.nodes.insert(node, pid);
        }
        ClientId { node, pid }
    }

    /// One descriptor per process, readable when it has ended.
    pub fn descriptors(&self) -> impl Iterator<Item = BorrowedFd<'_>> {
        self.processes.values().map(WatchedProcess::descriptor)
    }

    /// The processes that have ended since the last call; they are forgotten.
    pub fn take_dead(&mut self) -> Vec<u32> {
        let descriptors: Vec<BorrowedFd<'_>> = self.descriptors().collect();
        let ended = sleep_until_readable(&descriptors, Duration::ZERO).unwrap_or_default();
        let pids = self.processes.keys().copied().zip(ended);
        let dead: Vec<u32> = pids
            .filter(|(_, ended)| *ended)
            .map(|(pid, _)| pid)
            .collect();
        for pid in &dead {
            self.processes.remove(pid);
            self.nodes.retain(|_, process| process != pid);
        }
        dead
    }

    /// Watches a process; returns whether there is no need to try again.
    fn watch(&mut self, pid: u32) -> bool {
        if self.processes.contains_key(&pid) {
            return true;
        }
        match WatchedProcess::open(i32::try_from(pid).unwrap_or(0)) {
            Ok(process) => self.processes.insert(pid, process).is_none(),
            // A process that has ended already cannot be watched; its lease will expire.
            Err(Errno::SRCH) => true,
            Err(problem) => {
                if let Some(n_unsaid) = self.unwatched.pass(Instant::now()) {
                    tracing::warn!(
                        pid,
                        n_unsaid,
                        "a client cannot be watched, so its leases may outlive it: {problem}"
                    );
                }
                false
            }
        }
    }
}

impl Cleaner {
    /// Starts the thread.
    pub fn start() -> Self {
        let (requests, receiver) = channel();
        let thread = std::thread::Builder::new()
            .name("cleaner".into())
            .spawn(move || clean(&receiver));
        Self {
            requests: Some(requests),
            thread: thread.ok(),
        }
    }

    /// Asks it to clean up soon.
    pub fn request(&self) {
        if let Some(requests) = &self.requests {
            let _ = requests.send(());
        }
    }
}

impl Drop for Cleaner {
    fn drop(&mut self) {
        self.requests = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn clean(requests: &Receiver<()>) {
    while !matches!(
        requests.recv_timeout(CLEANUP_INTERVAL),
        Err(RecvTimeoutError::Disconnected)
    ) {
        match remove_leftovers() {
            Ok(0) => {}
            Ok(n_files) => tracing::debug!(n_files, "removed what dead processes left"),
            Err(error) => tracing::debug!("not removed what dead processes left: {error}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::wait::is_readable;
    use std::process::Command;

    #[test]
    fn a_death_wakes_the_wait_for_the_descriptors_and_is_told_once() {
        let mut clients = Clients::default();
        let mut child = Command::new("sleep").arg("600").spawn().expect("a process");
        clients.watch(child.id());
        clients.watch(child.id());
        assert_eq!(
            clients.descriptors().count(),
            1,
            "a process is watched once"
        );
        assert!(!clients.descriptors().any(is_readable));
        assert!(clients.take_dead().is_empty());
        child.kill().expect("kill it");
        child.wait().expect("wait for it");
        assert!(clients.descriptors().all(is_readable));
        assert_eq!(clients.take_dead(), [child.id()]);
        assert!(clients.take_dead().is_empty());
    }
}
