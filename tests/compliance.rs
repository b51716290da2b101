//! Tests what the protocol guarantees to every client: the handshake, echoed request fields, and refusals that change
//! nothing. The suite runs with the Rust client and with `wire_reference.py`.

use crate::python::PythonWire;
use emberwatch_protocol::Model;
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::control::{CoverageRule, Reply, Request};
use emberwatch_protocol::message::Status::{
    self, BadMove, Early, Incomplete, Late, LeaseLost, NoLease, NoSuchRobot, NotPermitted,
    UnknownFlags, UnknownOperation, VersionMismatch, WrongLength, WrongPathLength,
};
use emberwatch_protocol::message::{
    ControlRequest, FLAG_FULL_COVERAGE, FLAG_TEAM_FRAMES, Operation, StepRequest, VERSION,
};
use emberwatch_protocol::payload::split_step_payload;
use tests::harness::{SMALL, Server};
use tests::wire::{RawClient, Wire, control_header, observe_header, step_body, step_header};

/// Number of moves in a path on a [`SMALL`] server.
const N_MOVES: u32 = 6;

/// Number of cells of a world on a [`SMALL`] server.
const N_CELLS: usize = 35;

/// The client implementation that runs the suite.
#[derive(Clone, Copy)]
enum Client {
    Rust,
    Python,
}

impl Client {
    /// Opens both channels of an instance without a handshake.
    fn open(self, instance: &Instance) -> Box<dyn RawClient> {
        match self {
            Self::Rust => Box::new(Wire::open(instance)),
            Self::Python => Box::new(PythonWire::open(instance)),
        }
    }
}

/// Generates one test for each pair of a fact and a client.
macro_rules! suite {
    ($($fact:ident),* $(,)?) => {
        mod rust {
            $(#[test]
            fn $fact() {
                super::$fact(super::Client::Rust);
            })*
        }

        mod python {
            $(#[test]
            #[ignore = "needs Python: scripts/test runs it"]
            fn $fact() {
                super::$fact(super::Client::Python);
            })*
        }
    };
}

suite! {
    a_handshake_tells_everything_a_client_needs,
    a_step_of_wrong_numbers_is_refused_and_changes_nothing,
    a_step_without_a_lease_changes_nothing,
    a_damaged_or_outdated_step_changes_nothing,
    a_control_request_is_refused_for_one_reason_and_changes_nothing,
    another_version_is_refused_with_both_versions_and_what_to_do,
    a_step_answer_echoes_its_request_and_fits_its_payload,
    a_client_that_shuts_the_server_down_is_answered,
}

/// A server with three worlds of two robots. One client holds five robots, another client the last one.
struct Table {
    server: Server,
    ours: Box<dyn RawClient>,
    theirs: Box<dyn RawClient>,
    our_lease: u64,
    their_lease: u64,
    ended_lease: u64,
}

impl Table {
    fn lay(client: Client) -> Self {
        let flags = "--worlds 3 --robots 2 --lease-millis 86400000";
        let server = Server::start(&format!("{SMALL} {flags}"));
        let (ours, theirs) = (client.open(&server.instance), client.open(&server.instance));
        let ended_lease = ours.acquire(0..1).lease;
        let released = ours.ask(&Request::Release { lease: ended_lease });
        assert_eq!(released, Reply::Done);
        let (our_lease, their_lease) = (ours.acquire(0..5).lease, theirs.acquire(5..6).lease);
        let header = StepRequest {
            n_robots: 2,
            ..step_header(our_lease, N_MOVES)
        };
        let flown = ours.status_of(header, &step_body(&[0], &[3; 12]));
        assert_eq!(flown.0, Status::Ok);
        Self {
            server,
            ours,
            theirs,
            our_lease,
            their_lease,
            ended_lease,
        }
    }

    /// Returns everything that a refusal must leave unchanged: k, robots, holders, frames and results.
    fn everything(&self) -> (String, Vec<u8>) {
        let (reply, payload) = self.theirs.step(observe_header(0..6), &[]);
        assert_eq!(reply.status, Status::Ok as u32, "observing needs no lease");
        (format!("{:?}", self.server.status().worlds), payload)
    }

    /// Applies a change to a correct step request for world 0, and checks that it is refused.
    fn check(&self, change: impl Fn(&mut StepRequest), status: Status, detail: u64) {
        self.check_body(change, &step_body(&[1], &[1; 12]), status, detail);
    }

    fn check_body(
        &self,
        change: impl Fn(&mut StepRequest),
        body: &[u8],
        status: Status,
        detail: u64,
    ) {
        let mut header = StepRequest {
            sequence: 41,
            n_robots: 2,
            ..step_header(self.our_lease, N_MOVES)
        };
        change(&mut header);
        let before = self.everything();
        let (reply, payload) = self.ours.step(header, body);
        let refusal = (reply.status, reply.detail);
        assert_eq!(refusal, (status as u32, detail), "{header:?}");
        assert_eq!(
            (reply.sequence, reply.first_robot, reply.flags),
            (header.sequence, header.first_robot, header.flags)
        );
        let counts = (reply.n_worlds, reply.n_robots, payload.len());
        assert_eq!((reply.version, counts), (VERSION, (0, 0, 0)));
        assert_eq!(self.everything(), before, "{status:?} changed something");
    }

    fn refused_control(&self, text: &str, status: Status, detail: u64, words: &str) {
        let before = self.everything();
        let (header, payload) = self.ours.control(control_header(9), text.as_bytes());
        let answered = (header.status, header.sequence);
        assert_eq!(answered, (status as u32, 9), "{text}");
        match serde_json::from_slice(&payload).expect("a reply") {
            Reply::Error {
                status: said,
                detail: told,
                message,
            } => {
                assert_eq!((said, told), (status, detail), "{text}");
                assert!(
                    message.contains(words),
                    "{text}: {message:?}, not {words:?}"
                );
            }
            other => panic!("{text}: expected an error, got {other:?}"),
        }
        assert_eq!(self.everything(), before, "{text} changed something");
    }
}

fn a_handshake_tells_everything_a_client_needs(client: Client) {
    let flags = "--height 5 --width 7 --moves 6 --burn-in 20 --worlds 3 --max-steps 9 \
                 --coverage client --lease-millis 1234 --publish-truth --robots 2 --deadline-millis 99";
    let server = Server::start(flags);
    let request = Request::Hello {
        protocol: VERSION,
        client: "tests".into(),
    };
    let Reply::Hello(info) = client.open(&server.instance).ask(&request) else {
        panic!("expected a handshake");
    };
    assert_eq!((info.protocol, info.pid), (VERSION, server.program.pid()));
    assert_eq!((info.height, info.width), (5, 7));
    assert_eq!((info.n_moves, info.n_worlds, info.n_robots), (6, 3, 2));
    assert_eq!((info.burn_in, info.max_steps), (20, 9));
    assert_eq!((info.lease_millis, info.deadline_millis), (1234, 99));
    assert_eq!(info.coverage, CoverageRule::Client);
    assert!(info.publish_truth);
    assert_eq!((info.n_observations, info.max_clients), (3, 16));
    assert_eq!(info.observations, ["normal", "latent", "fire"]);
    let model = Model::from_toml(&info.model.expect("revealed by default"));
    assert_eq!(model, Ok(Model::wildfire()));
    let server = Server::start(&format!("{SMALL} --reveal-model false"));
    let text = serde_json::to_vec(&request).expect("requests serialise");
    let wire = client.open(&server.instance);
    let (_, payload) = wire.control(control_header(1), &text);
    let text = String::from_utf8(payload).expect("text");
    let is_hidden = text.contains(r#""model":null"#) && !text.contains("kernel");
    assert!(is_hidden, "{text}");
}

fn a_step_of_wrong_numbers_is_refused_and_changes_nothing(client: Client) {
    let steps = Table::lay(client);
    steps.check(|h| h.version = 2, VersionMismatch, 3);
    steps.check(|h| h.version = 0, VersionMismatch, 3);
    steps.check(|h| h.operation = 0, UnknownOperation, 0);
    steps.check(|h| h.operation = 4, UnknownOperation, 4);
    for (first, n_robots) in [(0, 0), (6, 1), (0, 7), (5, 2), (u32::MAX, 1), (1, u32::MAX)] {
        let range = |h: &mut StepRequest| (h.first_robot, h.n_robots) = (first, n_robots);
        steps.check(range, NoSuchRobot, 6);
    }
    steps.check(|h| h.n_moves = 5, WrongPathLength, 6);
    steps.check(|h| h.n_moves = u32::MAX, WrongPathLength, 6);
    steps.check(|h| h.flags = FLAG_FULL_COVERAGE, NotPermitted, 0);
    steps.check(|h| h.flags = 6, UnknownFlags, 6);
    steps.check(|h| h.n_robots = 3, WrongLength, 2 * 8 + 18);
    let observe = |h: &mut StepRequest| h.operation = Operation::Observe as u32;
    steps.check(observe, WrongLength, 0);
    let full = |h: &mut StepRequest| {
        observe(h);
        h.flags = FLAG_FULL_COVERAGE;
    };
    steps.check_body(full, &[], UnknownFlags, 1);
    let recall = |h: &mut StepRequest| h.operation = Operation::Recall as u32;
    steps.check(recall, WrongLength, 8);
    for length in [0, 1, 7, 8, 14, 19, 21, 100] {
        steps.check_body(|_| (), &vec![1; length], WrongLength, 8 + 12);
    }
    let mut paths = [1, 2, 3, 0, 1, 4, 0, 0, 0, 0, 0, 9];
    steps.check_body(|_| (), &step_body(&[1], &paths), BadMove, 13);
    paths[0] = 255;
    steps.check_body(|_| (), &step_body(&[1], &paths), BadMove, 8);
}

fn a_step_without_a_lease_changes_nothing(client: Client) {
    let steps = Table::lay(client);
    let (theirs, ended) = (steps.their_lease, steps.ended_lease);
    steps.check(|h| h.lease = 0, NoLease, 0);
    steps.check(|h| h.lease = u64::MAX, NoLease, 0);
    let last = |h: &mut StepRequest| h.first_robot = 4;
    steps.check(last, NoLease, 5);
    let stolen = |h: &mut StepRequest| {
        last(h);
        h.lease = theirs;
    };
    steps.check(stolen, NoLease, 4);
    let body = step_body(&[1, 0, 0], &[0; 36]);
    steps.check_body(|h| h.n_robots = 6, &body, NoLease, 5);
    let us = u64::from(steps.ours.pid());
    steps.check(|h| h.lease = ended, LeaseLost, us);
}

fn a_damaged_or_outdated_step_changes_nothing(client: Client) {
    let steps = Table::lay(client);
    let one = step_body(&[1], &[0; 6]);
    steps.check_body(|h| h.n_robots = 1, &one, Incomplete, 1);
    let second = |h: &mut StepRequest| (h.first_robot, h.n_robots) = (1, 1);
    steps.check_body(second, &one, Incomplete, 0);
    let both = step_body(&[1, 0], &[0; 18]);
    steps.check_body(|h| h.n_robots = 3, &both, Incomplete, 3);
    // A request for all robots that the client holds. It is refused, because another client holds a robot in one of
    // these worlds.
    let all = step_body(&[1, 0, 0], &[0; 30]);
    steps.check_body(|h| h.n_robots = 5, &all, Incomplete, 5);
    for (k, status) in [(0, Late), (2, Early), (u64::MAX, Early)] {
        steps.check_body(|_| (), &step_body(&[k], &[0; 12]), status, 1);
    }
    let second = step_body(&[1, 1], &[0; 24]);
    steps.check_body(|h| h.n_robots = 4, &second, Early, 0);
}

/// Requests that are refused. Each is followed by the status, the detail and words of the refusal. `OURS`, `THEIRS` and
/// `ENDED` stand for leases, `US` and `THEM` for processes.
const REFUSED: &str = r#"
 => Malformed 0 malformed control message
{ => Malformed 0 malformed control message
[] => Malformed 0 malformed control message
null => Malformed 0 malformed control message
{"op":"dance"} => Malformed 0 dance
{"op":"renew"} => Malformed 0 lease
{"op":"renew","lease":-1} => Malformed 0 -1
{"op":"renew","lease":1,"more":2} => Malformed 0 more
{"op":"hello","protocol":2,"client":""} => VersionMismatch 3 version mismatch
{"op":"acquire","first_robot":0,"n_robots":0} => NoSuchRobot 6 robots 0 to 5
{"op":"acquire","first_robot":6,"n_robots":1} => NoSuchRobot 6 robots 0 to 5
{"op":"acquire","first_robot":0,"n_robots":7} => NoSuchRobot 6 robots 0 to 5
{"op":"acquire","first_robot":4294967295,"n_robots":4294967295} => NoSuchRobot 6 robots 0 to 5
{"op":"acquire","first_robot":4294967296,"n_robots":1} => Malformed 0 4294967296
{"op":"acquire","first_robot":1,"n_robots":5} => Busy THEM acquire with "takeover": true
{"op":"renew","lease":12345} => NoLease 0 acquire it first
{"op":"renew","lease":THEIRS} => NoLease 5 no lease on robot 5
{"op":"renew","lease":ENDED} => LeaseLost US lease lost
{"op":"release","lease":12345} => NoLease 0 acquire it first
{"op":"release","lease":THEIRS} => NoLease 5 no lease on robot 5
{"op":"release","lease":ENDED} => LeaseLost US lease lost
{"op":"reset","lease":OURS,"worlds":[{"world":2}]} => Busy THEM held by pid
{"op":"reset","lease":OURS,"worlds":[{"world":0},{"world":2}]} => Busy THEM held by pid
{"op":"reset","lease":THEIRS,"worlds":[{"world":2}]} => NoLease 5 no lease on robot 5
{"op":"reset","lease":THEIRS,"worlds":[]} => NoLease 5 no lease on robot 5
{"op":"reset","lease":OURS,"worlds":[{"world":9}]} => NoSuchWorld 3 worlds 0 to 2
{"op":"reset","lease":OURS,"worlds":[{"world":0},{"world":0}]} => Malformed 0 world 0 twice
{"op":"reset","lease":ENDED,"worlds":[{"world":0}]} => LeaseLost US lease lost
{"op":"reset","lease":OURS,"worlds":[{"world":0,"seed":1.5}]} => Malformed 0 1.5
"#;

fn a_control_request_is_refused_for_one_reason_and_changes_nothing(client: Client) {
    let table = Table::lay(client);
    let refused = REFUSED
        .replace("OURS", &table.our_lease.to_string())
        .replace("THEIRS", &table.their_lease.to_string())
        .replace("ENDED", &table.ended_lease.to_string())
        .replace("US", &table.ours.pid().to_string())
        .replace("THEM", &table.theirs.pid().to_string());
    for line in refused.lines().skip(1) {
        let (text, refusal) = line.split_once(" => ").expect("request and refusal");
        let mut refusal = refusal.splitn(3, ' ');
        let mut next = || refusal.next().expect("status, detail and words");
        let (name, detail) = (next(), next().parse().expect("a detail"));
        let mut known = Status::ALL.into_iter();
        let status = known.find(|status| format!("{status:?}") == name);
        table.refused_control(text, status.expect(name), detail, next());
    }
}

fn another_version_is_refused_with_both_versions_and_what_to_do(client: Client) {
    let server = Server::start(SMALL);
    let wire = client.open(&server.instance);
    for version in [0, 2, u32::MAX] {
        let header = ControlRequest {
            version,
            ..control_header(5)
        };
        let (reply, payload) = wire.control(header, br#"{"op":"status"}"#);
        assert_eq!(reply.status, VersionMismatch as u32);
        let text = String::from_utf8(payload).expect("text");
        let has_advice = text.contains("the server 3") && text.contains("the same release");
        assert!(has_advice, "{text}");
    }
    assert_eq!(server.status().n_refused, 3);
}

fn a_step_answer_echoes_its_request_and_fits_its_payload(client: Client) {
    let server = Server::start(&format!("{SMALL} --worlds 3 --robots 2"));
    let wire = client.open(&server.instance);
    let lease = wire.acquire(0..6).lease;
    for (k, sequence) in [0, 1, u64::MAX].into_iter().enumerate() {
        for (operation, flags) in [(Operation::Step, 0), (Operation::Observe, FLAG_TEAM_FRAMES)] {
            let header = StepRequest {
                operation: operation as u32,
                sequence,
                first_robot: 2,
                n_robots: 4,
                flags,
                ..step_header(lease, N_MOVES)
            };
            let body = match operation {
                Operation::Step => step_body(&[k as u64; 2], &[3; 24]),
                _ => Vec::new(),
            };
            let (reply, payload) = wire.step(header, &body);
            assert_eq!(
                (reply.sequence, reply.first_robot, reply.n_robots),
                (sequence, 2, 4)
            );
            assert_eq!((reply.n_worlds, reply.flags), (2, flags));
            assert_eq!((reply.height, reply.width, reply.version), (5, 7, VERSION));
            let parts = split_step_payload(&reply, &payload).expect("a whole payload");
            assert_eq!((parts.worlds.len(), parts.robots.len()), (2, 4));
            let n_frames = if flags == 0 { 4 } else { 2 };
            assert_eq!(parts.frames.len(), n_frames * N_CELLS);
            assert!(parts.worlds.iter().all(|world| world.step == k as u64 + 1));
            assert!(reply.simulation_nanos > 0);
        }
    }
}

fn a_client_that_shuts_the_server_down_is_answered(client: Client) {
    let server = Server::start(SMALL);
    let wire = client.open(&server.instance);
    // The shared memory for answers disappears when the server ends. This request makes the client map the memory
    // before that.
    wire.ask(&Request::Status {});
    assert_eq!(wire.ask(&Request::Shutdown {}), Reply::Done);
    server.program.ends(0);
}
