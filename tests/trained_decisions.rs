//! `emberwatch-agent train --learner decisions`: a filter first, then which option to fly.

use crate::commands::{agent, check};
use crate::trainings::Place;
use emberwatch_learning::checkpoint;
use emberwatch_learning::config::{AgentConfig, KernelKind};
use emberwatch_learning::learners::decisions::SavedDecisions;
use tests::harness::{AGENT, SMALL, Server, repository};

/// A private server with small worlds.
const WORLDS: &str = "--worlds 2 --height 6 --width 9 --moves 5 --burn-in 60";

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

/// World steps and updates' losses at the end of a training.
fn last(place: &Place, out: &str) -> (String, f64) {
    let rows = place.rows(out);
    let row = rows.last().expect("rows");
    (row[1].clone(), row[6].parse().expect("a loss"))
}

fn settings(place: &Place, out: &str) -> AgentConfig {
    let (_, contents) = checkpoint::read(&place.checkpoint(out)).expect("a checkpoint");
    contents.settings().expect("its settings")
}

fn saved(place: &Place, out: &str) -> SavedDecisions {
    let (_, contents) = checkpoint::read(&place.checkpoint(out)).expect("a checkpoint");
    contents.state().expect("its state")
}

/// Comparing on small worlds.
fn compare(flags: &str) -> String {
    format!(
        "compare --seeds 3..5 --steps 5 --height 6 --width 9 --moves 5 --burn-in 60 --beam-width 4 {flags}"
    )
}

#[test]
fn decisions_are_learned_and_enter_the_ladder() {
    let place = place();
    place.train("out", &format!("{WORLDS} --steps 60"));
    place.train("out", &format!("{WORLDS} --resume"));
    let (steps, loss) = last(&place, "out");
    assert_eq!(steps, "100", "those that were left of the settings");
    assert!(loss.is_finite(), "{loss}");
    let done = place.words("out", &format!("{WORLDS} --resume"));
    check(AGENT, &done, "--steps: expected a number, as the 100");
    let checkpoint = place.checkpoint("out");
    let options = compare("--policies options");
    let compared = agent(&format!("{options} --checkpoint {}", checkpoint.display()));
    for words in [
        "random_walk",
        "learned/options/exploit_ahead_3",
        "learned/options/rule",
        "learned_policy",
        "differences are paired by world, to learned/options/exploit;",
    ] {
        compared.check_prints(words.trim_end_matches(';'));
    }
    check(AGENT, &options, "options | --checkpoint FILE");
    let one = compare("--policies known/options/learned --baseline coverage");
    let one = format!("{one} --checkpoint {}", checkpoint.display());
    check(
        AGENT,
        &one,
        "known/options/learned | expected decisions on the belief known, got some on learned",
    );
}

#[test]
fn decisions_and_their_filter_are_given_in_either_order() {
    let place = place();
    place.train("out", &format!("{WORLDS} --steps 10"));
    let other = format!("{WORLDS} --learner filter --agent-seed 5 --steps 40");
    place.train("other", &other);
    let flag = |out: &str| format!("--checkpoint {}", place.checkpoint(out).display());
    let [decisions, filter, other] = ["out", "out/belief", "other"].map(flag);
    let policies = "--policies learned_policy,learned_beam --baseline learned_beam";
    for both in [[&decisions, &filter], [&filter, &decisions]] {
        let [first, second] = both;
        agent(&compare(&format!("{policies} {first} {second}")));
    }
    for both in [[&decisions, &other], [&other, &decisions]] {
        let [first, second] = both;
        let refused = compare(&format!("{policies} {first} {second}"));
        check(AGENT, &refused, "checkpoint | expected one | got two");
    }
}

#[test]
fn a_training_that_ended_in_its_filter_resumes_there() {
    let place = place();
    let first = format!("{WORLDS} --estimator learned_spatial_filter --kernels own");
    let cut = place.words("out", &format!("{first} --time-limit 0"));
    let words = "the belief is not learned yet: continue with --resume";
    check(AGENT, &cut, words);
    assert!(!place.checkpoint("out").exists());
    let resume = format!("{WORLDS} --resume --steps 20");
    let refused = |flags: &str, words: &str| {
        check(
            AGENT,
            &place.words("out", &format!("{resume} {flags}")),
            words,
        );
    };
    refused("--freeze", "--freeze: expected a checkpoint of decisions");
    let other = "--estimator: expected learned_spatial_filter as in the checkpoint, got";
    refused("--estimator known_model", other);
    place.train("out", &format!("{resume} --time-limit 1e19"));
    assert_eq!(saved(&place, "out").estimator, "learned_spatial_filter");
    assert_eq!(settings(&place, "out").kernels, KernelKind::Own);
    // From here on there are decisions to go on from.
    refused("--estimator learned_filter", other);
    let filter = place.checkpoint("out/belief");
    let given = format!(
        "--estimator learned_spatial_filter --checkpoint {}",
        filter.display()
    );
    refused(&given, "--checkpoint: expected none beside --resume");
    let model = repository().join("config/models/wildfire-small.toml");
    let model = std::fs::read_to_string(model).expect("a model");
    let smoke = "[[observations]]\nname = \"smoke\"\ncolor = \"#808080\"\n\n[[kernel]]";
    let rows = model.replacen("[[kernel]]", smoke, 1);
    let rows = rows.replace("observed_as = [0.", "observed_as = [0.1, 0.");
    let rows = rows.replace("0.98", "0.88").replace("0.80", "0.70");
    std::fs::write(place.path("smoke.toml"), rows).expect("written");
    let model = format!("--model {}", place.path("smoke.toml").display());
    refused(
        &model,
        "checkpoint: expected 4 observations as the world's, got 3",
    );
    place.train("out", &resume);
    assert_eq!(last(&place, "out").0, "40");
}

#[test]
fn decisions_on_a_known_model_go_on_with_it() {
    let place = place();
    place.train(
        "out",
        &format!("{WORLDS} --estimator known_model --steps 20"),
    );
    place.train("out", &format!("{WORLDS} --resume --steps 10"));
    assert_eq!(last(&place, "out").0, "30");
    assert_eq!(saved(&place, "out").estimator, "known_model");
    let server = Server::start(&format!("{SMALL} --worlds 2 --reveal-model false"));
    let flags = format!("--instance {} --worlds 2 --steps 4", server.instance.name());
    let words = |flags: &str| place.words("hidden", flags);
    let known = format!("{flags} --estimator known_model");
    check(AGENT, &words(&known), "--reveal-model true");
    let wrong = format!("{flags} --estimator filter");
    check(AGENT, &words(&wrong), "--estimator | got");
}

#[test]
fn episodes_no_longer_than_the_returns_teach() {
    let place = place();
    for episode_steps in [1, 4, 5] {
        let steps = format!("episode_steps = {episode_steps}");
        place.set(&SETTINGS.replace("episode_steps = 9", &steps));
        let outs = ["a", "b"].map(|name| {
            let out = format!("{name}{episode_steps}");
            place.train(
                &out,
                &format!("{WORLDS} --estimator known_model --steps 40"),
            );
            out
        });
        let (_, loss) = last(&place, &outs[0]);
        assert!(loss.is_finite(), "{loss}");
        // Each step of an episode that is over, and of the others those whose return is complete.
        let n_over = 20 / episode_steps * episode_steps;
        let n_open = (20_usize % episode_steps).saturating_sub(4);
        let n = saved(&place, &outs[0]).dqn.transitions.len();
        assert_eq!(n, 2 * (n_over + n_open), "{episode_steps}");
        let [one, same] = outs.map(|out| std::fs::read(place.checkpoint(&out)).expect("a file"));
        assert!(one == same, "checkpoints of the same training differ");
    }
}

#[test]
fn a_filter_that_was_given_is_the_estimator_s() {
    let place = place();
    place.train("own", &format!("{WORLDS} --kernels own --steps 40"));
    let server = Server::start(&format!("{SMALL} --worlds 2 --reveal-model false"));
    let flags = format!(
        "--instance {} --worlds 2 --steps 4 --checkpoint {}",
        server.instance.name(),
        place.checkpoint("own").display()
    );
    for (more, words) in [
        ("--estimator known_model", "--checkpoint | known_model"),
        (
            "--learner filter",
            "--checkpoint: expected none, or --learner decisions",
        ),
        (
            "--learner filter --estimator known_model",
            "--estimator: expected none, or",
        ),
    ] {
        let refused = place.words("given", &format!("{flags} {more}"));
        check(AGENT, &refused, words);
    }
    place.train(
        "given",
        &format!("{flags} --estimator learned_spatial_filter"),
    );
    assert!(!place.path("given/belief").exists());
}

#[test]
fn decisions_of_an_earlier_release_resume_with_own_kernels() {
    let place = place();
    place.train("out", &format!("{WORLDS} --kernels own --steps 20"));
    let path = place.checkpoint("out");
    let (kind, mut contents) = checkpoint::read(&path).expect("a checkpoint");
    let mut decisions: SavedDecisions = contents.state().expect("its state");
    decisions.estimator = "learned_own_filter".into();
    contents.set_state(&decisions);
    let new = "kernels = \"own\"\n";
    assert!(contents.settings.contains(new), "{}", contents.settings);
    let without = contents.settings.replace(new, "");
    contents.settings = without.replace("learned_filter", "learned_own_filter");
    checkpoint::write(&path, &kind, &contents).expect("written");
    agent(&compare(&format!("--checkpoint {}", path.display()))).check_prints("learned_policy");
    place.train("out", &format!("{WORLDS} --resume --steps 4"));
    assert_eq!(settings(&place, "out").kernels, KernelKind::Own);
    assert_eq!(saved(&place, "out").estimator, "learned_filter");
}
