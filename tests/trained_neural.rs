//! Tests of `emberwatch-agent train --learner neural`, which learns to compute a belief from frames, and of policies
//! that use this belief.

use crate::commands::{agent, check};
use crate::trainings::{Place, WORLDS, on};
use tests::harness::{AGENT, SMALL, Server};

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

#[test]
fn a_neural_belief_is_learned_resumed_and_acted_on() {
    let place = Place::new(SETTINGS, HEADER);
    let rows = place.learn("out", &format!("{WORLDS} --steps 40"));
    place.train("same", &format!("{WORLDS} --steps 40"));
    let is_same = place.bytes("out") == place.bytes("same");
    assert!(is_same, "checkpoints of the same training differ");
    let losses: Vec<f64> = rows.iter().filter_map(|row| row[2].parse().ok()).collect();
    assert_eq!(losses.len(), 20);
    assert!((losses[0] - 3_f64.ln()).abs() < 1e-3, "uniform at first");
    let resume = format!("{WORLDS} --resume");
    let rows = place.learn("out", &resume);
    let last = rows.last().expect("rows");
    assert_eq!(last[1], "60", "the remaining steps of the settings");
    place.refuse("out", &resume, "expected a number of steps, as all 60");
    let policies = "--policies neural_beam,neural/options/rule --baseline neural_beam";
    place
        .compare("out", policies)
        .check_prints("neural/options/rule");
    let checkpoint = place.flag("out");
    // The same network also works on another grid.
    let server = Server::start(SMALL);
    let flags = format!("run {} --steps 5 --policy neural_beam", on(&server));
    agent(&format!("{flags} {checkpoint}"));
    let words =
        "neural_beam | needs --checkpoint FILE: expected a checkpoint of `train --learner neural`";
    check(AGENT, &flags, words);
}

#[test]
fn a_neural_belief_corrects_a_filter_and_decisions_learn_on_it() {
    let place = Place::new(SETTINGS, HEADER);
    place.train("filter", &format!("{WORLDS} --learner filter --steps 40"));
    let filter = place.flag("filter");
    place.learn("out", &format!("{WORLDS} {filter} --steps 40"));
    let again = format!("{WORLDS} {filter} --resume");
    place.refuse(
        "out",
        &again,
        "--resume | cannot be used with | --checkpoint",
    );
    place.learn("out", &format!("{WORLDS} --resume"));
    let policies = "--policies neural_beam --baseline neural_beam";
    place.compare("out", policies).check_prints("neural_beam");
    let wrong = format!("{WORLDS} {}", place.flag("out"));
    place.refuse("other", &wrong, "--checkpoint | for the estimator learned");

    let flags = format!("{WORLDS} --learner decisions --estimator neural");
    place.train("decisions", &format!("{flags} --steps 10"));
    assert!(place.checkpoint("decisions/belief").exists());
    place.train(
        "decisions",
        &format!("{WORLDS} --learner decisions --resume"),
    );
    let policies = "--policies neural_policy,neural_beam --baseline neural_beam";
    place
        .compare("decisions", policies)
        .check_prints("neural_policy");
    place.train("given", &format!("{flags} {}", place.flag("decisions")));
    assert!(
        !place.folder.path("given/belief").exists(),
        "the belief was given"
    );
}
