//! Tests with clients that send hostile content in valid message types. The server must survive, and the worlds of
//! other clients must continue undisturbed.

use emberwatch_protocol::Connection;
use emberwatch_protocol::channels::{Channel, MAX_CLIENTS, MAX_OBSERVERS, Services, create_node};
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::control::MAX_CONTROL_BYTES;
use emberwatch_protocol::message::{Status, StepRequest};
use emberwatch_protocol::observer::Observer;
use rustix::process::{Pid, Resource, Rlimit, getrlimit, prlimit};
use std::time::{Duration, Instant};
use tests::fuzz::TARGETS;
use tests::harness::{ENDLESS, PATIENCE, Server, eventually, new_instance};
use tests::siege::{FLAGS, besiege};
use tests::wire::{RawClient, Wire, client, control_header, step_body, step_header};

#[test]
fn a_server_recovers_when_it_has_descriptors_again() {
    let server = Server::start(FLAGS);
    let limit = |current| {
        let pid = Pid::from_raw(server.program.pid() as i32);
        let limits = Rlimit {
            current: Some(current),
            ..getrlimit(Resource::Nofile)
        };
        prlimit(pid, Resource::Nofile, limits).expect("limit the server");
    };
    limit(12);
    let unheard = Connection::open(&server.instance, "tests", Duration::from_secs(1));
    assert!(matches!(unheard, Err(ConnectionError::Timeout { .. })));
    let words = "no file descriptors for a client or an observer";
    server.program.wait_for_words(words);
    limit(512);
    server.connect();
}

/// Returns the header of a correct step of robot 1.
fn second_robot(lease: u64) -> StepRequest {
    StepRequest {
        first_robot: 1,
        ..step_header(lease, 6)
    }
}

/// Returns the payload of a step of one world.
fn body(k: u64) -> Vec<u8> {
    step_body(&[k], &[3; 6])
}

/// Steps robot 1 from its world's current step.
fn fly_second(server: &Server, wire: &Wire, lease: u64) -> Status {
    wire.status_of(second_robot(lease), &body(server.step_of(1)))
        .0
}

#[test]
fn requests_whose_answers_nobody_reads_disturb_nobody() {
    besiege(|server| {
        let wire = Wire::open(&server.instance);
        let lease = wire.acquire(1..2).lease;
        for round in 0..1_000 {
            // All these paths are for step 0, so only the first may be flown and all later ones are late.
            let step = wire.send_step(second_robot(lease), &body(0)).expect("send");
            let control = wire.send_control(control_header(round), br#"{"op":"status"}"#);
            let refused = wire.send_step(second_robot(lease), &body(0));
            assert!(refused.is_err(), "more than one pending request");
            drop((step, control.expect("send")));
        }
        assert!(server.step_of(1) <= 1, "a step was made twice");
        assert_eq!(fly_second(server, &wire, lease), Status::Ok);
    });
}

#[test]
fn abandoned_requests_during_a_burn_in_leak_nothing() {
    let flags = format!("--burn-in {ENDLESS}");
    let server = Server::start_without_waiting(&new_instance(), &flags);
    server.program.wait_for_words("serving");
    let wire = Wire::open(&server.instance);
    let acquire = br#"{"op":"acquire","first_robot":0,"n_robots":1,"takeover":true}"#;
    for _ in 0..50 {
        let waiting = wire.send_control(control_header(0), acquire);
        let is_held = || server.holder() == Some(std::process::id());
        server.program.until(is_held);
        drop(waiting.expect("send"));
    }
}

#[test]
fn held_samples_limit_only_their_holder() {
    besiege(|server| {
        let wire = Wire::open(&server.instance);
        let lease = wire.acquire(1..2).lease;
        let mut held = Vec::new();
        for _ in 0..200 {
            // A client that keeps too many answers can no longer send, or receives no answer.
            let Ok(pending) = wire.send_step(second_robot(lease), &body(held.len() as u64)) else {
                break;
            };
            let n_held = held.len();
            eventually(Duration::from_millis(20), || {
                held.extend(pending.receive().ok().flatten());
                held.len() > n_held
            });
        }
        assert!(!held.is_empty(), "no answer at all");
        let pending = wire.send_control(control_header(1), b"{}");
        assert!(server.step_of(1) > 0, "another client is answered");
        drop((held, pending));
        assert_eq!(fly_second(server, &wire, lease), Status::Ok);
    });
}

#[test]
fn half_open_connections_use_only_their_own_slots() {
    besiege(|server| {
        for _ in 0..4 {
            let mut ports = Vec::new();
            // The victim occupies one of the client slots.
            for _ in 1..MAX_CLIENTS {
                let node = create_node().expect("a node");
                let services = Services {
                    node: &node,
                    instance: &server.instance,
                };
                let step = client(&services.open_step().expect("the service"));
                let listener = services.listener(Channel::WakeClient).expect("a listener");
                ports.push((step.expect("a place"), listener, node));
            }
            let crowded = Connection::open(&server.instance, "tests", PATIENCE);
            let problem = crowded.err().expect("a place too many").to_string();
            let words = "at most 16 clients at a time";
            assert!(problem.contains(words), "{problem}");
        }
        server.acquire(1..3);
    });
}

#[test]
fn observers_that_come_and_go_leave_nothing() {
    besiege(|server| {
        for _ in 0..3 {
            let observe = |_| Observer::frames(&server.instance).expect("a place");
            let kept: Vec<_> = (0..MAX_OBSERVERS).map(observe).collect();
            assert!(
                Observer::frames(&server.instance).is_err(),
                "a place too many"
            );
            drop(kept);
        }
    });
}

#[test]
fn messages_of_any_length_get_short_replies() {
    let longest = |(begin, unit, end, status): (&str, &str, &str, Status)| {
        let room = MAX_CONTROL_BYTES - begin.len() - end.len();
        let text = [begin, &unit.repeat(room / unit.len()), end].concat();
        (text, status)
    };
    let malformed = Status::Malformed;
    let end = r#""}"#;
    let mut texts = Vec::from(
        [
            (
                r#"{"op":"hello","protocol":3,"client":""#,
                "x",
                end,
                Status::Ok,
            ),
            (r#"{"op":""#, "x", end, malformed),
            (r#"{"op":"status",""#, "é", r#"":1}"#, malformed),
            (r#"{"op":"renew","lease":""#, "x", end, malformed),
            (
                r#"{"op":"reset","lease":1,"worlds":["#,
                r#"{"world":1},"#,
                r#"{"world":2}]}"#,
                Status::NoLease,
            ),
            ("", "9", "", malformed),
        ]
        .map(longest),
    );
    let lengths = [
        1,
        7,
        4096,
        4097,
        100_000,
        MAX_CONTROL_BYTES + 1,
        3 * MAX_CONTROL_BYTES,
    ];
    texts.extend(lengths.map(|length| (" ".repeat(length), malformed)));
    besiege(|server| {
        let wire = Wire::open(&server.instance);
        let lease = wire.acquire(1..2).lease;
        for (text, expected) in &texts {
            let (reply, answer) = wire.control(control_header(1), text.as_bytes());
            let (begin, got) = (text.get(..40), answer.len());
            assert_eq!(reply.status, *expected as u32, "{begin:?}");
            assert!(got <= 16 << 10, "{got} bytes in answer to {begin:?}");
            let refused = wire.status_of(second_robot(lease), text.as_bytes());
            assert_eq!(refused, (Status::WrongLength, 8 + 6));
        }
        throw_corpus(&wire);
    });
}

/// Sends the files that the fuzz targets begin with, from a client that holds world 1.
fn throw_corpus(wire: &Wire) {
    let mut n_accepted = 0;
    for target in &TARGETS {
        for file in target.corpus().expect("its corpus") {
            let lease = wire.acquire(1..2).lease;
            let (mut text, mut request, mut body) = (file.clone(), second_robot(lease), &*file);
            if target.name == "control_request" {
                let replaced = String::from_utf8_lossy(&file[1..]);
                text = replaced.replace("LEASE", &lease.to_string()).into();
            }
            if target.name == "step_request" {
                let (header, rest) = file.split_at(size_of::<StepRequest>());
                body = rest;
                request = StepRequest {
                    lease,
                    ..bytemuck::pod_read_unaligned(header)
                };
            }
            wire.status_of(request, body);
            // Other clients may end the server, and write files that it can write.
            let is_meant = |word: &str| String::from_utf8_lossy(&text).contains(word);
            if !["shutdown", "snapshot"].into_iter().any(is_meant) {
                let (reply, _) = wire.control(control_header(1), &text);
                n_accepted += u32::from(reply.status == Status::Ok as u32);
            }
        }
    }
    assert!(n_accepted > 4, "{n_accepted} requests were accepted");
}

#[test]
#[ignore = "takes a minute"]
fn a_server_survives_the_corpus_for_a_minute() {
    besiege(|server| {
        let wire = Wire::open(&server.instance);
        let begin = Instant::now();
        while begin.elapsed() < Duration::from_secs(60) {
            throw_corpus(&wire);
        }
    });
}
