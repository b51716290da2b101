//! Tests of leases: granting, use, expiry, takeover.

use super::lab::client;
use crate::simulator::lease::{Claim, Leases, Refusal};
use emberwatch_messages::message::Status;
use std::ops::Range;
use std::time::{Duration, Instant};

const TTL: Duration = Duration::from_secs(10);

fn claim(pid: u32, robots: Range<usize>, takeover: bool) -> Claim {
    Claim {
        client: client(pid),
        robots,
        takeover,
        time_to_live: TTL,
    }
}

fn give(leases: &mut Leases, now: Instant, claim: Claim, token: u64) {
    leases.acquire(now, claim, token).expect("free or taken");
}

fn lost<T>(to: u64) -> Result<T, Refusal> {
    Err(Refusal::new(Status::LeaseLost, to))
}

#[test]
fn a_lost_lease_names_the_new_holder_even_after_it_left() {
    let (mut leases, now) = (Leases::new(3), Instant::now());
    give(&mut leases, now, claim(1, 0..3, false), 11);
    give(&mut leases, now, claim(2, 0..1, true), 12);
    leases.release(now, 12, client(2)).expect("held");
    assert_eq!(leases.use_lease(now, 11, client(1), &(0..1)), lost(2));
    assert_eq!(leases.use_lease(now, 11, client(1), &(1..3)), Ok(()));
    give(&mut leases, now, claim(3, 1..3, true), 13);
    leases.release(now, 13, client(3)).expect("held");
    assert_eq!(leases.use_lease(now, 11, client(1), &(1..2)), lost(3));
    give(&mut leases, now, claim(4, 1..2, false), 14);
    // The refusal names the taker, not a later holder.
    assert_eq!(leases.use_lease(now, 11, client(1), &(1..2)), lost(3));
}

#[test]
fn a_world_is_replaced_only_by_the_holder_of_all_its_held_robots() {
    let (mut leases, now) = (Leases::new(6), Instant::now());
    give(&mut leases, now, claim(1, 1..2, false), 11);
    assert_eq!(leases.use_world(now, 11, client(1), 0..3), Ok(()));
    let no_lease = Err(Refusal::new(Status::NoLease, 3));
    assert_eq!(leases.use_world(now, 11, client(1), 3..6), no_lease);
    give(&mut leases, now, claim(2, 2..4, false), 12);
    let busy = Err(Refusal::new(Status::Busy, 2));
    assert_eq!(leases.use_world(now, 11, client(1), 0..3), busy);
    give(&mut leases, now, claim(1, 2..3, true), 13);
    assert_eq!(leases.use_world(now, 11, client(1), 0..3), Ok(()));
    assert_eq!(leases.use_world(now, 13, client(1), 0..3), Ok(()));
}

#[test]
fn held_robots_are_reported_bit_by_bit() {
    let (mut leases, now) = (Leases::new(128), Instant::now());
    give(&mut leases, now, claim(1, 64..66, false), 11);
    give(&mut leases, now, claim(2, 127..128, false), 12);
    assert_eq!(leases.held(64..128), 1 << 63 | 0b11);
    assert_eq!(leases.held_under(12, 64..128), 1 << 63);
    assert_eq!(leases.held(0..64), 0);
}
