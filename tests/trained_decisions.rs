//! Tests of `emberwatch-agent train --learner decisions`, which first trains a filter, and then a network that chooses
//! between options.

use crate::commands::{agent, check};
use crate::trainings::{COMPARED, Place, WORLDS, on};
use emberwatch_learning::learners::decisions::SavedDecisions;
use rustix::process::Signal;
use tests::harness::{AGENT, LIMIT, Program, SMALL, Server, repository};

const SETTINGS: &str = "learner = \"decisions\"
beam_width = 4
prior_worlds = 2
[learning]
window = 4
[decisions]
filter_steps = 40
steps = 100
batch = 8
replay = 100
updates_per_step = 1.0
episode_steps = 9
";

const HEADER: &str =
    "update,world_steps,loss,held_out_log_likelihood,mean_reward,rate,dqn_loss,dqn_rate,epsilon";

fn place() -> Place {
    Place::new(SETTINGS, HEADER)
}

/// Returns the number of world steps at the end of a training. Checks that its last loss is finite.
fn steps(place: &Place, out: &str) -> String {
    let rows = place.rows(out);
    let row = rows.last().expect("rows");
    let loss: f64 = row[6].parse().expect("a loss");
    assert!(loss.is_finite(), "{loss}");
    row[1].clone()
}

/// Returns the name of the estimator of saved decisions.
fn saved(place: &Place, out: &str) -> String {
    let state: SavedDecisions = place.contents(out).state().expect("its state");
    state.estimator
}

#[test]
fn decisions_are_learned_and_enter_the_ladder_beside_their_filter() {
    let place = place();
    place.train("out", &format!("{WORLDS} --steps 60"));
    let resume = format!("{WORLDS} --resume");
    place.train("out", &resume);
    assert_eq!(
        steps(&place, "out"),
        "100",
        "the remaining steps of the settings"
    );
    place.refuse("out", &resume, "expected a number of steps, as all 100");
    let policies = [
        "learned/options/exploit_ahead_3",
        "learned/options/rule",
        "learned_policy",
    ];
    let compared = place.compare("out", &format!("--policies {}", policies.join(",")));
    for policy in policies {
        compared.check_prints(policy);
    }
    place.train(
        "other",
        &format!("{WORLDS} --learner filter --agent-seed 5 --steps 40"),
    );
    let [decisions, filter, other] = ["out", "out/belief", "other"].map(|out| place.flag(out));
    let one = "--policies known/options/learned --baseline coverage";
    let words =
        "known/options/learned | expected decisions on the belief known, got decisions on learned";
    check(
        AGENT,
        &format!("compare {COMPARED} {one} {decisions}"),
        words,
    );
    let policies = "--policies learned_policy,learned_beam --baseline learned_beam";
    let compare = format!("compare {COMPARED} {policies}");
    agent(&format!("{compare} {decisions} {filter}"));
    agent(&format!("{compare} {filter} {decisions}"));
    for both in [[&decisions, &other], [&other, &decisions]] {
        let both = format!("{compare} {} {}", both[0], both[1]);
        check(AGENT, &both, "checkpoint | expected one | got two");
    }
}

#[test]
fn a_training_that_ended_in_its_filter_resumes_there() {
    let place = place();
    let first = format!("{WORLDS} --estimator learned+spatial");
    place.set(&SETTINGS.replace("filter_steps = 40", "filter_steps = 1000000"));
    let program = Program::start(AGENT, &place.words("out", &first));
    program.wait_for_words("learning");
    program.signal(Signal::INT);
    program.wait(LIMIT).check(0);
    assert!(!place.checkpoint("out").exists());
    place.set(SETTINGS);
    let resume = format!("{WORLDS} --resume --steps 20");
    place.train("out", &resume);
    assert_eq!(saved(&place, "out"), "learned+spatial");
    // The checkpoint now contains decisions, from which a training can resume.
    let filter = place.flag("out/belief");
    let model = repository().join("config/models/wildfire-small.toml");
    let model = std::fs::read_to_string(model).expect("a model");
    let smoke = "observations = [\n{ name = \"smoke\", color = \"#808080\" },";
    let model = model.replacen("observations = [", smoke, 1);
    let model = model.replace("observed_as = [0.", "observed_as = [0.1, 0.");
    let model = model.replace("0.98", "0.88").replace("0.80", "0.70");
    let model = format!("--model {}", place.folder.write("smoke.toml", model));
    place.refuse_all(
        "out",
        &resume,
        &format!(
            "--estimator learned => --resume | cannot be used with | --estimator
{filter} => --resume | cannot be used with | --checkpoint
{model} => checkpoint: expected the world's 4 observations, got 3"
        ),
    );
    place.train("out", &resume);
    assert_eq!(steps(&place, "out"), "40");
    // A filter given by `--checkpoint` must be the estimator's filter.
    let server = Server::start(&format!("{SMALL} --worlds 2 --reveal-model false"));
    let given = format!("{} --worlds 2 --steps 4", on(&server));
    place.refuse_all(
        "given",
        &format!("{given} {filter}"),
        "--estimator known => --checkpoint | known
--learner filter => --checkpoint applies only with --learner neural or decisions",
    );
    let spatial = "--estimator learned+spatial";
    place.train("given", &format!("{given} {filter} {spatial}"));
    assert!(!place.folder.path("given/belief").exists());
    place.refuse_all(
        "hidden",
        &given,
        "--learner filter --estimator known => --estimator applies only with
--estimator known => --reveal-model true
--estimator filter => --estimator | got",
    );
}

#[test]
fn decisions_on_a_known_model_go_on_with_it() {
    let place = place();
    for out in ["out", "same"] {
        place.train(out, &format!("{WORLDS} --estimator known --steps 20"));
        place.train(out, &format!("{WORLDS} --resume --steps 30"));
    }
    assert_eq!(steps(&place, "out"), "50");
    assert_eq!(saved(&place, "out"), "known");
    let is_same = place.bytes("out") == place.bytes("same");
    assert!(is_same, "checkpoints of the same training differ");
}
