//! Who may act: one holder a robot, ended by release, expiry or takeover; its world stays put.

use emberwatch_protocol::client::Claim;
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::control::{Reply, Request};
use emberwatch_protocol::message::Status;
use emberwatch_protocol::{Client, Connection, Move};
use std::time::Duration;
use tests::harness::{PATIENCE, Paths, SMALL, Server, fly, seed};
use tests::wire::{RawClient, Wire};

fn check<T>(result: Result<T, ConnectionError>, expected: Status, expected_detail: u64) {
    match result {
        Err(ConnectionError::Refused { status, detail, .. }) => {
            assert_eq!((status, detail), (expected, expected_detail));
        }
        Err(other) => panic!("expected {expected:?}, got {other}"),
        Ok(_) => panic!("expected {expected:?}, got what was asked for"),
    }
}

fn us() -> u64 {
    std::process::id().into()
}

fn paths(n_robots: usize) -> Vec<Vec<Move>> {
    vec![Paths::new(0).next(6); n_robots]
}

#[test]
fn a_takeover_ends_the_lease_and_keeps_the_world() {
    let server = Server::start(SMALL);
    let mut former = server.acquire(0..1);
    let last = fly(&mut former, Paths::new(1).next(6));
    let mut next = server.take_over(0..1);
    check(former.step(0..1, &paths(1)), Status::LeaseLost, us());
    check(former.reset(&[seed(0, None)]), Status::LeaseLost, us());
    // Observing needs no lease.
    for client in [&mut next, &mut former] {
        let seen = client.observe(0..1).expect("observe");
        assert_eq!(seen, std::slice::from_ref(&last));
    }
    assert_eq!(fly(&mut next, Paths::new(2).next(6)).world.step, 2);
    next.release().expect("release");
    check(former.step(0..1, &paths(1)), Status::LeaseLost, us());
    check(former.release(), Status::LeaseLost, us());
}

#[test]
fn a_takeover_of_some_worlds_leaves_the_others_with_their_holder() {
    let server = Server::start(&format!("{SMALL} --worlds 3"));
    let mut former = server.acquire(0..3);
    let mut next = server.take_over(1..2);
    former.step(0..1, &paths(1)).expect("still held");
    former.step(2..3, &paths(1)).expect("still held");
    check(former.step(0..3, &paths(3)), Status::LeaseLost, us());
    next.step(1..2, &paths(1)).expect("taken");
    let steps = [0, 1, 2].map(|robot| server.step_of(robot));
    assert_eq!(steps, [1, 1, 1], "the refused batch stepped nothing");
}

#[test]
fn a_renewal_tells_of_the_robots_that_are_still_held() {
    let server = Server::start(&format!("{SMALL} --worlds 3"));
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(0..3).lease;
    let _next = server.take_over(1..2);
    let Reply::Lease(renewed) = wire.ask(&Request::Renew { lease }) else {
        panic!("expected a lease");
    };
    let worlds: Vec<u32> = renewed.worlds.iter().map(|world| world.world).collect();
    assert_eq!((renewed.lease, renewed.ttl_millis), (lease, 30_000));
    assert_eq!(renewed.robots, [0, 2]);
    assert_eq!(worlds, [0, 2]);
}

#[test]
fn a_client_may_ask_for_a_lease_of_its_own_length() {
    let server = Server::start(SMALL);
    let short = Claim {
        time_to_live: Some(Duration::from_millis(150)),
        ..Claim::new(0..1)
    };
    let mut client = Client::acquire(server.connect(), &short).expect("acquire");
    server.program.until(|| server.holder().is_none());
    check(client.step(0..1, &paths(1)), Status::LeaseLost, 0);
    for (asked, given) in [(Some(0), 100), (Some(u64::MAX), 86_400_000), (None, 30_000)] {
        let request = Request::Acquire {
            first_robot: 0,
            n_robots: 1,
            takeover: true,
            ttl_millis: asked,
        };
        let Reply::Lease(lease) = Wire::open(&server.instance).ask(&request) else {
            panic!("expected a lease");
        };
        assert_eq!(lease.ttl_millis, given, "{asked:?}");
    }
}

#[test]
fn a_seventeenth_client_is_told_the_limit_and_others_go_on() {
    let server = Server::start(SMALL);
    let mut holder = server.acquire(0..1);
    let others: Vec<Wire> = (0..15).map(|_| Wire::open(&server.instance)).collect();
    let refused = Connection::open(&server.instance, "tests", PATIENCE);
    let problem = refused.err().expect("a seventeenth client").to_string();
    assert!(
        problem.contains("at most 16 clients at a time"),
        "{problem}"
    );
    fly(&mut holder, Paths::new(0).next(6));
    drop(others);
    server.connect();
}

#[test]
fn paths_of_other_lengths_are_refused_though_their_sum_is_right() {
    let server = Server::start(&format!("{SMALL} --worlds 3"));
    let mut client = server.acquire(0..3);
    let paths_of = |lengths: [usize; 3]| lengths.map(|length| vec![Move::Up; length]).to_vec();
    let unequal = client.step(0..3, &paths_of([6, 5, 7]));
    check(unequal, Status::WrongPathLength, 6);
    let two = client.step(0..3, &paths_of([6, 6, 6])[..2]);
    check(two, Status::WrongLength, 42);
    assert_eq!(server.step_of(0), 0);
}
