//! What the next agent believes: what the last one left, or what the kept frames tell.

use crate::harness::{PATIENCE, Paths, Program, Server, eventually, fly, frames_until, path_of};
use crate::wire::{RawClient, Wire, step_body, step_header};
use agent::estimation::belief::Belief;
use agent::estimation::{BayesFilter, Estimator};
use agent::server::left_belief::{leave_belief, left_belief};
use protocol::Model;
use protocol::Move;
use protocol::control::{LeftPart, Reply, Request, WorldSeed};
use protocol::message::{FrameHeader, Operation, Status, StepRequest};
use protocol::observer::Observer;
use protocol::payload::split_step_payload;
use rustix::process::Signal;

/// A world with fires to find, and room for all their frames.
const FLAGS: &str = "--height 16 --width 16 --moves 12 --burn-in 3000 --seed 3";

/// Room for all frames of these tests.
const ALL: &str = "--history 100000";

/// What an agent says before it simulates one.
const FIRST_BELIEF: &str = "simulating the first belief";

fn run(server: &Server, flags: &[&str]) -> Program {
    let common = ["run", "--instance", server.instance.name()];
    Program::start("emberwatch-agent", &[&common[..], flags].concat())
}

/// The last paths flown until step `last`: as many as an observer is kept, more than 40.
fn paths(observer: &Observer<FrameHeader>, last: u64) -> Vec<Vec<Move>> {
    let samples = frames_until(observer, 0, last);
    let flown = samples.iter().filter(|it| it.header.result.step > 0);
    flown.map(path_of).collect()
}

/// What one agent flies that nobody disturbs.
fn undisturbed(n_steps: u64, policy: &[&str]) -> Vec<Vec<Move>> {
    let server = Server::start(FLAGS);
    let observer = Observer::frames(&server.instance).expect("observe");
    let steps = n_steps.to_string();
    let ended = run(&server, &[policy, &["--steps", &steps]].concat()).wait(4 * PATIENCE);
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    paths(&observer, n_steps)
}

#[test]
fn an_agent_that_takes_over_flies_as_the_other_would_have() {
    for policy in [
        ["--policy", "beam_exploit"],
        ["--policy", "shooting_explore"],
        ["--policy", "spatial_beam"],
    ] {
        let server = Server::start(&format!("{FLAGS} {ALL}"));
        let observer = Observer::frames(&server.instance).expect("observe");
        let first = run(&server, &[&policy[..], &["--steps", "0"]].concat());
        let acts = || server.step_of(0) > 20;
        assert!(eventually(PATIENCE, acts), "{}", first.stderr());
        let second = run(
            &server,
            &[&policy[..], &["--takeover", "--steps", "20"]].concat(),
        );
        let ended = first.wait(PATIENCE);
        assert_eq!(ended.code, Some(3), "{}", ended.stderr);
        let ended = second.wait(PATIENCE);
        assert_eq!(ended.code, Some(0), "{}", ended.stderr);
        for words in [FIRST_BELIEF, "the frames that were kept"] {
            assert!(ended.stderr.contains(words), "{}", ended.stderr);
        }
        // The third comes after a release, and finds the second's belief.
        let third = run(&server, &[&policy[..], &["--steps", "20"]].concat()).wait(PATIENCE);
        assert_eq!(third.code, Some(0), "{}", third.stderr);
        assert!(
            third.stderr.contains("the belief that was left"),
            "{}",
            third.stderr
        );
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
    let policy = ["--policy", "beam_exploit"];
    let server = Server::start(FLAGS);
    let observer = Observer::frames(&server.instance).expect("observe");
    let mut client = server.acquire(0..1);
    let at = client.observe(0..1).expect("observe")[0].world;
    let model = Model::wildfire();
    let shape = client.shape();
    let filter = BayesFilter::known(&model, Belief::from_initial(&model, shape));
    let kind = filter.expect("a filter").kind().expect("its kind");
    leave_belief(&mut client, 0, &at, &kind, b"not whole").expect("leave");
    client.release().expect("release");
    let ended = run(&server, &[&policy[..], &["--steps", "10"]].concat()).wait(PATIENCE);
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    assert!(ended.stderr.contains(FIRST_BELIEF), "{}", ended.stderr);
    assert_eq!(paths(&observer, 10), undisturbed(10, &policy));
}

#[test]
fn an_agent_that_finds_only_some_frames_makes_do_with_them() {
    let server = Server::start(&format!("{FLAGS} --history 5"));
    let steps = ["--policy", "random_walk", "--steps", "30"];
    assert_eq!(run(&server, &steps).wait(PATIENCE).code, Some(0));
    let ended = run(&server, &["--steps", "2"]).wait(PATIENCE);
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    assert!(
        ended.stderr.contains("first=26 step=30"),
        "{}",
        ended.stderr
    );
    let forgetful = Server::start(&format!("{FLAGS} --history 1"));
    assert_eq!(run(&forgetful, &steps).wait(PATIENCE).code, Some(0));
    let ended = run(&forgetful, &["--steps", "2"]).wait(PATIENCE);
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    assert!(!ended.stderr.contains("going on from"), "{}", ended.stderr);
}

#[test]
fn kept_frames_are_those_that_were_answered() {
    let server =
        Server::start("--height 5 --width 7 --moves 6 --burn-in 20 --worlds 2 --history 4");
    let mut client = server.acquire(0..2);
    let mut seen = vec![client.observe(0..2).expect("observe")];
    for k in 0..6 {
        let paths = Paths::new(k).take(6, 2);
        seen.push(client.step(0..2, &paths).expect("step"));
    }
    for step in 3..=6 {
        assert_eq!(
            client.recall(0..2, step).expect("recall"),
            seen[step as usize]
        );
    }
    let wire = Wire::open(&server.instance);
    let recall = |step, n_robots| {
        let header = StepRequest {
            operation: Operation::Recall as u32,
            n_robots,
            ..step_header(0, 0)
        };
        wire.step(header, &step_body(&vec![step; n_robots as usize], &[]))
    };
    for (step, nearest) in [(0, 3), (2, 3), (7, 6), (u64::MAX, 6)] {
        let (reply, payload) = recall(step, 2);
        assert_eq!(
            (reply.status, reply.detail),
            (Status::NotKept as u32, nearest),
            "{step}"
        );
        assert!(payload.is_empty());
    }
    let (reply, _) = recall(3, 3);
    assert_eq!(reply.status, Status::NoSuchRobot as u32);
    let seeds = [WorldSeed {
        world: 1,
        seed: Some(8),
    }];
    client.reset(&seeds).expect("reset");
    let (reply, _) = recall(3, 2);
    assert_eq!((reply.status, reply.detail), (Status::NotKept as u32, 0));
    let (reply, payload) = recall(6, 1);
    let parts = split_step_payload(&reply, &payload).expect("a whole payload");
    assert_eq!(parts.worlds[0].step, 6);
}

#[test]
fn a_belief_is_given_whole_for_its_step_alone_and_to_its_holder_s_robot_alone() {
    let server = Server::start("--height 5 --width 7 --moves 6 --burn-in 20 --worlds 2");
    let mut client = server.acquire(0..1);
    fly(&mut client, Paths::new(0).next(6));
    assert_eq!(left_belief(&mut client, 0, "kind").expect("none yet"), None);
    let bytes: Vec<u8> = (0..35 * 76 + 32_768).map(|n| n as u8).collect();
    let at = client.observe(0..1).expect("observe")[0].world;
    leave_belief(&mut client, 0, &at, "kind", &bytes).expect("leave");
    assert_eq!(
        left_belief(&mut client, 0, "kind").expect("belief"),
        Some(bytes.clone())
    );
    assert_eq!(
        left_belief(&mut client, 0, "another kind").expect("belief"),
        None
    );
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(1, 1).lease;
    let part = |lease, robot, step, offset, length, data: &str| {
        Request::LeaveBelief(LeftPart {
            lease,
            robot,
            episode: 0,
            step,
            kind: "kind".into(),
            offset,
            length,
            data: data.into(),
        })
    };
    let leave =
        |lease, robot, offset, length, data: &str| part(lease, robot, 0, offset, length, data);
    for (request, status) in [
        (leave(lease, 0, 0, 1, "AA=="), Status::NoLease),
        (leave(lease, 7, 0, 1, "AA=="), Status::NoSuchRobot),
        (leave(lease, 1, 0, 1, "A"), Status::Malformed),
        (leave(lease, 1, 1, 2, "AA=="), Status::Malformed),
        (leave(lease, 1, 0, 35_429, "AA=="), Status::Malformed),
        (leave(lease, 1, 0, 0, "AA=="), Status::Malformed),
        (part(lease, 1, 1, 0, 1, "AA=="), Status::Malformed),
        (
            leave(lease, 1, u64::MAX, u64::MAX, "AA=="),
            Status::Malformed,
        ),
    ] {
        let reply = wire.ask(&request);
        assert_eq!(reply.status(), status, "{request:?}: {reply:?}");
    }
    // Half a belief is none.
    assert_eq!(wire.ask(&leave(lease, 1, 0, 2, "AA==")), Reply::Done);
    let ask = Request::Belief {
        robot: 1,
        offset: 0,
    };
    assert_eq!(wire.ask(&ask).status(), Status::NotKept);
    // What is refused takes nothing away.
    let refused = wire.ask(&leave(lease, 1, 0, 1, "AAAA"));
    assert_eq!(refused.status(), Status::Malformed);
    assert_eq!(wire.ask(&leave(lease, 1, 1, 2, "AQ==")), Reply::Done);
    assert!(matches!(wire.ask(&ask), Reply::Belief { data, .. } if data == "AAE="));
    fly(&mut client, Paths::new(1).next(6));
    assert_eq!(
        left_belief(&mut client, 0, "kind").expect("another step"),
        None
    );
}

#[test]
fn an_agent_told_to_stop_leaves_its_belief() {
    let server = Server::start(FLAGS);
    let agent = run(&server, &["--steps", "0"]);
    let acts = || server.step_of(0) > 5;
    assert!(eventually(PATIENCE, acts), "{}", agent.stderr());
    agent.signal(Signal::TERM);
    assert_eq!(agent.wait(PATIENCE).code, Some(0));
    let mut connection = server.connect();
    let ask = Request::Belief {
        robot: 0,
        offset: 0,
    };
    let Reply::Belief { info, .. } = connection.control(&ask, PATIENCE).expect("a belief") else {
        panic!("expected a belief");
    };
    assert_eq!(info.length, 3 * 16 * 16 * 4);
    assert!(info.kind.starts_with("bayes_filter "), "{}", info.kind);
}
