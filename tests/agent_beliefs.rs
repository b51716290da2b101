//! Tests of the beliefs that agents publish on their channel.

use emberwatch_protocol::agent_belief::AgentBelief;
use emberwatch_protocol::message::AgentHeader;
use emberwatch_protocol::observer::Observer;
use std::collections::BTreeSet;
use std::time::{Duration, Instant};
use tests::harness::{AGENT, Folder, PATIENCE, Program, Server, eventually};

const LIVELY: &str = "--model wildfire-small --height 16 --width 24 --moves 12 --burn-in 200";

fn next(observer: &Observer<AgentHeader>, limit: Duration) -> Option<AgentBelief> {
    let sample = observer.receive(limit).expect("receive")?;
    let shown = AgentBelief::try_from(&sample).expect("a belief");
    let sums = shown.belief.sum_axis(ndarray::Axis(0));
    assert!(sums.iter().all(|sum| (sum - 1.0).abs() < 1e-4));
    Some(shown)
}

/// Reads the channel until a belief about each of these worlds has arrived.
fn until_all(observer: &Observer<AgentHeader>, worlds: std::ops::Range<u32>) -> Vec<AgentBelief> {
    let (mut all, start) = (Vec::<AgentBelief>::new(), Instant::now());
    let mut missing: BTreeSet<u32> = worlds.collect();
    while !missing.is_empty() {
        let remaining = PATIENCE.saturating_sub(start.elapsed());
        let shown = next(observer, remaining);
        all.push(shown.unwrap_or_else(|| panic!("no belief about worlds {missing:?}")));
        missing.remove(&all[all.len() - 1].header.world);
    }
    all
}

#[test]
fn an_agent_shows_what_it_believes_while_observed_and_its_last_belief_in_any_case() {
    let server = Server::start(LIVELY);
    let observer = Observer::agents(&server.instance).expect("observe");
    let mut agent = Program::agent(&server.instance, "--steps 500 --policy known/beam/explore");
    let mut shown = Vec::new();
    let has_ended = eventually(4 * PATIENCE, || {
        shown.extend(next(&observer, Duration::ZERO));
        agent.has_ended()
    });
    assert!(has_ended, "{}", agent.stderr());
    agent.ends(0);
    shown.extend(std::iter::from_fn(|| next(&observer, Duration::ZERO)));
    for AgentBelief {
        header,
        belief,
        intent,
    } in &shown
    {
        assert_eq!(belief.dim(), (3, 16, 24));
        assert_eq!(intent.policy, "known/beam/explore");
        assert_eq!(intent.states, ["normal", "latent", "fire"]);
        assert!(
            header.step == 0 || intent.objective == "entropy",
            "{intent:?}"
        );
    }
    let last = shown
        .last()
        .expect("an observer from before the agent connects to it");
    assert_eq!(last.header.step, 500);
    // The posterior is nearly certain for cells on the last path, because a fire is observed as fire with probability
    // 0.98.
    let surest = last.belief.iter().copied().fold(0.0, f32::max);
    assert!(surest > 0.9, "{surest}");
    drop(observer);
    let agent = Program::agent(&server.instance, "");
    agent.until(|| server.step_of(0) > 600);
    let observer = Observer::agents(&server.instance).expect("observe");
    let header = until_all(&observer, 0..1)[0].header;
    assert!(header.step > 600, "a belief that nobody looked at");
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
            "compare --policies known/beam/exploit --baseline known/beam/exploit --seeds 0..8 --steps {n_steps} \
             {}",
            server.flag()
        );
        Program::start(AGENT, &words)
    };
    let comparison = compare(1_000_000);
    until_all(&observer, 0..8);
    drop((comparison, observer));
    server.program.until(|| {
        let mut worlds = server.status().worlds.into_iter();
        worlds.all(|world| world.holder_pids == [None])
    });
    compare(5).ends(0);
}

#[test]
fn a_training_shows_what_it_believes_of_all_its_worlds() {
    let server = Server::start(&format!("{LIVELY} --worlds 3"));
    let observer = Observer::agents(&server.instance).expect("observe");
    let folder = Folder::default();
    let config = folder.write("agent.toml", "[learning]\nexplore_steps = 1000000\n");
    let flags = format!(
        "--config {config} --out {} --world 1 --worlds 2",
        folder.word("out")
    );
    let _training = Program::start(AGENT, &format!("train {} {flags}", server.flag()));
    let shown = until_all(&observer, 1..3);
    assert!(shown.iter().all(|shown| shown.header.world > 0));
    for AgentBelief { belief, intent, .. } in &shown {
        assert_eq!(belief.dim(), (3, 16, 24));
        assert_eq!(intent.policy, "train filter");
        assert_eq!(intent.belief_from, "learned");
        assert_eq!(intent.states, ["state 0", "state 1", "state 2"]);
        assert_eq!(intent.objective, "random moves");
    }
}
