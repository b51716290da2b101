//! Agents that fly robots of one world: by one plan without a word between them, in a world that goes on without them.

use crate::commands::check;
use emberwatch_agent::acting::mission::{Company, Mission};
use emberwatch_agent::acting::run::{Summary, run};
use emberwatch_learning::config::AgentConfig;
use emberwatch_learning::learned::Learned;
use emberwatch_protocol::observer::Observer;
use std::ops::Range;
use std::sync::atomic::AtomicBool;
use std::time::Duration;
use tests::harness::{AGENT, PATIENCE, Server, robots_of};

/// A lively world of four robots, whose server keeps all frames of these steps.
const FLAGS: &str =
    "--model wildfire-small --height 16 --width 14 --moves 8 --burn-in 300 --robots 4";

const STEPS: u64 = 40;

/// Flies four robots by agents that hold some each, from k = 0 on; returns the paths by step, and the reward.
fn fly(parts: &[Range<u32>], company: Company) -> (Vec<Vec<Vec<u8>>>, f64) {
    let server = Server::start(FLAGS);
    // Holds the world until each robot has its agent.
    let _holder = server.acquire(0..4);
    let frames = Observer::frames(&server.instance).expect("the channel");
    let mission = |robots: &Range<u32>| Mission {
        task: None,
        instance: server.instance.clone(),
        world: 0,
        robots: robots.clone(),
        company,
        policy: "beam_exploit".into(),
        shortest_step: Duration::ZERO,
        steps: STEPS,
        takeover: true,
        model: None,
        config: AgentConfig::default(),
        learned: Learned::default(),
    };
    let reward = std::thread::scope(|scope| {
        let run = |robots| {
            let mission = mission(robots);
            scope.spawn(move || run(&mission, &AtomicBool::new(false)).expect("a run"))
        };
        let runs: Vec<_> = parts.iter().map(run).collect();
        let done = runs.into_iter().map(|run| run.join().expect("no panic"));
        done.map(|Summary { steps, reward }| {
            assert_eq!(steps, STEPS);
            reward
        })
        .sum()
    });
    let mut paths = Vec::new();
    while paths.len() < STEPS as usize {
        let sample = frames.receive(PATIENCE).expect("the channel");
        let sample = sample.expect("a sample of each step");
        if sample.header.result.step > paths.len() as u64 {
            let robots = robots_of(&sample).into_iter();
            paths.push(robots.map(|robot| robot.path.to_vec()).collect());
        }
    }
    (paths, reward)
}

#[test]
fn agents_of_a_team_fly_one_plan_whoever_flies_what() {
    let single = [0..1, 1..2, 2..3, 3..4];
    let all = 0..4;
    let together = fly(std::slice::from_ref(&all), Company::Team);
    assert_eq!(fly(&single, Company::Team), together);
    assert_eq!(fly(&[0..1, 1..4], Company::Team), together);
    // One that plans for itself flies where others fly too.
    let (_, alone) = fly(&single, Company::Alone);
    assert!(together.1 > 1.2 * alone, "{} and {alone}", together.1);
}

#[test]
fn what_a_server_of_several_robots_cannot_give_is_refused_by_name() {
    let server = Server::start(&format!("{FLAGS} --publish-truth"));
    let check = |flags: &str, words: &str| {
        let flags = format!("{flags} --instance {}", server.instance.name());
        check(AGENT, &flags, words);
    };
    let robots = "expected some of the world's 0..4, got";
    check("run --robot 4", &format!("{robots} 4..5"));
    check("run --robots 2..6 --team", &format!("{robots} 2..6"));
    check("run --world 1", "no such world");
    let robots = "expected the running server's 4, got 2";
    check("compare --robots 2", robots);
}
