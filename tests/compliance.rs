//! What every client may rely on: the handshake, echoes, and refusals that change nothing.

use crate::harness::{SMALL, Server};
use crate::wire::{Wire, control_header, step_header};
use protocol::Model;
use protocol::control::{CoverageRule, Reply, Request};
use protocol::message::Status::{
    self, BadMove, Busy, LeaseLost, Malformed, NoLease, NoSuchWorld, NotPermitted,
    UnknownOperation, VersionMismatch, WrongLength, WrongPathLength,
};
use protocol::message::{
    ControlRequest, FLAG_FULL_COVERAGE, Operation, StepRequest, VERSION, split_step_payload,
};
use std::time::Duration;

/// Moves of a path on a [`SMALL`] server.
const N_MOVES: u32 = 6;

/// Cells of a [`SMALL`] server.
const N_CELLS: usize = 35;

/// Three worlds: two held by one client, one by another.
struct Table {
    server: Server,
    ours: Wire,
    theirs: Wire,
    our_lease: u64,
    their_lease: u64,
    ended_lease: u64,
}

impl Table {
    fn lay() -> Self {
        let server = Server::start(&format!("{SMALL} --worlds 3"));
        let (ours, theirs) = (Wire::open(&server.instance), Wire::open(&server.instance));
        let ended_lease = ours.acquire(0, 1).lease;
        assert_eq!(
            ours.ask(&Request::Release { lease: ended_lease }),
            Reply::Done
        );
        let (our_lease, their_lease) = (ours.acquire(0, 2).lease, theirs.acquire(2, 1).lease);
        let (reply, _) = ours.step(step_header(our_lease, N_MOVES), &[3; 6]);
        assert_eq!(reply.status, Status::Ok as u32);
        Self {
            server,
            ours,
            theirs,
            our_lease,
            their_lease,
            ended_lease,
        }
    }

    /// Everything that a refusal must not change: k, robots, holders, frames and results.
    fn everything(&self) -> (String, Vec<u8>) {
        let header = StepRequest {
            operation: Operation::Observe as u32,
            lease: 0,
            n_worlds: 3,
            n_moves: 0,
            ..step_header(0, 0)
        };
        let (reply, payload) = self.theirs.step(header, &[]);
        assert_eq!(reply.status, Status::Ok as u32, "observing needs no lease");
        (format!("{:?}", self.server.status().worlds), payload)
    }

    fn refused_step(&self, header: StepRequest, paths: &[u8], status: Status, detail: u64) {
        let before = self.everything();
        let (reply, payload) = self.ours.step(header, paths);
        assert_eq!(
            (Status::try_from(reply.status), reply.detail),
            (Ok(status), detail),
            "{header:?}"
        );
        assert_eq!(
            (reply.sequence, reply.first_world),
            (header.sequence, header.first_world)
        );
        assert_eq!(
            (reply.version, reply.n_worlds, payload.len()),
            (VERSION, 0, 0)
        );
        assert_eq!(self.everything(), before, "{status:?} changed something");
    }

    fn refused_control(&self, text: &str, status: Status, detail: u64, words: &str) {
        let before = self.everything();
        let (header, payload) = self.ours.control(control_header(9), text.as_bytes());
        assert_eq!(
            (Status::try_from(header.status), header.sequence),
            (Ok(status), 9),
            "{text}"
        );
        let reply: Reply = serde_json::from_slice(&payload).expect("a reply");
        let Reply::Error {
            status: said,
            detail: told,
            message,
        } = reply
        else {
            panic!("{text}: expected an error, got {reply:?}");
        };
        assert_eq!((said, told), (status, detail), "{text}");
        assert!(
            message.contains(words),
            "{text}: {message:?} does not say {words:?}"
        );
        assert_eq!(self.everything(), before, "{text} changed something");
    }
}

#[test]
fn a_handshake_tells_everything_a_client_needs() {
    let flags = "--height 5 --width 7 --moves 6 --burn-in 20 --worlds 3 --max-steps 9 \
                 --coverage client --lease-millis 1234 --publish-truth";
    let server = Server::start(flags);
    let info = server.info();
    assert_eq!((info.protocol, info.pid), (VERSION, server.program.pid()));
    assert_eq!(
        (info.height, info.width, info.n_moves, info.n_worlds),
        (5, 7, 6, 3)
    );
    assert_eq!(
        (info.burn_in, info.max_steps, info.lease_millis),
        (20, 9, 1234)
    );
    assert_eq!(
        (info.coverage, info.publish_truth),
        (CoverageRule::Client, true)
    );
    assert_eq!((info.n_observations, info.max_clients), (3, 16));
    assert_eq!(info.observations, ["normal", "latent", "fire"]);
    let model = Model::from_toml(&info.model.expect("revealed by default"));
    assert_eq!(model, Ok(Model::wildfire()));
}

#[test]
fn a_hidden_model_is_not_in_the_handshake() {
    let server = Server::start(&format!("{SMALL} --reveal-model false"));
    let text = br#"{"op":"hello","protocol":1,"client":"tests"}"#;
    let (_, payload) = Wire::open(&server.instance).control(control_header(1), text);
    let text = String::from_utf8(payload).expect("text");
    assert!(
        text.contains(r#""model":null"#) && !text.contains("kernel"),
        "{text}"
    );
}

#[test]
fn a_step_is_refused_for_one_reason_and_changes_nothing() {
    let table = Table::lay();
    let good = StepRequest {
        sequence: 41,
        ..step_header(table.our_lease, N_MOVES)
    };
    let path = [1; 6];
    let check = |change: &dyn Fn(&mut StepRequest), paths: &[u8], status, detail| {
        let mut header = good;
        change(&mut header);
        table.refused_step(header, paths, status, detail);
    };
    check(&|h| h.version = 2, &path, VersionMismatch, 1);
    check(&|h| h.version = 0, &path, VersionMismatch, 1);
    check(&|h| h.operation = 0, &path, UnknownOperation, 0);
    check(&|h| h.operation = 3, &path, UnknownOperation, 3);
    for (first, n_worlds) in [(0, 0), (3, 1), (0, 4), (2, 2), (u32::MAX, 1), (1, u32::MAX)] {
        let range = |h: &mut StepRequest| (h.first_world, h.n_worlds) = (first, n_worlds);
        check(&range, &path, NoSuchWorld, 3);
    }
    check(&|h| h.n_moves = 5, &path, WrongPathLength, 6);
    check(&|h| h.n_moves = u32::MAX, &path, WrongPathLength, 6);
    check(&|_| (), &[1; 5], WrongLength, 6);
    check(&|_| (), &[], WrongLength, 6);
    check(&|h| h.n_worlds = 2, &path, WrongLength, 12);
    check(&|_| (), &[1, 2, 3, 0, 1, 4], BadMove, 5);
    check(&|_| (), &[255, 2, 3, 0, 1, 4], BadMove, 0);
    check(&|h| h.flags = FLAG_FULL_COVERAGE, &path, NotPermitted, 0);
    check(&|h| h.lease = 0, &path, NoLease, 0);
    check(&|h| h.lease = u64::MAX, &path, NoLease, 0);
    check(&|h| h.first_world = 2, &path, NoLease, 2);
    let theirs = |h: &mut StepRequest| (h.first_world, h.lease) = (2, table.their_lease);
    check(&theirs, &path, NoLease, 2);
    check(&|h| h.n_worlds = 3, &[0; 18], NoLease, 2);
    let us = u64::from(std::process::id());
    check(&|h| h.lease = table.ended_lease, &path, LeaseLost, us);
    check(
        &|h| h.operation = Operation::Observe as u32,
        &path,
        WrongLength,
        0,
    );
}

#[test]
fn a_control_request_is_refused_for_one_reason_and_changes_nothing() {
    let table = Table::lay();
    let (ours, theirs, ended) = (table.our_lease, table.their_lease, table.ended_lease);
    let us = u64::from(std::process::id());
    let check = |text: &str, status, detail, words: &str| {
        table.refused_control(text, status, detail, words);
    };
    for text in [
        "",
        "{",
        "[]",
        "null",
        "\u{0}",
        r#"{"op":"dance"}"#,
        r#"{"op":"renew"}"#,
    ] {
        check(text, Malformed, 0, "malformed control message");
    }
    check(r#"{"op":"renew","lease":-1}"#, Malformed, 0, "-1");
    check(r#"{"op":"renew","lease":1,"more":2}"#, Malformed, 0, "more");
    check(
        r#"{"op":"hello","protocol":2,"client":""}"#,
        VersionMismatch,
        1,
        "version mismatch",
    );
    for range in [(0, 0), (3, 1), (0, 4), (u32::MAX, u32::MAX)] {
        let text = format!(
            r#"{{"op":"acquire","first_world":{},"n_worlds":{}}}"#,
            range.0, range.1
        );
        check(&text, NoSuchWorld, 3, "worlds 0 to 2");
    }
    check(
        r#"{"op":"acquire","first_world":1,"n_worlds":2}"#,
        Busy,
        us,
        "take the worlds over",
    );
    for op in ["renew", "release"] {
        let text = |lease: u64| format!(r#"{{"op":"{op}","lease":{lease}}}"#);
        check(&text(12345), NoLease, 0, "acquire it first");
        check(&text(theirs), NoLease, 2, "no lease on world 2");
        check(&text(ended), LeaseLost, us, "lease lost");
    }
    let reset = |lease: u64, worlds: &str| {
        format!(r#"{{"op":"reset","lease":{lease},"worlds":[{worlds}]}}"#)
    };
    let (first, second) = (r#"{"world":0}"#, r#"{"world":2}"#);
    check(&reset(ours, second), NoLease, 2, "no lease on world 2");
    check(
        &reset(ours, &format!("{first},{second}")),
        NoLease,
        2,
        "no lease",
    );
    check(&reset(theirs, second), NoLease, 2, "no lease on world 2");
    check(
        &reset(ours, r#"{"world":9}"#),
        NoSuchWorld,
        3,
        "worlds 0 to 2",
    );
    check(
        &reset(ours, &format!("{first},{first}")),
        Malformed,
        0,
        "world 0 twice",
    );
    check(&reset(ended, first), LeaseLost, us, "lease lost");
    check(
        &reset(ours, r#"{"world":0,"seed":1.5}"#),
        Malformed,
        0,
        "1.5",
    );
}

#[test]
fn another_version_is_refused_with_both_versions_and_what_to_do() {
    let server = Server::start(SMALL);
    let wire = Wire::open(&server.instance);
    for version in [0, 2, u32::MAX] {
        let header = ControlRequest {
            version,
            ..control_header(5)
        };
        let (reply, payload) = wire.control(header, br#"{"op":"status"}"#);
        assert_eq!(reply.status, VersionMismatch as u32);
        let text = String::from_utf8(payload).expect("text");
        assert!(
            text.contains("the server 1") && text.contains("one release"),
            "{text}"
        );
    }
    assert_eq!(server.status().n_refused, 3);
}

#[test]
fn a_step_answer_echoes_its_request_and_fits_its_payload() {
    let server = Server::start(&format!("{SMALL} --worlds 3"));
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(0, 3).lease;
    for sequence in [0, 1, u64::MAX] {
        let header = StepRequest {
            sequence,
            first_world: 1,
            n_worlds: 2,
            ..step_header(lease, N_MOVES)
        };
        let (reply, payload) = wire.step(header, &[3; 12]);
        assert_eq!(
            (reply.sequence, reply.first_world, reply.n_worlds),
            (sequence, 1, 2)
        );
        assert_eq!((reply.height, reply.width, reply.version), (5, 7, VERSION));
        let (results, frames) = split_step_payload(&reply, &payload).expect("a whole payload");
        assert_eq!((results.len(), frames.len()), (2, 2 * N_CELLS));
        assert!(reply.simulation_nanos > 0);
    }
}

#[test]
fn a_client_that_shuts_the_server_down_is_answered() {
    let server = Server::start(SMALL);
    let reply = Wire::open(&server.instance).ask(&Request::Shutdown {});
    assert_eq!(reply, Reply::Done);
    assert_eq!(server.program.wait(Duration::from_secs(1)).code, Some(0));
}
