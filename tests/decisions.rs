//! Agents that take decisions from a learner outside: same worlds, same plans, clear refusals.

use emberwatch_protocol::channels::ChannelError;
use emberwatch_protocol::decisions::{Decision, Reply, Request};
use emberwatch_protocol::message::{ControlRequest, Status, VERSION};
use emberwatch_protocol::observer::Observer;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use rustix::process::Signal;
use tests::harness::{Program, SMALL, Server, frames_until, new_instance, seed, seen_in};
use tests::learner::{
    Learner, decide, decisions, features, refusal, reset, start_agent, start_at, start_with_learner,
};
use tests::wire::control_header;

/// A world in which something burns.
const BURNING: &str = "--height 32 --width 24 --moves 24 --burn-in 10000";

/// The objective to exploit.
const EXPLOIT: u64 = 0;

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
    assert_eq!((info.protocol, info.max_steps), (VERSION, 9));
    assert_eq!((info.first_world, info.n_worlds), (0, 1));
    assert_eq!(info.pid, agent.pid());
    assert_eq!(info.instance, server.instance.name());
    assert_eq!(info.states, ["normal", "latent", "fire"]);
    assert_eq!(info.objectives.len(), 8);
    assert_eq!(info.objectives[0], "exploit");
    assert_eq!((&*info.estimator, info.features.len()), ("known_model", 26));
    assert_eq!(features(&learner.last()).len(), 8 * 26);
    assert_eq!(server.status().worlds[0].holder_pids, [Some(agent.pid())]);
}

#[test]
fn exploiting_makes_the_steps_of_a_policy_that_does() {
    assert_the_same_steps("known_exploit", "known_model");
}

#[test]
fn decisions_are_made_on_the_spatial_belief() {
    assert_the_same_steps("spatial_exploit", "spatial_filter");
}

/// A policy that exploits makes the steps of decisions to exploit with its estimator.
fn assert_the_same_steps(policy: &str, estimator: &str) {
    let flags = format!("{BURNING} --seed 2");
    let (server, other) = (Server::start(&flags), Server::start(&flags));
    let observer = Observer::frames(&server.instance).expect("observe");
    frames_until(&observer, 0, 0);
    let flags = format!("--policy {policy} --steps 30");
    Program::agent(&server.instance, &flags).ends(0);
    let flown: Vec<_> = frames_until(&observer, 0, 30)
        .iter()
        .filter(|sample| sample.header.result.step > 0)
        .map(seen_in)
        .collect();
    assert!(flown.iter().any(|(world, ..)| world.reward > 0.0));
    let flags = format!("--estimator {estimator}");
    let (_agent, learner) = start_with_learner(&other.instance, &flags);
    assert_eq!(learner.hello().estimator, estimator);
    for seed in [None, Some(2)] {
        if let Some(seed) = seed {
            learner.reset(seed);
        }
        for (world, robot, _) in &flown {
            let made = learner.decide(EXPLOIT);
            assert_eq!((made.step, made.reward), (world.step, world.reward));
            assert_eq!(made.n_hits, world.n_hits);
            assert_eq!(made.robot, [robot.row, robot.col]);
            assert_eq!(made.objective, Some(EXPLOIT));
        }
    }
}

#[test]
fn features_say_what_the_paths_will_find_and_what_the_last_one_found() {
    let server = Server::start(&format!("{BURNING} --seed 2"));
    let (_agent, learner) = start_with_learner(&server.instance, "");
    let info = learner.hello();
    let feature = |made: &Decision, name: &str, objective: usize| {
        let at = info.features.iter().position(|known| known == name);
        features(made)[objective * info.features.len() + at.expect(name)]
    };
    let first = learner.reset(2);
    for (objective, name) in info.objectives.iter().enumerate() {
        for which in 0..info.objectives.len() {
            let is_it = f32::from(u8::from(which == objective));
            assert_eq!(feature(&first, &format!("is_{name}"), which), is_it);
        }
        assert_eq!(feature(&first, "n_paths", objective), 0.0);
    }
    let next = learner.decide(EXPLOIT);
    for objective in 0..info.objectives.len() {
        assert_eq!(feature(&next, "n_paths", objective), 1.0 / 200.0);
        let reward = feature(&next, "last_reward", objective);
        assert_eq!(reward, next.reward as f32 / info.n_moves as f32);
    }
    // No path promises more of what pays than the one that is planned for it, nor more that is new.
    let most = |name: &str| {
        let values = (0..info.objectives.len()).map(|objective| feature(&next, name, objective));
        values.fold(0.0, f32::max)
    };
    let coverage = info.objectives.iter().position(|name| name == "coverage");
    let novelty = feature(&next, "path_novelty", coverage.expect("an option"));
    assert!(novelty > 0.9 * most("path_novelty"));
    assert!(feature(&next, "path_probability", 0) > 0.9 * most("path_probability"));
}

#[test]
fn the_same_seed_and_objectives_give_the_same_decisions() {
    let server = Server::start(BURNING);
    let objectives = [2, 3, 0, 7, 5, 6, 3];
    let (agent, learner) = start_with_learner(&server.instance, "");
    let first = episode(&learner, 7, &objectives);
    assert_eq!(first[0].step, 0);
    assert_eq!((first[0].objective, first[0].reward), (None, 0.0));
    episode(&learner, 8, &[3, 3]);
    assert_eq!(episode(&learner, 7, &objectives), first);
    assert_ne!(episode(&learner, 7, &[3; 7]), first);
    agent.finish();
    let (_agent, learner) = start_with_learner(&server.instance, "--agent-seed 1");
    learner.reset(1);
    let worlds = vec![seed(0, None)];
    let unseeded = decisions(learner.ask(&Request::Reset { worlds }));
    assert_ne!(unseeded[0].seed, 1);
}

#[test]
fn many_worlds_are_decided_for_as_each_alone() {
    let server = || Server::start(&format!("{BURNING} --worlds 4"));
    let (together, alone) = (server(), server());
    let (agent, learner) = start_at(&together.instance, 1, "--worlds 3");
    let info = learner.hello();
    assert_eq!((info.first_world, info.n_worlds), (1, 3));
    let holders = together.status().worlds.into_iter();
    let holders: Vec<_> = holders.map(|world| world.holder_pids[0]).collect();
    let held = Some(agent.pid());
    assert_eq!(holders, [None, held, held, held]);
    let mut rows = vec![
        learner.last_of_all(),
        learner.reset_some(&[(3, 7), (1, 9)]),
        learner.decide_all(&[Some(2), Some(3), Some(0)]),
        learner.decide_all(&[Some(2), None, Some(3)]),
        learner.decide_all(&[None; 3]),
        learner.reset_some(&[(2, 5)]),
    ];
    rows.extend((0..5).map(|_| learner.decide_all(&[None, Some(2), Some(1)])));
    rows.push(learner.decide_all(&[Some(2); 3]));
    for (index, world) in (1..4).enumerate() {
        let (_agent, learner) = start_at(&alone.instance, world, "");
        let mut before = None;
        for row in &rows {
            let wanted = &row[index];
            let moves = before != Some(wanted);
            let made = match wanted.objective.filter(|_| moves) {
                Some(objective) => learner.decide(objective),
                None if moves && before.is_some() => {
                    learner.reset_some(&[(world, wanted.seed)]).remove(0)
                }
                None => learner.last(),
            };
            assert_eq!(made, *wanted, "world {world}");
            before = Some(wanted);
        }
        let steps = [3, 6, 8][index];
        assert_eq!(rows.last().map(|row| row[index].step), Some(steps));
    }
}

#[test]
fn what_some_worlds_cannot_do_is_refused_for_all() {
    use Status::{BadObjective, EpisodeOver, Malformed, NoSuchWorld};
    let server = Server::start(&format!("{SMALL} --worlds 4 --max-steps 2"));
    let (_agent, learner) = start_at(&server.instance, 1, "--worlds 3");
    let first = learner.decide_all(&[None, None, Some(2)]);
    assert!(!first[2].truncated);
    learner.decide_all(&[None, None, Some(2)]);
    let before = learner.last_of_all();
    assert!(before[2].truncated && !before[2].terminated);
    let malformed = "malformed control message: ";
    let count = format!("{malformed}objectives: expected 3, one a world, got");
    let objective = "objective: expected 0 to 7, got";
    let no_world = "no such world: the agent has worlds 1 to 3, got";
    let twice = format!("{malformed}reset: expected each world once, got world 2 twice");
    let over = "world 3 was truncated: reset it first";
    let high = decide(&[Some(2), Some(8), None]);
    let highest = decide(&[Some(2), None, Some(u64::MAX)]);
    let ended = decide(&[Some(2), None, Some(2)]);
    let [below, above] = [0, 4].map(|world| reset(&[(1, 5), (world, 5)]));
    for (request, status, detail, words) in [
        (decide(&[]), Malformed, 0, format!("{count} 0")),
        (decide(&[Some(2); 4]), Malformed, 0, format!("{count} 4")),
        (high, BadObjective, 8, format!("{objective} 8 for world 2")),
        (
            highest,
            BadObjective,
            8,
            format!("{objective} {} for world 3", u64::MAX),
        ),
        (decide(&[Some(2); 3]), EpisodeOver, 3, over.into()),
        (ended, EpisodeOver, 3, over.into()),
        (below, NoSuchWorld, 3, format!("{no_world} 0")),
        (above, NoSuchWorld, 3, format!("{no_world} 4")),
        (reset(&[(1, 5), (2, 5), (2, 6)]), Malformed, 0, twice),
    ] {
        assert_eq!(learner.refused(&request), (status, detail, words));
        assert_eq!(learner.last_of_all(), before, "{request:?}");
    }
    let steps = [1, 2, 3].map(|world| server.step_of(world));
    assert_eq!(steps, [0, 0, 2]);
    assert_eq!(learner.reset_some(&[]), before);
    let after = learner.decide_all(&[Some(2), Some(2), None]);
    assert!(after.iter().map(|made| made.step).eq([1, 1, 2]));
    assert_eq!(learner.reset_some(&[(3, 5)])[2].step, 0);
    assert_eq!(learner.decide_all(&[None, None, Some(2)])[2].step, 1);
}

#[test]
fn what_is_no_decision_is_refused_and_changes_nothing() {
    let server = Server::start(BURNING);
    let (_agent, learner) = start_with_learner(&server.instance, "");
    learner.reset(3);
    let before = learner.decide(2);
    for text in [
        "",
        "{}",
        "[]",
        "null",
        r#"{"op":"dance"}"#,
        r#"{"op":"decide"}"#,
        r#"{"op":"decide","objectives":2}"#,
        r#"{"op":"decide","objectives":[-1]}"#,
        r#"{"op":"decide","objectives":[1.5]}"#,
        r#"{"op":"decide","objectives":["fire"]}"#,
        r#"{"op":"decide","objectives":[[2]]}"#,
        r#"{"op":"decide","objectives":[2],"objectives":[2]}"#,
        r#"{"op":"decide","objectives":[2],"more":1}"#,
        r#"{"op":"last","more":1}"#,
        r#"{"op":"shutdown","now":true}"#,
        r#"{"op":"reset"}"#,
        r#"{"op":"reset","worlds":[0]}"#,
        r#"{"op":"reset","worlds":[{"world":0,"seed":-1}]}"#,
        r#"{"op":"reset","worlds":[{"world":0,"seed":18446744073709551616}]}"#,
        r#"{"op":"reset","worlds":[{"world":0},{"world":0}]}"#,
        r#"{"op":"hello","protocol":2}"#,
        r#"{"op":"hello","protocol":"1","client":"x"}"#,
    ] {
        let reply = learner.exchange(control_header(1), text.as_bytes());
        let (status, detail, message) = refusal(reply);
        assert_eq!((status, detail), (Status::Malformed, 0), "{text}");
        let is_named = message.starts_with("malformed control message: ");
        assert!(is_named, "{message}");
    }
    let hello = br#"{"op":"hello","protocol":3,"client":"x"}"#;
    assert_mismatch(learner.exchange(control_header(1), hello));
    let header = ControlRequest {
        version: 9,
        ..control_header(1)
    };
    assert_mismatch(learner.exchange(header, br#"{"op":"last"}"#));
    assert_eq!(learner.last(), before);
    assert_eq!(server.step_of(0), 1);
}

fn assert_mismatch(reply: Reply) {
    let (status, detail, message) = refusal(reply);
    let expected = (Status::VersionMismatch, VERSION.into());
    assert_eq!((status, detail), expected, "{message}");
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
        let version = if rng.random_ratio(1, 9) {
            rng.random()
        } else {
            1
        };
        let header = ControlRequest {
            version,
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
    drop(learner.send(control_header(1), br#"{"op":"decide","objectives":[2]}"#));
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
fn a_model_that_is_not_the_servers_is_refused() {
    let server = Server::start(&format!("{SMALL} --reveal-model false"));
    let check = |flags: &str, words: &str| {
        start_agent(&server.instance, flags)
            .ends(1)
            .check_says(words);
    };
    check("", "does not reveal its model: expected --model FILE");
    for worlds in [
        "--world 1",
        "--worlds 2",
        "--world 4294967295 --worlds 1024",
    ] {
        check(worlds, "no such world: the server has worlds 0 to 0");
    }
    let folder = tempfile::TempDir::new().expect("a folder");
    let path = folder.path().join("blind.toml");
    std::fs::write(&path, model_of_two_observations()).expect("write a model");
    let flag = format!("--model {}", path.display());
    check(&flag, "model: expected the server's 3 observations, got 2");
}

/// The wildfire, as a sensor sees it that takes smoke for nothing.
fn model_of_two_observations() -> String {
    let mut file = emberwatch_protocol::Model::wildfire().file().clone();
    file.observations.remove(1);
    for state in &mut file.states {
        let smoke = state.observed_as.remove(1);
        state.observed_as[0] += smoke;
    }
    toml::to_string(&file).expect("models serialise")
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
