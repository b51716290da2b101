//! Tests of leases: a robot has one holder until its lease is released or expires, or another client takes the robot
//! over. None of these events changes the robot's world.

use emberwatch_protocol::client::Claim;
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::control::{Reply, Request};
use emberwatch_protocol::message::Status;
use emberwatch_protocol::{Client, Connection};
use std::time::Duration;
use tests::harness::{PATIENCE, Paths, SMALL, Server, seed, send_paths};
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

#[test]
fn a_takeover_ends_the_lease_and_keeps_the_world() {
    let server = Server::start(&format!("{SMALL} --worlds 3"));
    let us = u64::from(std::process::id());
    let path = [Paths::new(0).next(6)];
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(1..3).lease;
    let mut former = server.acquire(0..1);
    let last = send_paths(&mut former, Paths::new(1).next(6));
    let mut next = server.take_over(0..2);
    check(former.step(0..1, &path), Status::LeaseLost, us);
    check(former.reset(&[seed(0, None)]), Status::LeaseLost, us);
    // Observing needs no lease.
    for client in [&mut next, &mut former] {
        let seen = client.observe(0..1).expect("observe");
        assert_eq!(seen, std::slice::from_ref(&last));
    }
    next.step(0..1, &path).expect("taken");
    assert_eq!([0, 1, 2].map(|robot| server.step_of(robot)), [2, 0, 0]);
    next.release().expect("release");
    check(former.step(0..1, &path), Status::LeaseLost, us);
    check(former.release(), Status::LeaseLost, us);
    // The answer to a renewal lists only the robots that the lease still holds.
    let Reply::Lease(renewed) = wire.ask(&Request::Renew { lease }) else {
        panic!("expected a lease");
    };
    assert_eq!((renewed.lease, renewed.ttl_millis), (lease, 30_000));
    assert_eq!(renewed.robots, [2]);
    assert!(renewed.worlds.iter().map(|world| world.world).eq([2]));
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
    check(
        client.step(0..1, &[Paths::new(0).next(6)]),
        Status::LeaseLost,
        0,
    );
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
    send_paths(&mut holder, Paths::new(0).next(6));
    drop(others);
    server.connect();
}
