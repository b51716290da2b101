//! Tests of leases: granting, use, expiry, takeover.

use super::lease::{Claim, ClientId, Leases, Refusal};
use emberwatch_messages::message::Status;
use std::collections::HashSet;
use std::ops::Range;
use std::time::{Duration, Instant};

const TTL: Duration = Duration::from_secs(10);

fn client(pid: u32) -> ClientId {
    ClientId {
        node: u128::from(pid),
        pid,
    }
}

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

fn no_lease<T>(robot: u64) -> Result<T, Refusal> {
    Err(Refusal::new(Status::NoLease, robot))
}

fn lost<T>(to: u64) -> Result<T, Refusal> {
    Err(Refusal::new(Status::LeaseLost, to))
}

#[test]
fn a_robot_has_one_holder() {
    let (mut leases, now) = (Leases::new(4), Instant::now());
    give(&mut leases, now, claim(1, 0..2, false), 11);
    let refused = leases
        .acquire(now, claim(2, 1..3, false), 12)
        .expect_err("held");
    assert_eq!(refused, Refusal::new(Status::Busy, 1));
    assert!(leases.holder(2).is_none(), "a refused claim takes no robot");
    give(&mut leases, now, claim(2, 2..4, false), 13);
    assert_eq!(leases.use_lease(now, 11, client(1), &(0..2)), Ok(()));
    assert_eq!(leases.use_lease(now, 13, client(2), &(1..3)), no_lease(1));
}

#[test]
fn a_takeover_removes_the_robots_from_their_holder() {
    let (mut leases, now) = (Leases::new(2), Instant::now());
    give(&mut leases, now, claim(1, 0..2, false), 11);
    give(&mut leases, now, claim(2, 1..2, true), 12);
    assert_eq!(leases.use_lease(now, 11, client(1), &(0..1)), Ok(()));
    assert_eq!(leases.use_lease(now, 11, client(1), &(0..2)), lost(2));
    give(&mut leases, now, claim(3, 0..1, true), 13);
    assert_eq!(leases.renew(now, 11, client(1)).map(|_| ()), lost(3));
}

#[test]
fn use_extends_a_lease_and_disuse_ends_it() {
    let (mut leases, now) = (Leases::new(1), Instant::now());
    give(&mut leases, now, claim(1, 0..1, false), 11);
    let almost = now + TTL - Duration::from_millis(1);
    assert_eq!(leases.use_lease(almost, 11, client(1), &(0..1)), Ok(()));
    assert!(leases.expire(now + TTL).is_empty());
    let late = almost + TTL;
    assert_eq!(leases.use_lease(late, 11, client(1), &(0..1)), lost(0));
    assert_eq!(leases.expire(late).len(), 1);
    assert_eq!(leases.use_lease(late, 11, client(1), &(0..1)), lost(0));
    give(&mut leases, late, claim(2, 0..1, false), 12);
}

#[test]
fn a_lease_does_not_expire_while_its_client_waits() {
    let (mut leases, now) = (Leases::new(1), Instant::now());
    give(&mut leases, now, claim(1, 0..1, false), 11);
    leases.begin_wait(11);
    let late = now + 9 * TTL;
    assert!(leases.expire(late).is_empty());
    leases.end_wait(late, 11);
    assert_eq!(leases.use_lease(late, 11, client(1), &(0..1)), Ok(()));
    assert_eq!(leases.expire(late + TTL).len(), 1);
}

#[test]
fn a_lost_lease_names_the_current_holder_of_its_own_robots() {
    let (mut leases, now) = (Leases::new(2), Instant::now());
    give(&mut leases, now, claim(1, 0..1, false), 11);
    give(&mut leases, now, claim(2, 1..2, false), 12);
    give(&mut leases, now, claim(3, 1..2, true), 13);
    assert_eq!(leases.renew(now, 12, client(2)).map(|_| ()), lost(3));
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
fn a_stolen_token_does_not_work() {
    let (mut leases, now) = (Leases::new(1), Instant::now());
    give(&mut leases, now, claim(1, 0..1, false), 11);
    assert_eq!(leases.use_lease(now, 11, client(2), &(0..1)), no_lease(0));
    assert_eq!(leases.release(now, 11, client(2)), no_lease(0));
    assert_eq!(leases.release(now, 11, client(1)), Ok(()));
    assert!(leases.holder(0).is_none());
}

#[test]
fn a_closed_connection_and_a_dead_process_hold_no_robots() {
    let end = [
        |leases: &mut Leases| leases.end_of_nodes_except(&HashSet::from([2])),
        |leases: &mut Leases| leases.end_of_process(1),
    ];
    for end in end {
        let (mut leases, now) = (Leases::new(2), Instant::now());
        give(&mut leases, now, claim(1, 0..1, false), 11);
        give(&mut leases, now, claim(2, 1..2, false), 12);
        assert_eq!(end(&mut leases).len(), 1);
        assert!(leases.holder(0).is_none() && leases.holder(1).is_some());
    }
}

#[test]
fn robots_outside_the_server_are_refused() {
    let (mut leases, now) = (Leases::new(2), Instant::now());
    #[expect(
        clippy::reversed_empty_ranges,
        reason = "a hostile client may send such a range"
    )]
    for robots in [0..3, 2..2, 5..7, 1..0] {
        let refused = leases
            .acquire(now, claim(1, robots, true), 11)
            .expect_err("no such robot");
        assert_eq!(refused, Refusal::new(Status::NoSuchRobot, 2));
    }
}

#[test]
fn a_world_is_replaced_only_by_the_holder_of_all_its_held_robots() {
    let (mut leases, now) = (Leases::new(6), Instant::now());
    give(&mut leases, now, claim(1, 1..2, false), 11);
    assert_eq!(leases.use_world(now, 11, client(1), 0..3), Ok(()));
    assert_eq!(leases.use_world(now, 11, client(1), 3..6), no_lease(3));
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
