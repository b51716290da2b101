//! Tests of an agent that takes over: it starts from the former agent's stored belief, or from the kept frames.

use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::{BayesFilter, Handover};
use emberwatch_protocol::control::{LeftPart, Reply, Request};
use emberwatch_protocol::message::{FrameHeader, Status};
use emberwatch_protocol::observer::Observer;
use emberwatch_protocol::{Client, Model, Move};
use tests::harness::{PATIENCE, Paths, Program, SMALL, Server, frames_until, path_of, send_paths};
use tests::wire::{RawClient, Wire};

/// A world with many fires.
const FLAGS: &str =
    "--model wildfire-small --height 16 --width 16 --moves 12 --burn-in 300 --seed 3";

/// A history long enough for all frames of these tests.
const ALL: &str = "--history 100000";

/// The line that an agent logs if it must compute its first belief by simulation.
const FIRST_BELIEF: &str = "simulating the first belief";

fn run(server: &Server, flags: &str) -> Program {
    Program::agent(&server.instance, flags)
}

/// Returns a request for the stored belief of a robot.
fn ask(robot: u32) -> Request {
    Request::Belief { robot, offset: 0 }
}

/// Returns the paths flown up to step `last`, starting with the oldest step in the observer's buffer, which holds more
/// than 40 steps.
fn paths(observer: &Observer<FrameHeader>, last: u64) -> Vec<Vec<Move>> {
    let samples = frames_until(observer, 0, last);
    let flown = samples.iter().filter(|it| it.header.result.step > 0);
    flown.map(path_of).collect()
}

/// Returns the paths of an agent that acts without a handover.
fn undisturbed(n_steps: u64, policy: &str) -> Vec<Vec<Move>> {
    let server = Server::start(FLAGS);
    let observer = Observer::frames(&server.instance).expect("observe");
    let agent = run(&server, &format!("{policy} --steps {n_steps}"));
    agent.wait(4 * PATIENCE).check(0);
    paths(&observer, n_steps)
}

#[test]
fn an_agent_that_takes_over_flies_as_the_other_would_have() {
    for policy in [
        "known/shooting/explore",
        "known+spatial/beam/exploit",
        "known/options/rule",
    ] {
        let policy = format!("--policy {policy}");
        let server = Server::start(&format!("{FLAGS} {ALL}"));
        let observer = Observer::frames(&server.instance).expect("observe");
        let first = run(&server, &format!("{policy} --steps 0"));
        first.until(|| server.step_of(0) > 20);
        let second = run(&server, &format!("{policy} --takeover --steps 0"));
        first.ends(3);
        let taken = server.step_of(0);
        second.until(|| server.step_of(0) > taken + 20);
        let second = second.finish();
        second.check_says(FIRST_BELIEF);
        second.check_says("the frames that the server keeps");
        // The second agent, when a signal ends it, leaves its belief, and releases its robot.
        let third = run(&server, &format!("{policy} --steps 20")).ends(0);
        third.check_says("the belief was taken over from the former agent");
        assert!(!third.stderr.contains(FIRST_BELIEF), "{}", third.stderr);
        let last = server.step_of(0);
        assert_eq!(
            paths(&observer, last),
            undisturbed(last, &policy),
            "{policy:?}"
        );
    }
}

#[test]
fn an_agent_that_finds_a_damaged_belief_begins_with_its_own() {
    let policy = "--policy known/beam/exploit";
    let server = Server::start(FLAGS);
    let observer = Observer::frames(&server.instance).expect("observe");
    let mut client = server.acquire(0..1);
    let at = client.observe(0..1).expect("observe")[0].world;
    let model = Model::built_in("wildfire-small").expect("built in");
    let shape = client.shape();
    let filter = BayesFilter::known(&model, Belief::from_initial(&model, shape), false);
    let kind = filter.expect("a filter").kind();
    let kind = format!("{kind}; freshness [H, W] as f32, rewards, paths");
    client
        .leave_belief(0, &at, &kind, b"not whole")
        .expect("leave");
    client.release().expect("release");
    let ended = run(&server, &format!("{policy} --steps 10")).ends(0);
    ended.check_says(FIRST_BELIEF);
    assert_eq!(paths(&observer, 10), undisturbed(10, policy));
}

#[test]
fn an_agent_that_finds_only_some_frames_makes_do_with_them() {
    let server = Server::start(&format!("{FLAGS} --history 5"));
    let walk = "--policy random_walk --steps 30";
    run(&server, walk).ends(0);
    let ended = run(&server, "--steps 2").ends(0);
    ended.check_says("first=26 step=30");
    let forgetful = Server::start(&format!("{FLAGS} --history 1"));
    run(&forgetful, walk).ends(0);
    let ended = run(&forgetful, "--steps 2").ends(0);
    assert!(!ended.stderr.contains("the belief was"), "{}", ended.stderr);
}

#[test]
fn a_left_belief_goes_whole_to_its_robot_and_step_only() {
    let server = Server::start(&format!("{SMALL} --worlds 2"));
    let mut client = server.acquire(0..1);
    send_paths(&mut client, Paths::new(0).next(6));
    let left = |client: &mut Client, kind| client.left_belief(0, kind).expect("asked");
    assert_eq!(left(&mut client, "kind"), None);
    let bytes: Vec<u8> = (0..35 * 76 + 32_768).map(|n| n as u8).collect();
    let at = client.observe(0..1).expect("observe")[0].world;
    client.leave_belief(0, &at, "kind", &bytes).expect("leave");
    assert_eq!(left(&mut client, "kind"), Some(bytes));
    assert_eq!(left(&mut client, "another kind"), None);
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(1..2).lease;
    let leave = |robot, step, offset, length, data: &str| {
        wire.ask(&Request::LeaveBelief(LeftPart {
            lease,
            robot,
            episode: 0,
            step,
            kind: "kind".into(),
            offset,
            length,
            data: data.into(),
        }))
    };
    for (robot, step, offset, length, data, status) in [
        (0, 0, 0, 1, "AA==", Status::NoLease),
        (7, 0, 0, 1, "AA==", Status::NoSuchRobot),
        (1, 0, 0, 1, "A", Status::Malformed),
        (1, 0, 1, 2, "AA==", Status::Malformed),
        (1, 0, 0, 35_429, "AA==", Status::Malformed),
        (1, 0, 0, 0, "AA==", Status::Malformed),
        (1, 1, 0, 1, "AA==", Status::Malformed),
        (1, 0, u64::MAX, u64::MAX, "AA==", Status::Malformed),
    ] {
        let reply = leave(robot, step, offset, length, data);
        assert_eq!(
            reply.status(),
            status,
            "{robot} {step} {offset} {length} {data}"
        );
    }
    // An incomplete belief is not returned, and a part that is refused changes nothing.
    assert_eq!(leave(1, 0, 0, 2, "AA=="), Reply::Done);
    assert_eq!(wire.ask(&ask(1)).status(), Status::NotKept);
    assert_eq!(leave(1, 0, 0, 1, "AAAA").status(), Status::Malformed);
    assert_eq!(leave(1, 0, 1, 2, "AQ=="), Reply::Done);
    assert!(matches!(wire.ask(&ask(1)), Reply::Belief { data, .. } if data == "AAE="));
    send_paths(&mut client, Paths::new(1).next(6));
    assert_eq!(left(&mut client, "kind"), None, "another step");
}

#[test]
fn an_agent_that_lacks_something_takes_no_robot() {
    let server = Server::start(SMALL);
    let mut holder = server.acquire(0..1);
    for (policy, words) in [
        ("learned_beam", "needs --checkpoint FILE"),
        ("oracle_beam", "needs the truth channel"),
    ] {
        let flags = format!("--policy {policy} --takeover --steps 1");
        run(&server, &flags).ends(1).check_says(words);
        send_paths(&mut holder, Paths::new(1).next(6));
    }
}
