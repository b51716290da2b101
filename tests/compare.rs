//! End-to-end tests of `emberwatch-agent compare`: repeated comparisons are equal bit for bit, also with a second
//! model.

use crate::commands::agent;
use emberwatch_agent::benchmark::report::PolicyRun;
use emberwatch_agent::benchmark::report::runs_file::read_runs;
use emberwatch_protocol::{Dynamics, Model, Shape};
use emberwatch_sim::world::{Source, World};
use std::sync::atomic::AtomicBool;
use tests::harness::{Folder, Program, Server, repository};

/// The flags of a comparison, except those for its worlds.
const WHAT: &str = "compare --seeds 3..5 --steps 5 --shooting-samples 16 --beam-width 4";

/// Flags for the worlds.
const WORLDS: &str = "--height 6 --width 9 --moves 5 --burn-in 60";

/// Worlds with many fires.
const LIVELY: &str = "--model wildfire-small --height 12 --width 14 --moves 8 --burn-in 300";

/// Returns the rows of a comparison, without the planning times.
fn compare(flags: &str) -> Vec<PolicyRun> {
    let folder = Folder::default();
    agent(&format!("{WHAT} --csv {} {flags}", folder.word("out.csv")));
    let mut runs = read_runs(&folder.path("out.csv")).expect("rows");
    for run in &mut runs {
        assert!(run.mean_plan_millis >= 0.0);
        run.mean_plan_millis = 0.0;
    }
    runs
}

#[test]
fn a_comparison_writes_a_table_a_csv_file_and_figures() {
    let folder = Folder::default();
    let [csv, figures] = ["new/out.csv", "figures"].map(|name| folder.word(name));
    let ended = agent(&format!("{WHAT} {WORLDS} --csv {csv} --figures {figures}"));
    let rows = read_runs(&folder.path("new/out.csv")).expect("rows");
    // The default comparison on the wildfire model has fourteen policies, with two seeds each.
    assert_eq!(rows.len(), 14 * 2, "{rows:?}");
    for pair in rows.as_chunks::<2>().0 {
        ended.check_prints(&pair[0].policy);
        for (run, of_first) in pair.iter().zip(&rows) {
            assert_eq!(run.policy, pair[0].policy);
            let world = |run: &PolicyRun| (run.world_seed, run.mean_fire_cells);
            assert_eq!(world(run), world(of_first), "all ran on the same worlds");
        }
    }
    for (name, words) in [
        ("ladder.svg", "\nbeam"),
        ("rewards.svg", "\nknown/beam/exploit"),
        ("agent.toml", "beam_width = 4"),
    ] {
        let text = folder.text(&format!("figures/{name}"));
        assert!(text.contains(words), "{name}: {text}");
    }
}

#[test]
fn a_comparison_repeats_to_the_bit_on_any_server() {
    let first = compare(WORLDS);
    assert_eq!(compare(WORLDS), first);
    let roomy = format!("{WORLDS} --publish-truth --seed 77");
    for n_worlds in [5, 2] {
        let server = Server::start(&format!("{roomy} --worlds {n_worlds} --threads 2"));
        for _ in 0..2 {
            let again = compare(&format!("--instance {}", server.instance.name()));
            assert_eq!(again, first, "{n_worlds} worlds");
        }
    }
    let other_seed = compare(&format!("{WORLDS} --agent-seed 5"));
    assert_ne!(other_seed, first, "planners draw from the agent's seed");
}

#[test]
fn without_hidden_states_what_needs_them_is_empty() {
    let policies =
        "--policies known/beam/exploit,known/beam/explore,coverage --baseline known/beam/exploit";
    let mut expected = compare(&format!("{LIVELY} {policies}"));
    for run in &mut expected {
        let of_states = (run.burning_seen_share.take(), run.front_distance.take());
        assert!(of_states.0.is_some() && of_states.1.is_some());
        run.brier = None;
    }
    let server = Server::start(&format!("{LIVELY} --worlds 2"));
    let instance = format!("--instance {}", server.instance.name());
    assert_eq!(compare(&format!("{policies} {instance}")), expected);
    let ended = agent(&format!("{WHAT} {policies} {instance}"));
    ended.check_prints("no hidden states were published");
    ended.check_prints("differences are paired by world, to known/beam/exploit");
}

#[test]
fn teams_meet_the_worlds_of_one_robot_and_one_robot_is_each_team() {
    let alone = compare(&format!("{LIVELY} --policies beam"));
    let rows = compare(&format!("{LIVELY} --robots 1,3 --team alone,shared,joint"));
    assert_eq!(rows.len(), 2 * 3 * 2, "{rows:?}");
    let of = |robots: u32, team: &str| -> Vec<PolicyRun> {
        let is_of = |run: &&PolicyRun| (run.robots, &*run.team) == (robots, team);
        rows.iter().filter(is_of).cloned().collect()
    };
    let fires = |runs: &[PolicyRun]| Vec::from_iter(runs.iter().map(|run| run.mean_fire_cells));
    for team in ["alone", "shared", "joint"] {
        let mut expected = alone.clone();
        expected.iter_mut().for_each(|run| run.team = team.into());
        assert_eq!(of(1, team), expected);
        assert_eq!(fires(&of(3, team)), fires(&alone));
    }
    let distinct = |team| -> f64 {
        let cells = of(3, team).into_iter().map(|run| run.mean_distinct_cells);
        cells.sum()
    };
    assert!(distinct("joint") > distinct("alone"), "{rows:?}");
}

#[test]
fn a_second_model_runs_from_end_to_end() {
    let model = repository().join("config/models/road-ice.toml");
    let model = format!("--model {}", model.display());
    let flags = format!("--height 8 --width 13 --moves 7 --burn-in 300 {model}");
    let server = Server::start(&flags);
    assert_eq!(server.info().observations, ["dark", "shiny", "white"]);
    for flags in [
        "--steps 30 --beam-width 5 --policy known/beam/ice",
        "--steps 10 --shooting-samples 9 --policy known/shooting/gritted",
    ] {
        Program::agent(&server.instance, flags).ends(0);
    }
    assert_eq!(server.step_of(0), 40);
    let rows = compare(&flags);
    // The default comparison has fifteen policies here, because it has one policy for each of the three states without
    // a reward.
    assert_eq!(rows.len(), 15 * 2, "{rows:?}");
    let hidden = Server::start(&format!("{flags} --reveal-model false"));
    let flags = format!("--steps 3 --beam-width 5 {model}");
    Program::agent(&hidden.instance, &flags).ends(0);
    // Every state of the model persists. In 160 samples, the rarest state never covered less than 1 % of the 960 cells.
    let model = Model::from_toml(include_str!("../config/models/road-ice.toml")).expect("a model");
    let dynamics = Dynamics::new(&model, Shape::new(24, 40).expect("a shape"));
    let source = Source::Simulated(dynamics.expect("it fits"));
    for seed in 0..4 {
        let world = World::new(source.clone(), seed, 5_000, &AtomicBool::new(false));
        for state in 0..4 {
            let n_cells = world.states().iter().filter(|&&it| it == state).count();
            assert!(n_cells >= 5, "seed {seed}, state {state}: {n_cells}");
        }
    }
}
