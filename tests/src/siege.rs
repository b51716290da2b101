//! A server under attack. During the attack, a victim steps its world, which must evolve as if there were no attacker.
//! Afterwards the server must not hold more resources than before.

use crate::harness::{PATIENCE, Paths, Server, eventually};
use crate::meter::{memory, n_descriptors};
use crate::wire::{RawClient, Wire, step_body, step_header};
use emberwatch_protocol::channels::{Instance, SHARED_MEMORY};
use emberwatch_protocol::message::Status;
use emberwatch_protocol::path::path_to_bytes;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::time::Duration;

/// Flags of a server with three worlds: the victim's, the attacker's, and a free one.
pub const FLAGS: &str =
    "--height 5 --width 7 --moves 6 --burn-in 20 --worlds 3 --lease-millis 86400000";

/// Maximum growth of a server's private memory. It is not 0, because the allocator keeps some of the longest request's
/// memory (up to 5 MiB were measured) and tables of clients grow up to a limit.
const MOST_GROWTH_KIB: u64 = 8 << 10;

/// Pause between the victim's steps, which leaves processor time for the attacker.
const PACE: Duration = Duration::from_micros(500);

/// The resources that a server holds.
#[derive(Debug)]
struct Holdings {
    n_descriptors: usize,
    /// Mapped shared memory, in bytes.
    shared: u64,
    /// Private memory, in KiB.
    own: u64,
}

/// Starts a server and a victim, and runs an attack. Then checks that the victim was undisturbed, and that the server
/// holds no more resources than before.
pub fn besiege(attack: impl FnOnce(&Server)) {
    let server = Server::start(FLAGS);
    let (began, has_begun) = channel();
    let stop = AtomicBool::new(false);
    let seen = std::thread::scope(|scope| {
        let victim = scope.spawn(|| live(&server.instance, &began, &stop));
        has_begun.recv_timeout(PATIENCE).expect("a step");
        let before = Holdings::of(server.program.pid());
        // Stops the victim when dropped, because the victim would never end if the attack panicked.
        let stopped = Stop(&stop);
        attack(&server);
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

/// Runs the victim, which steps world 0 until `stop` is set. Returns the payloads of all answers.
fn live(instance: &Instance, began: &Sender<()>, stop: &AtomicBool) -> Vec<Vec<u8>> {
    let wire = Wire::open(instance);
    let lease = wire.acquire(0..1).lease;
    let (mut paths, mut seen) = (Paths::new(0), Vec::new());
    while !stop.load(Ordering::Relaxed) || seen.len() <= 50 {
        let body = step_body(&[seen.len() as u64], &path_to_bytes(&paths.next(6)));
        let (reply, payload) = wire.step(step_header(lease, 6), &body);
        assert_eq!(reply.status, Status::Ok as u32);
        seen.push(payload);
        if seen.len() == 1 {
            // The server has now allocated everything for the victim, so that later growth is due to the attack.
            began.send(()).expect("an attacker");
        }
        std::thread::sleep(PACE);
    }
    seen
}

/// Checks that a server without an attacker gives the same answers to the same requests.
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

/// Waits until a server holds no more resources than before.
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
