//! Watches the processes of clients and observers, and removes the files of dead ones.

use emberwatch_protocol::cleanup::remove_leftovers;
use emberwatch_protocol::limits::threads::spawn;
use emberwatch_protocol::program::WatchedProcess;
use emberwatch_protocol::throttle::Throttle;
use emberwatch_protocol::wait::sleep_until_readable;
use emberwatch_sim::simulator::ClientId;
use rustix::io::Errno;
use std::collections::{HashMap, HashSet};
use std::os::fd::BorrowedFd;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Maximum number of known nodes. A full table is emptied, so that a client that reconnects again and again cannot use
/// more and more memory.
const MAX_KNOWN_NODES: usize = 1024;

/// The processes of clients and observers, which are watched. When one has died, a separate thread removes its files,
/// because this takes milliseconds and must not delay steps.
#[derive(Default)]
pub struct Clients {
    nodes: HashMap<u128, u32>,
    processes: HashMap<u32, WatchedProcess>,
    unwatched: Throttle,
    is_cleanup_due: bool,
    cleanup: Option<JoinHandle<()>>,
}

impl Clients {
    pub fn identify(&mut self, node: u128) -> ClientId {
        if let Some(&pid) = self.nodes.get(&node) {
            return ClientId { node, pid };
        }
        // The upper bits of a node id contain the process id (PROTOCOL.md, section 1).
        let pid = (node >> 64) as u32;
        if self.nodes.len() == MAX_KNOWN_NODES {
            self.nodes.clear();
        }
        if self.watch(pid) {
            self.nodes.insert(node, pid);
        }
        ClientId { node, pid }
    }

    /// Returns one descriptor per process, which becomes readable when the process ends.
    pub fn descriptors(&self) -> impl Iterator<Item = BorrowedFd<'_>> {
        self.processes.values().map(WatchedProcess::descriptor)
    }

    /// Returns the process ids of clients and of `nodes` whose process has ended since the last call. Stops watching
    /// these processes and removes their files.
    pub fn take_dead(&mut self, nodes: &HashSet<u128>) -> Vec<u32> {
        for &node in nodes {
            self.identify(node);
        }
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
        self.is_cleanup_due |= !dead.is_empty();
        self.clean_up_if_due();
        dead
    }

    fn clean_up_if_due(&mut self) {
        let is_running = self.cleanup.as_ref().is_some_and(|it| !it.is_finished());
        if self.is_cleanup_due && !is_running {
            self.is_cleanup_due = false;
            self.cleanup = spawn("cleanup", clean_up).ok();
        }
    }

    /// Watches a process. Returns false if this failed and the caller should try again.
    fn watch(&mut self, pid: u32) -> bool {
        if self.processes.contains_key(&pid) {
            return true;
        }
        match WatchedProcess::open(i32::try_from(pid).unwrap_or(0)) {
            Ok(process) => self.processes.insert(pid, process).is_none(),
            // The process has already ended, so it cannot be watched. Its lease will expire.
            Err(Errno::SRCH) => {
                self.is_cleanup_due = true;
                true
            }
            Err(problem) => {
                if let Some(n_unsaid) = self.unwatched.pass(Instant::now()) {
                    tracing::warn!(
                        pid,
                        n_unsaid,
                        "a client cannot be watched, so its leases may outlive it: pidfd_open: {problem}"
                    );
                }
                false
            }
        }
    }
}

fn clean_up() {
    match remove_leftovers() {
        Ok(n_files) => tracing::debug!(n_files, "removed files of dead processes"),
        // Ignored, because the next program that starts tries again.
        Err(error) => tracing::debug!("could not remove files of dead processes: {error}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberwatch_protocol::wait::is_readable;
    use std::process::Command;

    #[test]
    fn a_death_wakes_the_descriptors_and_is_reported_once() {
        let mut clients = Clients::default();
        let mut child = Command::new("sleep").arg("600").spawn().expect("a process");
        let nodes = HashSet::from([1, 2].map(|node| u128::from(child.id()) << 64 | node));
        assert!(clients.take_dead(&nodes).is_empty());
        assert_eq!(
            clients.descriptors().count(),
            1,
            "a process is watched once"
        );
        assert!(!clients.descriptors().any(is_readable));
        child.kill().expect("kill it");
        child.wait().expect("wait for it");
        assert!(clients.descriptors().all(is_readable));
        assert_eq!(clients.take_dead(&nodes), [child.id()]);
        assert!(clients.take_dead(&nodes).is_empty());
    }
}
