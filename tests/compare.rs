//! End-to-end tests of `emberwatch-agent compare`: repeated comparisons are equal bit for bit, also with a second
//! model.

use crate::commands::agent;
use emberwatch_agent::benchmark::report::PolicyRun;
use emberwatch_agent::benchmark::report::runs_file::read_runs;
use tests::harness::{Ended, Folder, Program, Server, repository};

/// The flags of a comparison, except those for its worlds.
const WHAT: &str = "compare --seeds 3..5 --steps 5 --shooting-samples 16 --beam-width 4";

/// Flags for the worlds.
const WORLDS: &str = "--height 6 --width 9 --moves 5 --burn-in 60";

/// Worlds with many fires.
const LIVELY: &str = "--model wildfire-small --height 12 --width 14 --moves 8 --burn-in 300";

/// Returns what a comparison printed, and its rows without the planning times. Figures are drawn into `folder`.
fn compare_into(folder: &Folder, flags: &str) -> (Ended, Vec<PolicyRun>) {
    let csv = folder.word("new/out.csv");
    let ended = agent(&format!("{WHAT} --csv {csv} {flags}"));
    let mut runs = read_runs(&folder.path("new/out.csv")).expect("rows");
    for run in &mut runs {
        assert!(run.mean_plan_millis >= 0.0);
        run.mean_plan_millis = 0.0;
    }
    (ended, runs)
}

fn compare(flags: &str) -> Vec<PolicyRun> {
    compare_into(&Folder::default(), flags).1
}

#[test]
fn a_comparison_is_printed_drawn_and_repeated_to_the_bit_on_any_server() {
    let folder = Folder::default();
    let figures = format!("{WORLDS} --figures {}", folder.word("figures"));
    let (ended, rows) = compare_into(&folder, &figures);
    // The default comparison on the wildfire model has fourteen policies, with two seeds each.
    assert_eq!(rows.len(), 14 * 2, "{rows:?}");
    for (run, of_first) in rows.iter().zip(rows[..2].iter().cycle()) {
        ended.check_prints(&run.policy);
        let world = |run: &PolicyRun| (run.world_seed, run.mean_fire_cells);
        assert_eq!(world(run), world(of_first), "all ran on the same worlds");
    }
    for (name, words) in [
        ("ladder.svg", "\nbeam"),
        ("rewards.svg", "\nknown/beam/exploit"),
        ("agent.toml", "beam_width = 4"),
    ] {
        let text = folder.text(&format!("figures/{name}"));
        assert!(text.contains(words), "{name}: {text}");
    }
    for n_worlds in [5, 2] {
        let settings = format!("--publish-truth --seed 77 --worlds {n_worlds} --threads 2");
        let server = Server::start(&format!("{WORLDS} {settings}"));
        for _ in 0..2 {
            assert_eq!(compare(&server.flag()), rows, "{n_worlds} worlds");
        }
    }
    let other_seed = compare(&format!("{WORLDS} --agent-seed 5"));
    assert_ne!(other_seed, rows, "planners draw from the agent's seed");
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
    let flags = format!("{policies} {}", server.flag());
    let (ended, rows) = compare_into(&Folder::default(), &flags);
    assert_eq!(rows, expected);
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
    let rewards = |team| Vec::from_iter(of(3, team).iter().map(|run| run.mean_reward));
    assert_ne!(rewards("shared"), rewards("alone"));
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
    let server = Server::start(&format!("{flags} --reveal-model false"));
    assert_eq!(server.info().observations, ["dark", "shiny", "white"]);
    for policy in ["known/beam/ice", "known/shooting/gritted"] {
        let flags = format!("{model} --steps 10 --policy {policy}");
        Program::agent(&server.instance, &flags).ends(0);
    }
    assert_eq!(server.step_of(0), 20);
    // The default comparison has fifteen policies here, because it has one policy for each of the three states without
    // a reward.
    let rows = compare(&flags);
    assert_eq!(rows.len(), 15 * 2, "{rows:?}");
}
