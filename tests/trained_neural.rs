//! `emberwatch-agent train --learner neural`: a belief from what was seen, and what acts on it.

use crate::commands::{agent, check};
use crate::trainings::Place;
use tests::harness::{AGENT, SMALL, Server};

/// A private server with small worlds.
const WORLDS: &str = "--worlds 2 --height 6 --width 9 --moves 5 --burn-in 60";

const SETTINGS: &str = "learner = \"neural\"
beam_width = 4
[neural]
steps = 60
batch = 4
updates_per_step = 0.5
[decisions]
steps = 20
batch = 8
updates_per_step = 1.0
";

const HEADER: &str = "update,world_steps,loss,held_out_log_likelihood,mean_reward,rate";

fn place() -> Place {
    Place::new(SETTINGS, HEADER)
}

#[test]
fn a_neural_belief_is_learned_resumed_and_acted_on() {
    let place = place();
    let rows = place.learn("out", &format!("{WORLDS} --steps 40"));
    place.train("same", &format!("{WORLDS} --steps 40"));
    let [one, same] =
        ["out", "same"].map(|out| std::fs::read(place.checkpoint(out)).expect("a file"));
    assert!(one == same, "checkpoints of the same training differ");
    let losses: Vec<f64> = rows.iter().filter_map(|row| row[2].parse().ok()).collect();
    assert_eq!(losses.len(), 20);
    assert!((losses[0] - 3_f64.ln()).abs() < 1e-3, "all alike at first");
    let rows = place.learn("out", &format!("{WORLDS} --resume"));
    let last = rows.last().expect("rows");
    assert_eq!(last[1], "60", "those that were left of the settings");
    let done = place.words("out", &format!("{WORLDS} --resume"));
    check(AGENT, &done, "--steps: expected a number, as the 60 of");
    let checkpoint = place.checkpoint("out");
    let checkpoint = format!("--checkpoint {}", checkpoint.display());
    let worlds =
        "--seeds 3..5 --steps 5 --height 6 --width 9 --moves 5 --burn-in 60 --beam-width 4";
    let policies = "--policies neural_beam,neural/options/rule --baseline neural_beam";
    agent(&format!("compare {policies} {worlds} {checkpoint}")).check_prints("neural/options/rule");
    let evaluated = agent(&format!("evaluate {worlds} {checkpoint}"));
    evaluated.check_prints("neural_belief - known_model");
    // The same network on another grid.
    let server = Server::start(SMALL);
    let flags = format!(
        "run --instance {} --steps 5 --policy neural_beam",
        server.instance.name()
    );
    agent(&format!("{flags} {checkpoint}"));
    check(
        AGENT,
        &flags,
        "neural_beam | needs --checkpoint FILE: expected a checkpoint of `train --learner neural`",
    );
}

#[test]
fn decisions_are_learned_on_a_neural_belief() {
    let place = place();
    let flags = format!("{WORLDS} --learner decisions --estimator neural_belief");
    agent(&place.words("out", &format!("{flags} --steps 10")));
    assert!(place.checkpoint("out/belief").exists());
    agent(&place.words("out", &format!("{WORLDS} --learner decisions --resume")));
    let checkpoint = place.checkpoint("out");
    let worlds =
        "--seeds 3..5 --steps 5 --height 6 --width 9 --moves 5 --burn-in 60 --beam-width 4";
    let compared = agent(&format!(
        "compare {worlds} --policies neural_policy,neural_beam --baseline neural_beam --checkpoint {}",
        checkpoint.display()
    ));
    compared.check_prints("neural_policy");
    let filter = format!("{flags} --checkpoint {}", checkpoint.display());
    place.train("given", &filter);
    assert!(!place.path("given/belief").exists(), "the belief was given");
}

#[test]
fn a_neural_belief_corrects_a_filter() {
    let place = place();
    place.train("filter", &format!("{WORLDS} --learner filter --steps 40"));
    let filter = format!("--checkpoint {}", place.checkpoint("filter").display());
    place.learn("out", &format!("{WORLDS} {filter} --steps 40"));
    let again = place.words("out", &format!("{WORLDS} {filter} --resume"));
    check(AGENT, &again, "--checkpoint: expected none beside --resume");
    place.learn("out", &format!("{WORLDS} --resume"));
    let checkpoint = format!("--checkpoint {}", place.checkpoint("out").display());
    let worlds =
        "--seeds 3..5 --steps 5 --height 6 --width 9 --moves 5 --burn-in 60 --beam-width 4";
    let policies = "--policies neural_beam --baseline neural_beam";
    agent(&format!("compare {policies} {worlds} {checkpoint}")).check_prints("neural_beam");
    let wrong = place.words("other", &format!("{WORLDS} {checkpoint}"));
    check(AGENT, &wrong, "--checkpoint | what learned_filter acts on");
}
