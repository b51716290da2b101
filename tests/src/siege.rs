//! A server under attack: beside the attacker a victim steps its world, which must go as if nobody else
//! were there, and afterwards the server must hold no more than before.

use crate::harness::{PATIENCE, Paths, Server, eventually};
use crate::meter::{memory, n_descriptors};
use crate::wire::{RawClient, Wire, step_body, step_header};
use emberwatch_protocol::channels::{Instance, SHARED_MEMORY};
use emberwatch_protocol::message::Status;
use emberwatch_protocol::path::path_to_bytes;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::time::Duration;

/// Three worlds: the first is the victim's, the second the attacker's, the third anybody's.
pub const FLAGS: &str =
    "--height 5 --width 7 --moves 6 --burn-in 20 --worlds 3 --lease-millis 86400000";

/// How much more memory of its own a server may have in the end than in the beginning: its allocator
/// keeps some of what the longest request took (5 MiB were seen), and tables of clients have bounds.
const MOST_GROWTH_KIB: u64 = 8 << 10;

/// How often the victim steps: beside the attacker, not instead of it.
const PACE: Duration = Duration::from_micros(500);

/// What a server holds.
#[derive(Debug)]
struct Holdings {
    n_descriptors: usize,
    /// Shared memory that it has mapped, bytes.
    shared: u64,
    /// Memory of its own, KiB.
    own: u64,
}

/// Starts a server and a victim, and runs an attack, which is told the victim's lease; then checks
/// that neither noticed.
pub fn besiege(attack: impl FnOnce(&Server, u64)) {
    let server = Server::start(FLAGS);
    let (tell_lease, stolen) = channel();
    let stop = AtomicBool::new(false);
    let seen = std::thread::scope(|scope| {
        let victim = scope.spawn(|| live(&server.instance, &tell_lease, &stop));
        let stolen = stolen.recv_timeout(PATIENCE).expect("a lease");
        let before = Holdings::of(server.program.pid());
        // Also when the attack fails: the victim waits for it.
        let stopped = Stop(&stop);
        attack(&server, stolen);
        check_holdings(server.program.pid(), &before);
        drop(stopped);
        victim.join().expect("the victim lives")
    });
    assert!(seen.len() > 50, "{} steps prove little", seen.len());
    assert_undisturbed(&seen);
}

/// Ends the victim's loop on drop.
struct Stop<'a>(&'a AtomicBool);

impl Drop for Stop<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// The victim: steps world 0 until told to stop; returns every answer's payload.
fn live(instance: &Instance, tell_lease: &Sender<u64>, stop: &AtomicBool) -> Vec<Vec<u8>> {
    let wire = Wire::open(instance);
    let lease = wire.acquire(0..1).lease;
    let (mut paths, mut seen) = (Paths::new(0), Vec::new());
    while !stop.load(Ordering::Relaxed) || seen.len() <= 50 {
        let body = step_body(&[seen.len() as u64], &path_to_bytes(&paths.next(6)));
        let (reply, payload) = wire.step(step_header(lease, 6), &body);
        assert_eq!(reply.status, Status::Ok as u32);
        seen.push(payload);
        if seen.len() == 1 {
            // From here on nothing of the victim's is new to the server.
            tell_lease.send(lease).expect("somebody steals the lease");
        }
        std::thread::sleep(PACE);
    }
    seen
}

/// Asserts that a server where nothing happened shows the same.
fn assert_undisturbed(seen: &[Vec<u8>]) {
    let server = Server::start(FLAGS);
    let wire = Wire::open(&server.instance);
    let (lease, mut paths) = (wire.acquire(0..1).lease, Paths::new(0));
    for (step, payload) in seen.iter().enumerate() {
        let body = step_body(&[step as u64], &path_to_bytes(&paths.next(6)));
        assert_eq!(
            wire.step(step_header(lease, 6), &body).1,
            *payload,
            "step {step}"
        );
    }
}

impl Holdings {
    fn of(pid: u32) -> Self {
        let maps = std::fs::read_to_string(format!("/proc/{pid}/maps")).expect("its memory");
        let length = |line: &str| {
            let (from, to) = line.split_whitespace().next()?.split_once('-')?;
            let address = |text| u64::from_str_radix(text, 16).ok();
            Some(address(to)? - address(from)?)
        };
        let shared = maps.lines().filter(|line| line.contains(SHARED_MEMORY));
        Self {
            n_descriptors: n_descriptors(pid),
            shared: shared.filter_map(length).sum(),
            own: memory("RssAnon:", pid),
        }
    }
}

/// Waits until a server holds no more than it did.
fn check_holdings(pid: u32, before: &Holdings) {
    let mut now = Holdings::of(pid);
    let is_as_before = eventually(PATIENCE, || {
        now = Holdings::of(pid);
        now.n_descriptors <= before.n_descriptors
            && now.shared <= before.shared
            && now.own <= before.own + MOST_GROWTH_KIB
    });
    assert!(is_as_before, "before: {before:?}, after: {now:?}");
}
