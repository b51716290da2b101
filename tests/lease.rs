//! Who may act: one holder a world, ended by release, expiry or takeover; the world stays put.

use crate::harness::{
    PATIENCE, Paths, SMALL, Server, claim, eventually, fly, new_instance, takeover,
};
use crate::wire::{RawClient, Wire, step_header};
use agent::client::{Claim, Client};
use protocol::Connection;
use protocol::connection::ConnectionError;
use protocol::control::{Reply, Request, WorldSeed};
use protocol::message::Status;
use std::time::{Duration, Instant};

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

fn paths(n_worlds: usize) -> Vec<Vec<protocol::Move>> {
    vec![Paths::new(0).next(6); n_worlds]
}

#[test]
fn a_world_has_one_holder_until_it_is_released() {
    let server = Server::start(&format!("{SMALL} --worlds 2"));
    let holder = server.acquire(0..1);
    check(
        Client::acquire(&server.instance, &claim(0..1)),
        Status::Busy,
        us(),
    );
    check(
        Client::acquire(&server.instance, &claim(0..2)),
        Status::Busy,
        us(),
    );
    let pids: Vec<_> = server
        .status()
        .worlds
        .iter()
        .map(|world| world.holder_pid)
        .collect();
    assert_eq!(
        pids,
        [Some(std::process::id()), None],
        "a refused claim takes no world"
    );
    holder.release().expect("release");
    assert_eq!(server.status().worlds[0].holder_pid, None);
    server.acquire(0..2);
}

#[test]
fn a_takeover_ends_the_former_lease_and_leaves_the_world_where_it_was() {
    let server = Server::start(SMALL);
    let mut former = server.acquire(0..1);
    let last = fly(&mut former, Paths::new(1).next(6));
    let mut next = Client::acquire(&server.instance, &takeover(0..1)).expect("take over");
    check(former.step(0..1, &paths(1)), Status::LeaseLost, us());
    check(
        former.reset(&[WorldSeed {
            world: 0,
            seed: None,
        }]),
        Status::LeaseLost,
        us(),
    );
    assert_eq!(
        next.observe(0..1).expect("observe"),
        std::slice::from_ref(&last)
    );
    assert_eq!(
        former.observe(0..1).expect("observing needs no lease"),
        [last]
    );
    assert_eq!(fly(&mut next, Paths::new(2).next(6)).result.step, 2);
    next.release().expect("release");
    check(former.step(0..1, &paths(1)), Status::LeaseLost, us());
    check(former.release(), Status::LeaseLost, us());
}

#[test]
fn a_takeover_of_some_worlds_leaves_the_others_with_their_holder() {
    let server = Server::start(&format!("{SMALL} --worlds 3"));
    let mut former = server.acquire(0..3);
    let mut next = Client::acquire(&server.instance, &takeover(1..2)).expect("take over");
    former.step(0..1, &paths(1)).expect("still held");
    former.step(2..3, &paths(1)).expect("still held");
    check(former.step(0..3, &paths(3)), Status::LeaseLost, us());
    next.step(1..2, &paths(1)).expect("taken");
    let steps: Vec<u64> = server
        .status()
        .worlds
        .iter()
        .map(|world| world.info.step)
        .collect();
    assert_eq!(steps, [1, 1, 1], "the refused batch stepped nothing");
}

#[test]
fn a_renewal_tells_of_the_worlds_that_are_still_held() {
    let server = Server::start(&format!("{SMALL} --worlds 3"));
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(0, 3).lease;
    let _next = Client::acquire(&server.instance, &takeover(1..2)).expect("take over");
    let Reply::Lease(renewed) = wire.ask(&Request::Renew { lease }) else {
        panic!("expected a lease");
    };
    let worlds: Vec<u32> = renewed.worlds.iter().map(|world| world.world).collect();
    assert_eq!(
        (renewed.lease, renewed.ttl_millis, worlds),
        (lease, 30_000, vec![0, 2])
    );
}

#[test]
fn a_lease_expires_unless_it_is_used_or_renewed() {
    let lasts = Duration::from_millis(400);
    let server = Server::start(&format!("{SMALL} --lease-millis 400 --worlds 2"));
    let (used, idle) = (Wire::open(&server.instance), Wire::open(&server.instance));
    let idle_lease = idle.acquire(1, 1).lease;
    let (mut last_use, mut held_since) = (Instant::now(), Instant::now());
    let mut lease = used.acquire(0, 1).lease;
    let mut renews = false;
    let expired = eventually(PATIENCE, || {
        let began = Instant::now();
        renews = !renews;
        let is_held = match renews {
            true => matches!(used.ask(&Request::Renew { lease }), Reply::Lease(_)),
            false => used.step(step_header(lease, 6), &[0; 6]).0.status == Status::Ok as u32,
        };
        if !is_held {
            // Right, if this test was paused for so long: then it begins anew.
            assert!(last_use.elapsed() > lasts, "lost without need");
            lease = used.acquire(0, 1).lease;
            held_since = began;
        }
        last_use = began;
        server.status().worlds[1].holder_pid.is_none() && held_since.elapsed() > 2 * lasts
    });
    assert!(expired);
    let lost = idle.ask(&Request::Renew { lease: idle_lease });
    assert_eq!(lost.status(), Status::LeaseLost, "{lost:?}");
}

#[test]
fn a_client_may_ask_for_a_lease_of_its_own_length() {
    let server = Server::start(SMALL);
    let short = Claim {
        time_to_live: Some(Duration::from_millis(150)),
        ..claim(0..1)
    };
    let mut client = Client::acquire(&server.instance, &short).expect("acquire");
    assert!(eventually(PATIENCE, || server.status().worlds[0]
        .holder_pid
        .is_none()));
    check(client.step(0..1, &paths(1)), Status::LeaseLost, 0);
    for (asked, given) in [(Some(0), 100), (Some(u64::MAX), 86_400_000), (None, 30_000)] {
        let request = Request::Acquire {
            first_world: 0,
            n_worlds: 1,
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
fn a_lease_outlives_a_burn_in_that_is_longer() {
    let flags = "--height 32 --width 32 --moves 6 --burn-in 500000 --lease-millis 100";
    let is_longer = |start: Instant| start.elapsed() > Duration::from_millis(200);
    let outlives_the_start = || {
        let server = Server::start_in_burn_in(&new_instance(), flags);
        let start = Instant::now();
        let mut client = server.acquire(0..1);
        is_longer(start) && client.step(0..1, &paths(1)).is_ok()
    };
    let server = Server::start(flags);
    let outlives_a_reset = |seed| {
        let order = WorldSeed {
            world: 0,
            seed: Some(seed),
        };
        let mut client = Client::acquire(&server.instance, &takeover(0..1)).expect("acquire");
        let start = Instant::now();
        client.reset(&[order]).is_ok() && is_longer(start) && client.step(0..1, &paths(1)).is_ok()
    };
    // Of several tries: who is paused after the burn-in loses the lease all the same.
    assert!((0..10).any(|_| outlives_the_start()));
    assert!((1..=10).any(outlives_a_reset));
}

#[test]
fn a_seventeenth_client_is_told_the_limit_and_others_go_on() {
    let server = Server::start(SMALL);
    let mut holder = server.acquire(0..1);
    let others: Vec<Wire> = (0..15).map(|_| Wire::open(&server.instance)).collect();
    let refused = Connection::open(&server.instance, "tests", PATIENCE);
    let problem = refused.err().expect("a seventeenth client").to_string();
    assert!(problem.contains("more than 16 clients"), "{problem}");
    fly(&mut holder, Paths::new(0).next(6));
    drop(others);
    server.connect();
}
