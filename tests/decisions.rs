//! Agents that take decisions from a learner outside: same worlds, same plans, clear ends.

use crate::harness::{
    PATIENCE, Program, SMALL, Server, eventually, frames_until, new_instance, run, takeover,
};
use crate::learner::{Learner, decision, refusal, reply_to, start_agent, start_with_learner};
use crate::wire::control_header;
use agent::client::Client;
use protocol::channels::{ChannelError, Instance};
use protocol::decisions::{Decision, Reply, Request};
use protocol::message::{ControlRequest, Status};
use protocol::observer::Observer;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use rustix::process::Signal;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// A world in which something burns.
const BURNING: &str = "--height 32 --width 24 --moves 24 --burn-in 10000";

/// Names the instance to the child of a test.
const CHILD: &str = "EMBERWATCH_TEST_CHILD";

fn holder(server: &Server) -> Option<u32> {
    server.status().worlds[0].holder_pid
}

/// What does not depend on what the learner decided before the reset.
fn comparable(decision: Decision) -> Decision {
    Decision {
        episode: 0,
        ..decision
    }
}

fn episode(learner: &Learner, seed: u64, objectives: &[u64]) -> Vec<Decision> {
    let first = learner.reset(seed);
    let others = objectives
        .iter()
        .map(|&objective| learner.decide(objective));
    let all = [first].into_iter().chain(others);
    all.map(comparable).collect()
}

#[test]
fn hello_tells_what_can_be_decided() {
    let server = Server::start(&format!("{SMALL} --max-steps 9"));
    let (agent, learner) = start_with_learner(&server.instance, "");
    let info = learner.hello();
    assert_eq!((info.height, info.width, info.n_moves), (5, 7, 6));
    assert_eq!((info.protocol, info.world, info.max_steps), (1, 0, 9));
    assert_eq!(
        (info.pid, &*info.instance),
        (agent.pid(), server.instance.name())
    );
    assert_eq!(info.states, ["normal", "latent", "fire"]);
    assert_eq!(info.objectives, ["normal", "latent", "fire", "entropy"]);
    assert_eq!(info.planner, "beam");
    assert_eq!(info.summary.len(), learner.last().summary.len());
    assert_eq!(holder(&server), Some(agent.pid()));
}

#[test]
fn a_decision_is_the_step_that_an_agent_of_that_objective_makes() {
    let flags = format!("{BURNING} --seed 2");
    let (server, other) = (Server::start(&flags), Server::start(&flags));
    let observer = Observer::frames(&server.instance).expect("observe");
    frames_until(&observer, 0, 0);
    let name = server.instance.name();
    let policy = ["--policy", "beam_fire", "--steps", "30"];
    let ran = run(
        "emberwatch-agent",
        &[&["run", "--instance", name], &policy[..]].concat(),
        PATIENCE,
    );
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    let flown: Vec<_> = frames_until(&observer, 0, 30)
        .iter()
        .filter(|sample| sample.header.n_moves > 0)
        .map(|sample| sample.header.result)
        .collect();
    assert!(flown.iter().any(|result| result.reward > 0.0));
    let (_agent, learner) = start_with_learner(&other.instance, "");
    for seed in [None, Some(2)] {
        if let Some(seed) = seed {
            learner.reset(seed);
        }
        for result in &flown {
            let made = learner.decide(2);
            assert_eq!(
                (made.step, made.reward, made.n_hits, made.robot),
                (
                    result.step,
                    result.reward,
                    result.n_hits,
                    [result.row, result.col]
                )
            );
            assert_eq!(made.objective, Some(2));
            assert!(
                made.summary
                    .iter()
                    .all(|number| (0.0..=1.0).contains(number))
            );
        }
    }
}

#[test]
fn the_same_seed_and_objectives_give_the_same_decisions() {
    let server = Server::start(BURNING);
    let objectives = [2, 3, 0, 1, 2, 2, 3];
    for planner in ["beam", "shooting"] {
        let (agent, learner) = start_with_learner(
            &server.instance,
            &format!("--planner {planner} --shooting-samples 64"),
        );
        assert_eq!(learner.hello().planner, planner);
        let first = episode(&learner, 7, &objectives);
        assert_eq!(first[0].step, 0);
        assert_eq!((first[0].objective, first[0].reward), (None, 0.0));
        episode(&learner, 8, &[3, 3]);
        assert_eq!(episode(&learner, 7, &objectives), first);
        assert_ne!(episode(&learner, 7, &[3; 7]), first);
        agent.signal(Signal::TERM);
        assert_eq!(agent.wait(PATIENCE).code, Some(0));
    }
    let (_agent, learner) = start_with_learner(&server.instance, "--agent-seed 1");
    learner.reset(1);
    let unseeded = decision(learner.ask(&Request::Reset { seed: None }));
    assert_ne!(unseeded.seed, 1);
}

#[test]
fn what_is_no_decision_is_refused_and_changes_nothing() {
    let server = Server::start(BURNING);
    let (_agent, learner) = start_with_learner(&server.instance, "");
    learner.reset(3);
    let before = learner.decide(2);
    let (status, detail, message) = learner.refused(&Request::Decide { objective: 4 });
    assert_eq!((status, detail), (Status::BadObjective, 4));
    assert_eq!(message, "objective: expected 0 to 3, got 4");
    let most = Request::Decide {
        objective: u64::MAX,
    };
    assert_eq!(learner.refused(&most).0, Status::BadObjective);
    for text in [
        "",
        "{}",
        "[]",
        "null",
        r#"{"op":"dance"}"#,
        r#"{"op":"decide"}"#,
        r#"{"op":"decide","objective":-1}"#,
        r#"{"op":"decide","objective":1.5}"#,
        r#"{"op":"decide","objective":"fire"}"#,
        r#"{"op":"decide","objective":2,"objective":2}"#,
        r#"{"op":"decide","objective":2,"more":1}"#,
        r#"{"op":"last","more":1}"#,
        r#"{"op":"shutdown","now":true}"#,
        r#"{"op":"reset","seed":-1}"#,
        r#"{"op":"reset","seed":18446744073709551616}"#,
        r#"{"op":"hello","protocol":1}"#,
        r#"{"op":"hello","protocol":"1","client":"x"}"#,
    ] {
        let (status, detail, message) =
            refusal(learner.exchange(control_header(1), text.as_bytes()));
        assert_eq!((status, detail), (Status::Malformed, 0), "{text}");
        assert!(
            message.starts_with("malformed control message: "),
            "{message}"
        );
    }
    let hello = br#"{"op":"hello","protocol":2,"client":"x"}"#;
    assert_mismatch(learner.exchange(control_header(1), hello));
    let header = ControlRequest {
        version: 9,
        ..control_header(1)
    };
    assert_mismatch(learner.exchange(header, br#"{"op":"last"}"#));
    assert_eq!(learner.last(), before);
    assert_eq!(server.observe(0).0.step, 1);
}

fn assert_mismatch(reply: Reply) {
    let (status, detail, message) = refusal(reply);
    assert_eq!((status, detail), (Status::VersionMismatch, 1), "{message}");
}

#[test]
fn random_and_oversized_messages_are_refused_and_change_nothing() {
    let server = Server::start(SMALL);
    let (agent, learner) = start_with_learner(&server.instance, "");
    learner.reset(3);
    let before = learner.decide(2);
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    for _ in 0..3000 {
        let mut bytes = vec![0; rng.random_range(0..200)];
        rng.fill_bytes(&mut bytes);
        let header = ControlRequest {
            version: if rng.random_ratio(1, 9) {
                rng.random()
            } else {
                1
            },
            reserved: rng.random(),
            sequence: rng.random(),
            listener_low: rng.random(),
            listener_high: rng.random(),
        };
        if rng.random_ratio(1, 9) {
            drop(learner.send(header, &bytes));
        } else {
            refusal(learner.exchange(header, &bytes));
        }
    }
    for length in [4097, 100_000, (1 << 20) + 1] {
        let reply = learner.exchange(control_header(1), &vec![b' '; length]);
        assert_eq!(refusal(reply).0, Status::Malformed, "{length}");
    }
    let nested = "[".repeat(100_000);
    refusal(learner.exchange(control_header(1), nested.as_bytes()));
    assert_eq!(learner.last(), before, "{}", agent.stderr());
}

#[test]
fn after_a_timeout_last_tells_whether_the_decision_was_made() {
    let server = Server::start(SMALL);
    let (_agent, learner) = start_with_learner(&server.instance, "");
    let before = learner.reset(3);
    server.program.signal(Signal::STOP);
    drop(learner.send(control_header(1), br#"{"op":"decide","objective":2}"#));
    server.program.signal(Signal::CONT);
    let last = learner.last();
    // Given up before or after the agent took it.
    assert!(
        last == before || (last.step, last.objective) == (1, Some(2)),
        "{last:?}"
    );
    let next = learner.decide(2);
    assert_eq!(next.step, last.step + 1);
    assert_eq!(learner.last(), next);
}

#[test]
fn a_truncated_episode_is_over_until_the_next_reset() {
    let server = Server::start(&format!("{SMALL} --max-steps 2"));
    let (_agent, learner) = start_with_learner(&server.instance, "");
    learner.reset(3);
    assert!(!learner.decide(2).truncated);
    let last = learner.decide(2);
    assert!(last.truncated && !last.terminated);
    let (status, detail, message) = learner.refused(&Request::Decide { objective: 2 });
    assert_eq!((status, detail), (Status::EpisodeOver, 0), "{message}");
    assert_eq!(learner.last(), last);
    assert_eq!(learner.reset(3).step, 0);
    assert_eq!(learner.decide(2).step, 1);
}

#[test]
fn a_second_agent_is_refused_whatever_it_asks_for() {
    let server = Server::start(SMALL);
    let (agent, learner) = start_with_learner(&server.instance, "");
    let words = format!("served already, by pid {}", agent.pid());
    for flags in ["", "--takeover"] {
        let second = start_agent(&server.instance, flags).wait(PATIENCE);
        assert_eq!(second.code, Some(1), "{}", second.stderr);
        assert!(second.stderr.contains(&words), "{}", second.stderr);
    }
    learner.decide(2);
    agent.signal(Signal::KILL);
    agent.wait(PATIENCE);
    let (_agent, next) = start_with_learner(&server.instance, "");
    assert_eq!(
        next.last().step,
        1,
        "the next goes on where the first was killed"
    );
    assert_eq!(next.decide(2).step, 2);
}

#[test]
fn a_lease_does_not_expire_while_nobody_decides() {
    let server = Server::start(&format!("{SMALL} --lease-millis 300"));
    let (agent, learner) = start_with_learner(&server.instance, "");
    let start = Instant::now();
    while start.elapsed() < Duration::from_secs(1) {
        assert_eq!(holder(&server), Some(agent.pid()));
        learner.last();
    }
    std::thread::sleep(Duration::from_secs(1));
    assert_eq!(learner.decide(2).step, 1, "{}", agent.stderr());
}

#[test]
fn an_agent_that_is_told_to_end_releases_its_world_first() {
    let server = Server::start(SMALL);
    let (agent, learner) = start_with_learner(&server.instance, "");
    assert_eq!(learner.ask(&Request::Shutdown {}), Reply::Done);
    assert_eq!(holder(&server), None);
    drop(learner);
    assert_eq!(agent.wait(PATIENCE).code, Some(0));
    for signal in [Signal::TERM, Signal::INT] {
        let (agent, _learner) = start_with_learner(&server.instance, "");
        agent.signal(signal);
        let ended = agent.wait(Duration::from_secs(2));
        assert_eq!(ended.code, Some(0), "{}", ended.stderr);
        assert_eq!(holder(&server), None);
    }
    let error = Learner::try_open(&server.instance).err();
    assert!(
        matches!(error, Some(ChannelError::NoAgent { world: 0, .. })),
        "{error:?}"
    );
}

#[test]
fn an_agent_ends_with_the_process_that_it_was_started_for() {
    let server = Server::start(SMALL);
    let keeper = Command::new("sleep").arg("60").spawn();
    let mut keeper = keeper.expect("start a keeper");
    let (agent, _learner) =
        start_with_learner(&server.instance, &format!("--exit-with {}", keeper.id()));
    keeper.kill().expect("kill the keeper");
    let ended = agent.wait(Duration::from_secs(2));
    keeper.wait().expect("wait for the keeper");
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    assert_eq!(holder(&server), None);
}

#[test]
fn an_agent_whose_server_is_killed_says_so_and_ends() {
    for decides in [false, true] {
        let server = Server::start(SMALL);
        let (agent, learner) = start_with_learner(&server.instance, "");
        learner.reset(3);
        if decides {
            server.program.signal(Signal::STOP);
            let header = control_header(1);
            let pending = learner.send(header, br#"{"op":"decide","objective":2}"#);
            server.kill();
            let (status, _, message) = refusal(reply_to(&pending, header));
            assert_eq!(status, Status::AgentEnds);
            assert!(
                message.starts_with("the agent ends: the server"),
                "{message}"
            );
        } else {
            server.kill();
        }
        drop(learner);
        let ended = agent.wait(PATIENCE);
        assert_eq!(ended.code, Some(1), "{}", ended.stderr);
        assert!(ended.stderr.contains("is gone"), "{}", ended.stderr);
    }
}

#[test]
fn an_agent_whose_world_is_taken_says_so_and_ends_with_code_3() {
    let server = Server::start(&format!("{SMALL} --lease-millis 3000"));
    for decides in [true, false] {
        let (agent, learner) = start_with_learner(&server.instance, "--takeover");
        learner.decide(2);
        let before = server.observe(0).0;
        let _thief = Client::acquire(&server.instance, &takeover(0..1)).expect("take over");
        if decides {
            let (status, detail, _) = learner.refused(&Request::Decide { objective: 2 });
            assert_eq!(status, Status::LeaseLost);
            assert_eq!(detail, u64::from(std::process::id()));
        }
        drop(learner);
        let ended = agent.wait(PATIENCE);
        assert_eq!(ended.code, Some(3), "{}", ended.stderr);
        assert!(
            ended.stderr.contains("lease lost to pid"),
            "{}",
            ended.stderr
        );
        assert_eq!(server.observe(0).0, before, "it stepped nothing");
    }
}

#[test]
fn a_world_goes_from_agent_to_agent_in_the_middle_of_an_episode() {
    let server = Server::start(SMALL);
    let name = server.instance.name();
    let flags = ["run", "--instance", name, "--policy", "random_walk"];
    let first = Program::start("emberwatch-agent", &flags);
    let acts = || server.observe(0).0.step > 3;
    assert!(eventually(PATIENCE, acts), "{}", first.stderr());
    let refused = start_agent(&server.instance, "").wait(PATIENCE);
    let words = format!("busy: held by pid {}", first.pid());
    assert!(refused.stderr.contains(&words), "{}", refused.stderr);
    let (_agent, learner) = start_with_learner(&server.instance, "--takeover");
    assert_eq!(first.wait(PATIENCE).code, Some(3));
    let (result, _) = server.observe(0);
    let last = learner.last();
    assert_eq!((last.step, last.reward), (result.step, result.reward));
    assert_eq!(last.objective, None);
    assert_eq!(learner.decide(3).step, result.step + 1);
}

#[test]
fn a_model_that_is_not_the_servers_is_refused() {
    let server = Server::start(&format!("{SMALL} --reveal-model false"));
    let check = |flags: &str, words: &str| {
        let ended = start_agent(&server.instance, flags).wait(PATIENCE);
        assert_eq!(ended.code, Some(1), "{}", ended.stderr);
        assert!(ended.stderr.contains(words), "{}", ended.stderr);
    };
    check("", "does not reveal its model: expected --model FILE");
    check("--world 1", "no such world: the server has worlds 0 to 0");
    let folder = tempfile::TempDir::new().expect("a folder");
    let path = folder.path().join("blind.toml");
    std::fs::write(&path, model_of_two_observations()).expect("write a model");
    let flag = format!("--model {}", path.display());
    check(&flag, "model: expected the server's 3 observations, got 2");
}

/// The wildfire, as a sensor sees it that takes smoke for nothing.
fn model_of_two_observations() -> String {
    let mut file = protocol::Model::wildfire().file().clone();
    file.observations.remove(1);
    for state in &mut file.states {
        let smoke = state.observed_as.remove(1);
        state.observed_as[0] += smoke;
    }
    toml::to_string(&file).expect("models serialise")
}

#[test]
fn killed_learners_disturb_nobody_and_use_up_no_limit() {
    let server = Server::start(SMALL);
    let (agent, learner) = start_with_learner(&server.instance, "");
    for _ in 0..20 {
        let before = learner.last().step;
        let mut child = start_child(&server.instance);
        let decides = eventually(PATIENCE, || learner.last().step > before + 2);
        child.kill().expect("kill the learner");
        child.wait().expect("wait for it");
        assert!(decides, "{}", agent.stderr());
    }
    let connects = || Learner::try_open(&server.instance).is_ok();
    assert!(eventually(PATIENCE, connects), "{}", agent.stderr());
    let before = learner.last().step;
    assert_eq!(learner.decide(2).step, before + 1);
}

/// This program again, as a learner that decides without end.
fn start_child(instance: &Instance) -> std::process::Child {
    let mut command = Command::new(std::env::current_exe().expect("this program"));
    let test = "decisions::a_learner_to_be_killed";
    command.args(["--exact", test, "--ignored"]);
    command.env(CHILD, instance.name()).stdout(Stdio::null());
    command.spawn().expect("start a learner")
}

#[test]
#[ignore = "the child of another test"]
fn a_learner_to_be_killed() {
    let Ok(name) = std::env::var(CHILD) else {
        return;
    };
    let instance = Instance::new(&name).expect("a plain name");
    let mut learner = None;
    eventually(PATIENCE, || {
        learner = Learner::try_open(&instance).ok();
        learner.is_some()
    });
    let learner = learner.expect("connected");
    loop {
        learner.decide(2);
    }
}

#[test]
fn nobody_to_decide_for_is_told_from_no_server() {
    let server = Server::start(SMALL);
    let error = Learner::try_open(&server.instance).err().expect("no agent");
    let words = format!("serve-decisions --instance {}", server.instance.name());
    assert!(error.to_string().contains(&words), "{error}");
    let error = Learner::try_open(&new_instance()).err();
    assert!(
        matches!(error, Some(ChannelError::NoAgent { .. })),
        "{error:?}"
    );
}
