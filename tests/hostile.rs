//! Clients of the right types and the wrong intentions: whatever they send, the server lives and
//! other clients' worlds go on as if nothing had been.
//!
//! `cargo test -p tests -- --ignored` sends a million messages instead of twenty thousand.

use crate::attacker::Attacker;
use crate::harness::{PATIENCE, Paths, Server, claim, eventually, fly};
use crate::wire::{RawClient, Wire, answer, control_header, step_header};
use agent::client::Client;
use protocol::channels::Instance;
use protocol::control::{MAX_CONTROL_BYTES, Reply, Request, WorldSeed};
use protocol::message::{Status, StepRequest};
use protocol::path::path_to_bytes;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Sender, channel};

/// Three worlds: the first is the victim's, the second the attacker's, the third anybody's.
const FLAGS: &str = "--height 5 --width 7 --moves 6 --burn-in 20 --worlds 3";

/// Another client: steps world 0 until told to stop; returns every answer's payload.
fn live(instance: &Instance, tell_lease: &Sender<u64>, stop: &AtomicBool) -> Vec<Vec<u8>> {
    let wire = Wire::open(instance);
    let lease = wire.acquire(0, 1).lease;
    tell_lease.send(lease).expect("somebody steals the lease");
    let (mut paths, mut seen) = (Paths::new(0), Vec::new());
    while !stop.load(Ordering::Relaxed) || seen.is_empty() {
        let (reply, payload) = wire.step(step_header(lease, 6), &path_to_bytes(&paths.next(6)));
        assert_eq!(Status::try_from(reply.status), Ok(Status::Ok));
        seen.push(payload);
    }
    seen
}

/// Asserts that a server where nothing happened shows the same.
fn assert_undisturbed(seen: &[Vec<u8>]) {
    let server = Server::start(FLAGS);
    let wire = Wire::open(&server.instance);
    let (lease, mut paths) = (wire.acquire(0, 1).lease, Paths::new(0));
    for (step, payload) in seen.iter().enumerate() {
        let path = path_to_bytes(&paths.next(6));
        assert_eq!(
            wire.step(step_header(lease, 6), &path).1,
            *payload,
            "step {step}"
        );
    }
}

fn resident_kibibytes(pid: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).expect("its status");
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let number = line.and_then(|line| line.split_whitespace().next()?.parse().ok());
    number.expect("a number of KiB")
}

fn attack(n_messages: u64) {
    let server = Server::start(FLAGS);
    let (tell_lease, stolen) = channel();
    let stop = AtomicBool::new(false);
    let seen = std::thread::scope(|scope| {
        let victim = scope.spawn(|| live(&server.instance, &tell_lease, &stop));
        let stolen = stolen.recv_timeout(PATIENCE).expect("a lease");
        let mut attacker = Attacker::new(&server.instance, stolen, 1);
        let mut strike = |n_messages| (0..n_messages).for_each(|_| attacker.strike());
        strike(n_messages / 4);
        let before = resident_kibibytes(server.program.pid());
        strike(n_messages - n_messages / 4);
        let growth = resident_kibibytes(server.program.pid()).saturating_sub(before);
        assert!(growth < 8 << 10, "the server grew by {growth} KiB");
        stop.store(true, Ordering::Relaxed);
        let (refused, accepted) = (attacker.n_refused, attacker.n_accepted);
        assert!(refused > n_messages / 4, "{refused} refused: too tame");
        assert!(
            accepted > n_messages / 100,
            "{accepted} accepted: not like a client"
        );
        let counted = server.status().n_refused;
        assert!(
            (refused..=n_messages).contains(&counted),
            "{counted} counted, {refused} seen"
        );
        victim.join().expect("the other client lives")
    });
    assert!(seen.len() > 100, "{} steps prove little", seen.len());
    assert_undisturbed(&seen);
}

#[test]
fn random_messages_change_nothing_for_others() {
    attack(20_000);
}

#[test]
#[ignore = "takes minutes"]
fn a_million_random_messages_change_nothing_for_others() {
    attack(1_000_000);
}

#[test]
fn refusals_are_counted_one_by_one() {
    let server = Server::start(FLAGS);
    let wire = Wire::open(&server.instance);
    for count in 1..=100 {
        let (reply, _) = wire.step(step_header(1, 6), &[0; 6]);
        assert_eq!(reply.status, Status::NoLease as u32);
        wire.control(control_header(1), b"nonsense");
        assert_eq!(server.status().n_refused, 2 * count);
    }
}

#[test]
fn a_stolen_token_opens_nothing() {
    let server = Server::start(FLAGS);
    let (owner, thief) = (Wire::open(&server.instance), Wire::open(&server.instance));
    let lease = owner.acquire(0, 3).lease;
    let before = server.status().worlds;
    for world in 0..3 {
        let header = StepRequest {
            first_world: world,
            ..step_header(lease, 6)
        };
        assert_eq!(thief.step(header, &[0; 6]).0.status, Status::NoLease as u32);
    }
    let seed = |world| WorldSeed { world, seed: None };
    for request in [
        Request::Renew { lease },
        Request::Release { lease },
        Request::Reset {
            lease,
            worlds: vec![seed(0)],
        },
        Request::Reset {
            lease,
            worlds: vec![],
        },
    ] {
        assert_eq!(thief.ask(&request).status(), Status::NoLease, "{request:?}");
    }
    assert_eq!(server.status().worlds, before);
}

/// The header of a correct step of world 1.
fn second_world(lease: u64) -> StepRequest {
    StepRequest {
        first_world: 1,
        ..step_header(lease, 6)
    }
}

#[test]
fn requests_that_nobody_waits_for_do_not_wear_the_server_out() {
    let server = Server::start(FLAGS);
    let mut bystander = server.acquire(0..1);
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(1, 1).lease;
    for round in 0..2_000 {
        let step = wire
            .send_step(second_world(lease), &[3; 6])
            .expect("send a step");
        let control = wire.send_control(control_header(round), br#"{"op":"status"}"#);
        let control = control.expect("send a control request");
        let refused = wire.send_step(second_world(lease), &[3; 6]);
        assert!(refused.is_err(), "a client has one request under way");
        drop((step, control));
    }
    fly(&mut bystander, Paths::new(0).next(6));
    let (reply, _) = wire.step(second_world(lease), &[3; 6]);
    assert_eq!(reply.status, Status::Ok as u32);
}

#[test]
fn requests_that_wait_for_a_reset_and_are_given_up_do_not_wear_the_server_out() {
    let flags = "--height 64 --width 64 --moves 6 --burn-in 30000 --worlds 2";
    let server = Server::start(flags);
    let (mut bystander, mut watcher) = (server.acquire(0..1), server.connect());
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(1, 1).lease;
    let mut is_resetting = || match watcher.control(&Request::Status {}, PATIENCE) {
        Ok(Reply::Status(status)) => status.worlds[1].resetting,
        other => panic!("{other:?}: {}", server.program.stderr()),
    };
    let reset = format!(r#"{{"op":"reset","lease":{lease},"worlds":[{{"world":1,"seed":77}}]}}"#);
    let given_up = wire
        .send_control(control_header(0), reset.as_bytes())
        .expect("send");
    assert!(eventually(PATIENCE, &mut is_resetting));
    drop(given_up);
    let renew = format!(r#"{{"op":"renew","lease":{lease}}}"#);
    let mut n_given_up = 0;
    while is_resetting() {
        let given_up = wire
            .send_control(control_header(1), renew.as_bytes())
            .expect("send");
        fly(&mut bystander, Paths::new(0).next(6));
        is_resetting();
        drop(given_up);
        n_given_up += 1;
    }
    assert!(n_given_up > 20, "{n_given_up} prove little");
    let Reply::Lease(renewed) = wire.ask(&Request::Renew { lease }) else {
        panic!("expected the lease");
    };
    assert_eq!((renewed.worlds[0].seed, renewed.worlds[0].episode), (77, 1));
}

#[test]
fn messages_of_any_length_are_refused_whole() {
    let server = Server::start(FLAGS);
    let mut bystander = server.acquire(0..1);
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(1, 1).lease;
    for length in [
        1,
        7,
        4096,
        4097,
        100_000,
        MAX_CONTROL_BYTES + 1,
        3 * MAX_CONTROL_BYTES,
    ] {
        let (reply, _) = wire.step(second_world(lease), &vec![0; length]);
        assert_eq!(
            (reply.status, reply.detail),
            (Status::WrongLength as u32, 6)
        );
        let (reply, text) = wire.control(control_header(1), &vec![b' '; length]);
        assert_eq!(
            reply.status,
            Status::Malformed as u32,
            "{}",
            String::from_utf8_lossy(&text)
        );
        fly(&mut bystander, Paths::new(0).next(6));
    }
    let nested = "[".repeat(100_000);
    let (reply, _) = wire.control(control_header(1), nested.as_bytes());
    assert_eq!(reply.status, Status::Malformed as u32);
}

#[test]
fn clients_that_come_and_go_in_the_middle_of_everything_disturb_nobody() {
    let server = Server::start(FLAGS);
    let mut bystander = server.acquire(0..1);
    for round in 1..=60 {
        let wire = Wire::open(&server.instance);
        let step = wire
            .send_step(step_header(round, 6), &[3; 6])
            .expect("send");
        let control = wire.send_control(control_header(round), br#"{"op":"status"}"#);
        match round % 3 {
            0 => drop((wire, step, control)),
            1 => drop((step, wire, control)),
            _ => drop((answer(&step, PATIENCE), control, wire)),
        }
        assert_eq!(
            fly(&mut bystander, Paths::new(0).next(6)).result.step,
            round
        );
    }
    assert!(Client::acquire(&server.instance, &claim(1..3)).is_ok());
}
