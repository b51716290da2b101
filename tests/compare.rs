//! `emberwatch-agent` from end to end: comparisons that repeat to the bit, and a second model.

use crate::commands::{TINY, agent, check};
use emberwatch_agent::benchmark::report::RunsFile;
use emberwatch_protocol::{Dynamics, Model, Shape};
use emberwatch_sim::world::{Source, World};
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::time::Duration;
use tempfile::TempDir;
use tests::harness::{AGENT, Program, Server, repository};

/// What is compared; the worlds come on top.
const WHAT: &str = "compare --seeds 3..5 --steps 5 --shooting-samples 16 --beam-width 4";

/// The worlds, as flags of the private server.
const WORLDS: &str = "--height 6 --width 9 --moves 5 --burn-in 60";

const HEADER: &str = "policy,estimator,world_seed,steps,mean_reward,mean_distinct_cells,hit_rate,\
                      mean_fire_cells,mean_plan_millis,brier,moves,robots,team,mean_repeated,\
                      steps_to_detection,burning_cells_at_detection,recent_steps,\
                      burning_seen_share,front_distance,grid_seen_share,log_likelihood,\
                      worlds_fingerprint,policy_fingerprint,training_seconds";

/// The rows of a CSV file without the time that plans took; its header is checked.
fn rows(path: &Path) -> Vec<Vec<String>> {
    let text = std::fs::read_to_string(path).expect("the CSV file");
    let mut lines = text.lines();
    assert_eq!(lines.next(), Some(HEADER));
    let rows = lines.map(|line| {
        let mut fields: Vec<String> = line.split(',').map(String::from).collect();
        assert_eq!(fields.len(), 24, "{line}");
        let millis: f64 = fields.remove(8).parse().expect("a time");
        assert!(millis >= 0.0);
        fields
    });
    rows.collect()
}

fn compare_to(path: &Path, flags: &str) -> Vec<Vec<String>> {
    agent(&format!("{WHAT} --csv {} {flags}", path.display()));
    rows(path)
}

#[test]
fn a_comparison_writes_a_table_a_csv_file_and_figures() {
    let folder = TempDir::new().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    let (csv, figures) = (path("new/out.csv"), path("figures"));
    let places = format!("--csv {} --figures {}", csv.display(), figures.display());
    let ended = agent(&format!("{WHAT} {WORLDS} {places}"));
    let rows = rows(&csv);
    // Fifteen policies of the wildfire's ladder, two seeds each.
    assert_eq!(rows.len(), 15 * 2, "{rows:?}");
    for [first, second] in rows.as_chunks::<2>().0 {
        ended.check_prints(&first[0]);
        assert_eq!((&first[0], &*first[2], &*second[2]), (&second[0], "3", "4"));
        let fire_cells = [&first[7], &second[7]];
        let theirs = [&rows[0][7], &rows[1][7]];
        assert_eq!(fire_cells, theirs, "all met the same worlds");
    }
    for name in ["ladder.svg", "rewards.svg", "snapshot.svg"] {
        let text = std::fs::read_to_string(figures.join(name)).expect(name);
        assert!(text.contains(">beam exploit"), "{name}");
    }
    let settings = std::fs::read_to_string(figures.join("agent.toml")).expect("the settings");
    assert!(settings.contains("beam_width = 4"), "{settings}");
}

#[test]
fn a_csv_file_that_another_process_writes_is_refused() {
    let folder = TempDir::new().expect("a folder");
    let csv = folder.path().join("out.csv");
    let held = RunsFile::lock(&csv, Duration::ZERO).expect("locked");
    let compare = format!("compare {TINY} --csv {}", csv.display());
    check(
        AGENT,
        &compare,
        "--csv: write | out.csv: another process is writing it",
    );
    drop(held);
    agent(&compare);
    assert_eq!(rows(&csv).len(), 1);
}

#[test]
fn a_comparison_repeats_to_the_bit_on_any_server() {
    let folder = TempDir::new().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    let first = compare_to(&path("first.csv"), WORLDS);
    assert_eq!(compare_to(&path("again.csv"), WORLDS), first);
    let roomy = format!("{WORLDS} --publish-truth --coverage client --seed 77");
    for n_worlds in [5, 2] {
        let server = Server::start(&format!("{roomy} --worlds {n_worlds} --threads 2"));
        let instance = format!("--instance {}", server.instance.name());
        for round in ["one.csv", "two.csv"] {
            let again = compare_to(&path(round), &instance);
            assert_eq!(again, first, "{n_worlds} worlds");
        }
    }
    let other_seed = compare_to(&path("seed.csv"), &format!("{WORLDS} --agent-seed 5"));
    assert_ne!(other_seed, first, "planners draw from the agent's seed");
}

#[test]
fn without_hidden_states_what_needs_them_is_empty() {
    let folder = TempDir::new().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    let worlds = "--model wildfire-small --height 12 --width 14 --moves 8 --burn-in 300";
    let policies = "--policies beam_exploit,coverage";
    let mut expected = compare_to(&path("truth.csv"), &format!("{worlds} {policies}"));
    // Brier score, burning cells seen and distance to the front.
    for row in &mut expected {
        assert!(
            [16, 17].iter().all(|&column| !row[column].is_empty()),
            "{row:?}"
        );
        for column in [8, 16, 17] {
            row[column].clear();
        }
    }
    let server = Server::start(&format!("{worlds} --worlds 2"));
    let csv = path("blind.csv");
    let (path, name) = (csv.display(), server.instance.name());
    let places = format!("--csv {path} --instance {name}");
    let ended = agent(&format!("{WHAT} {policies} {places}"));
    assert_eq!(rows(&csv), expected);
    ended.check_prints("no hidden states were published");
}

#[test]
fn a_policy_by_its_parts_is_the_one_of_its_name() {
    let worlds = "--seeds 3..5 --steps 3 --height 6 --width 9 --moves 5 --burn-in 60";
    let policies = "--policies coverage,known/beam/exploit --baseline known/beam/exploit";
    let compared = agent(&format!("compare {worlds} {policies}"));
    compared.check_prints("differences are paired by world, to beam_exploit");
    agent("compare --policies help").check_prints("learned+spatial");
}

#[test]
fn teams_meet_the_worlds_of_one_robot_and_one_robot_is_each_team() {
    let folder = TempDir::new().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    let lively = "--model wildfire-small --height 12 --width 14 --moves 8 --burn-in 300";
    let alone = compare_to(
        &path("one.csv"),
        &format!("{lively} --policies beam_exploit"),
    );
    let teams = "--robots 1,3 --team alone,shared,joint,oracle";
    let rows = compare_to(&path("teams.csv"), &format!("{lively} {teams}"));
    assert_eq!(rows.len(), 2 * 4 * 2, "{rows:?}");
    // Robots and team stand in columns 10 and 11.
    let of = |robots: &str, team: &str| -> Vec<Vec<String>> {
        let rows = rows.iter().filter(|row| row[10..12] == [robots, team]);
        rows.cloned().collect()
    };
    for team in ["alone", "shared", "joint"] {
        let expected = alone.iter().cloned().map(|mut row| {
            row[11] = team.into();
            row
        });
        assert_eq!(of("1", team), expected.collect::<Vec<_>>());
        let fire_cells = of("3", team).into_iter().map(|row| row[7].clone());
        let expected = alone.iter().map(|row| row[7].clone());
        assert_eq!(fire_cells.collect::<Vec<_>>(), expected.collect::<Vec<_>>());
    }
    assert!(of("3", "oracle").iter().all(|row| row[0] == "oracle_beam"));
    let distinct = |team: &str| -> f64 {
        let cells = of("3", team).into_iter();
        cells
            .map(|row| row[5].parse::<f64>().expect("a number"))
            .sum()
    };
    assert!(distinct("joint") > distinct("alone"), "{rows:?}");
    let server = Server::start(&format!(
        "{lively} --robots 3 --publish-truth --coverage client"
    ));
    let flags = format!("--team joint --instance {}", server.instance.name());
    let joint = compare_to(&path("joint.csv"), &flags);
    assert!(
        joint.iter().all(|row| row[10..12] == ["3", "joint"]),
        "{joint:?}"
    );
}

#[test]
fn runs_with_one_seed_act_alike() {
    let flags = "--steps 20 --shooting-samples 32 --beam-width 5";
    for policy in [
        "random_walk",
        "shooting_exploit",
        "beam_exploit",
        "oracle_beam",
    ] {
        let act = || {
            let server = Server::start(&format!("{WORLDS} --publish-truth"));
            let flags = format!("--policy {policy} {flags}");
            Program::agent(&server.instance, &flags).ends(0);
            (server.observe(0), server.status().worlds[0].holder_pids[0])
        };
        let (first, holder) = act();
        assert_eq!((first.0.step, holder), (20, None), "{policy}");
        assert_eq!(act().0, first, "{policy}");
    }
}

#[test]
fn a_second_model_runs_from_end_to_end() {
    let folder = TempDir::new().expect("a folder");
    let model = repository().join("config/models/road-ice.toml");
    let worlds = "--height 8 --width 13 --moves 7 --burn-in 300";
    let model = format!("--model {}", model.display());
    let flags = format!("{worlds} {model}");
    let server = Server::start(&flags);
    let info = server.info();
    assert_eq!(info.n_observations, 3);
    assert_eq!(info.observations, ["dark", "shiny", "white"]);
    for flags in [
        "--steps 30 --beam-width 5 --policy known/beam/ice",
        "--steps 10 --shooting-samples 9 --policy shooting_gritted",
    ] {
        Program::agent(&server.instance, flags).ends(0);
    }
    assert_eq!(server.observe(0).0.step, 40);
    let figures = format!("--figures {}", folder.path().join("figures").display());
    let rows = compare_to(
        &folder.path().join("ice.csv"),
        &format!("{flags} {figures}"),
    );
    // Sixteen policies: the ladder has one for each of three states beside the one that pays.
    assert_eq!(rows.len(), 16 * 2, "{rows:?}");
    assert!(folder.path().join("figures/snapshot.svg").exists());
    let hidden = Server::start(&format!("{flags} --reveal-model false"));
    let flags = format!("--steps 3 --beam-width 5 {model}");
    Program::agent(&hidden.instance, &flags).ends(0);
}

#[test]
fn the_road_ice_model_keeps_all_its_states() {
    let text = std::fs::read_to_string(repository().join("config/models/road-ice.toml"));
    let model = Model::from_toml(&text.expect("the model file")).expect("a valid model");
    let shape = Shape::new(24, 40).expect("a shape");
    let source = Source::Simulated(Dynamics::new(&model, shape).expect("a model that fits"));
    for seed in 0..4 {
        let world = World::new(source.clone(), seed, 5_000, &AtomicBool::new(false));
        let mut counts = [0; 4];
        world
            .states()
            .iter()
            .for_each(|&state| counts[usize::from(state)] += 1);
        // The least seen in 160 looks was 1 % of 960 cells.
        assert!(
            counts.iter().all(|&count| count >= 5),
            "seed {seed}: {counts:?}"
        );
    }
}
