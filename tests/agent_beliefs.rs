//! What agents show of their beliefs, to readers of their channel.

use emberwatch_protocol::agent_belief::AgentBelief;
use emberwatch_protocol::message::AgentHeader;
use emberwatch_protocol::observer::Observer;
use std::collections::BTreeSet;
use std::time::{Duration, Instant};
use tests::harness::{AGENT, PATIENCE, Program, Server, eventually};

/// Reads until one is as wanted.
fn until(
    observer: &Observer<AgentHeader>,
    mut wanted: impl FnMut(&AgentBelief) -> bool,
) -> Vec<AgentBelief> {
    let (mut all, start) = (Vec::<AgentBelief>::new(), Instant::now());
    while !all.last().is_some_and(&mut wanted) {
        let remaining = PATIENCE.saturating_sub(start.elapsed());
        let shown = next(observer, remaining);
        all.push(shown.expect("an agent that shows its belief"));
    }
    all
}

fn next(observer: &Observer<AgentHeader>, limit: Duration) -> Option<AgentBelief> {
    let sample = observer.receive(limit).expect("receive")?;
    Some(AgentBelief::try_from(&sample).expect("a belief"))
}

#[test]
fn an_agent_shows_what_it_believes_and_its_last_belief_in_any_case() {
    let server = Server::start("--height 16 --width 24 --moves 12 --burn-in 2000");
    let observer = Observer::agents(&server.instance).expect("observe");
    let mut agent = Program::agent(&server.instance, "--steps 2000 --policy known/beam/explore");
    let mut shown = Vec::new();
    let has_ended = eventually(4 * PATIENCE, || {
        shown.extend(next(&observer, Duration::ZERO));
        agent.has_ended()
    });
    assert!(has_ended, "{}", agent.stderr());
    agent.ends(0);
    shown.extend(std::iter::from_fn(|| next(&observer, Duration::ZERO)));
    let last = shown
        .last()
        .expect("an observer that was there before the agent meets it");
    assert_eq!(last.header.step, 2000);
    for AgentBelief {
        header,
        belief,
        intent,
    } in &shown
    {
        assert_eq!(belief.dim(), (3, 16, 24));
        let sums = belief.sum_axis(ndarray::Axis(0));
        assert!(sums.iter().all(|sum| (sum - 1.0).abs() < 1e-4));
        assert_eq!(intent.policy, "known/beam/explore");
        assert_eq!(intent.states, ["normal", "latent", "fire"]);
        assert!(
            header.step == 0 || intent.objective == "entropy",
            "{intent:?}"
        );
    }
    // The posterior is sure of what was seen on the last path: 98 of 100 fires look like one.
    let surest = last.belief.iter().copied().fold(0.0, f32::max);
    assert!(surest > 0.9, "{surest}");
}

#[test]
fn beliefs_that_nobody_looks_at_are_not_shown() {
    let server = Server::start("--height 16 --width 24 --moves 12 --burn-in 200");
    let agent = Program::agent(&server.instance, "");
    agent.until(|| server.step_of(0) > 500);
    let observer = Observer::agents(&server.instance).expect("observe");
    let shown = until(&observer, |_| true);
    assert!(shown[0].header.step > 500, "a belief of before");
    let header = &shown[0].header;
    let flown = (header.first_robot, header.n_robots);
    assert_eq!((header.pid, flown), (agent.pid(), (0, 1)));
}

#[test]
fn a_comparison_that_is_watched_shows_the_beliefs_of_all_its_worlds() {
    let flags = "--worlds 8 --publish-truth --height 8 --width 9 --moves 6 --burn-in 50";
    let server = Server::start(flags);
    let observer = Observer::agents(&server.instance).expect("observe");
    let compare = |n_steps: u64| {
        let words = format!(
            "compare --policies beam_exploit --baseline beam_exploit --seeds 0..8 --steps {n_steps} \
             --watch 127.0.0.1:0 --instance {}",
            server.instance.name()
        );
        Program::start(AGENT, &words)
    };
    let comparison = compare(1_000_000);
    let mut missing: BTreeSet<u32> = (0..8).collect();
    let start = Instant::now();
    while !missing.is_empty() {
        let remaining = PATIENCE.saturating_sub(start.elapsed());
        let sample = observer
            .receive(remaining)
            .expect("receive")
            .unwrap_or_else(|| panic!("no belief about worlds {missing:?}"));
        missing.remove(&sample.header.world);
        std::thread::sleep(Duration::from_millis(2)); // as a dashboard looks
    }
    comparison.wait_for_words("watch at http://127.0.0.1:");
    drop((comparison, observer));
    server.program.until(|| {
        let mut worlds = server.status().worlds.into_iter();
        worlds.all(|world| world.holder_pids == [None])
    });
    compare(5).ends(0);
}

#[test]
fn a_training_shows_what_it_believes_of_all_its_worlds() {
    let server = Server::start("--height 16 --width 24 --moves 12 --burn-in 500 --worlds 3");
    let observer = Observer::agents(&server.instance).expect("observe");
    let folder = tempfile::TempDir::new().expect("a folder");
    let out = folder.path().join("out");
    let config = folder.path().join("agent.toml");
    std::fs::write(&config, "[learning]\nexplore_steps = 1000000\n").expect("write");
    let flags = format!(
        "train --instance {} --config {} --out {} --world 1 --worlds 2",
        server.instance.name(),
        config.display(),
        out.display()
    );
    let training = Program::start(AGENT, &flags);
    let mut worlds = BTreeSet::new();
    let shown = until(&observer, |shown| {
        worlds.insert(shown.header.world);
        worlds.len() == 2 && shown.header.step > 5
    });
    drop(training);
    assert_eq!(worlds, BTreeSet::from([1, 2]));
    for AgentBelief { belief, intent, .. } in &shown {
        assert_eq!(belief.dim(), (3, 16, 24));
        let sums = belief.sum_axis(ndarray::Axis(0));
        assert!(sums.iter().all(|sum| (sum - 1.0).abs() < 1e-4));
        assert_eq!(intent.policy, "train filter");
        assert_eq!(intent.belief_from, "learned_filter");
        assert_eq!(intent.states, ["state 0", "state 1", "state 2"]);
        assert_eq!(intent.objective, "random moves");
    }
}
