//! `emberwatch-agent train` with the autoencoder: the paper's Algorithm 1, small.

use crate::commands::{agent, check};
use crate::trainings::Place;
use emberwatch_learning::checkpoint::{self, Contents};
use emberwatch_learning::learners::network::SavedNetwork;
use emberwatch_protocol::Move;
use std::path::Path;
use tests::harness::{AGENT, Server, fly};

/// A server with one small world.
const WORLD: &str = "--height 6 --width 9 --moves 5 --burn-in 60";

/// Settings with which both networks learn after a few steps.
const SETTINGS: &str = "learner = \"autoencoder\"
shooting_samples = 16
[autoencoder]
window = 4
replay_frames = 12
full_frames = 6
[dqn]
batch = 4
replay = 20
";

/// The same as the paper prints it.
fn printed() -> String {
    let objective = "[objective]\nbelief = \"estimate\"\n";
    SETTINGS.replace("[autoencoder]\n", &format!("{objective}[autoencoder]\n"))
}

/// Columns of the metrics.
const HEADER: &str = "update,world_steps,loss,held_out_log_likelihood,mean_reward,rate,\
                      dqn_loss,dqn_rate,action,action_value,epsilon";
const LOSS: usize = 2;
const DQN_LOSS: usize = 6;

fn place(settings: &str) -> Place {
    Place::new(settings, HEADER)
}

/// What a checkpoint holds, but for its settings.
fn contents(path: &Path) -> Contents {
    let (_, mut contents) = checkpoint::read(path).expect("a checkpoint");
    contents.settings.clear();
    contents
}

fn state(contents: &Contents) -> SavedNetwork {
    contents.state().expect("its state")
}

#[test]
fn the_same_seed_gives_the_same_losses_bit_for_bit() {
    let place = place(SETTINGS);
    let train =
        |out: &str, seed: u64| place.learn(out, &format!("{WORLD} --steps 30 --agent-seed {seed}"));
    let [a, b, c] = [("a", 5), ("b", 5), ("c", 6)].map(|(out, seed)| train(out, seed));
    assert_eq!(a, b);
    let [one, same] = ["a", "b"].map(|out| std::fs::read(place.checkpoint(out)).expect("a file"));
    assert!(one == same, "checkpoints of the same training differ");
    assert_ne!(a, c);
    for column in [LOSS, DQN_LOSS] {
        let losses: Vec<f64> = a
            .iter()
            .filter_map(|row| row[column].parse().ok())
            .collect();
        assert!(losses.len() >= 26, "{column}: {losses:?}");
        assert!(losses.iter().all(|loss| loss.is_finite()), "{losses:?}");
    }
}

#[test]
fn a_training_that_stopped_goes_on_as_if_it_had_not() {
    goes_on_as_if_it_had_not_stopped(SETTINGS);
    goes_on_as_if_it_had_not_stopped(&printed());
    goes_on_as_if_it_had_not_stopped(&SETTINGS.replace("[dqn]", "[dqn]\nn_step = 3"));
}

fn goes_on_as_if_it_had_not_stopped(settings: &str) {
    let place = place(settings);
    let flags = format!("{WORLD} --coverage client");
    let whole = Server::start(&flags);
    let name = whole.instance.name();
    let whole = place.learn("whole", &format!("--instance {name} --steps 24"));
    let parts = Server::start(&flags);
    let name = parts.instance.name();
    place.learn("parts", &format!("--instance {name} --steps 11"));
    let again = place.words("parts", &format!("--instance {name} --steps 11"));
    check(AGENT, &again, "--out | expected --resume");
    let parts = place.learn("parts", &format!("--instance {name} --steps 13 --resume"));
    assert_eq!(whole, parts);
    let checkpoint = |out| contents(&place.checkpoint(out));
    assert_eq!(checkpoint("whole"), checkpoint("parts"));
}

#[test]
fn settings_of_sizes_and_of_plans_reach_the_training() {
    let settings = [
        ("", ""),
        ("[autoencoder]\n", "[autoencoder]\nstates = 2\n"),
        (
            "[autoencoder]\n",
            "[objective]\nbelief = \"estimate\"\n[autoencoder]\n",
        ),
    ];
    let runs = settings.map(|(from, to)| {
        let place = place(&SETTINGS.replacen(from, to, 1));
        let rows = place.learn("out", &format!("{WORLD} --steps 8"));
        let loss = rows.into_iter().find(|row| !row[LOSS].is_empty());
        (loss.expect("an update"), contents(&place.checkpoint("out")))
    });
    let [(default, stored), others @ .., (_, planned)] = runs;
    for (index, (other, _)) in others.iter().enumerate() {
        assert_eq!(default[1], other[1], "the same step");
        assert_ne!(default[LOSS], other[LOSS], "{index}");
    }
    // Only shown in part, as paths are flown.
    let [stored, planned] = [stored, planned].map(|contents| state(&contents));
    assert_ne!(stored.frames, planned.frames);
    assert!(stored.position.estimate.is_none() && planned.position.estimate.is_some());
}

#[test]
fn actions_go_by_the_hidden_vector() {
    let place = place(SETTINGS);
    place.learn("out", &format!("{WORLD} --steps 15"));
    let stored = state(&contents(&place.checkpoint("out")));
    let transitions = stored.dqn.transitions;
    assert_eq!(transitions.len(), 15);
    for pair in transitions.windows(2) {
        assert_eq!((pair[0].next.len(), &pair[0].next), (4, &pair[1].input));
    }
    assert_eq!(transitions[14].next, stored.position.follower.hidden());
    let checkpoint = place.checkpoint("out");
    let checkpoint = checkpoint.display();
    let worlds = format!("--seeds 3..4 --steps 5 {WORLD} --shooting-samples 16");
    let policies = "--policies autoencoder_policy,coverage --baseline coverage";
    let compared = agent(&format!(
        "compare {policies} --checkpoint {checkpoint} {worlds}"
    ));
    compared.check_prints("autoencoder_policy");
}

#[test]
fn another_world_is_begun_again() {
    let place = place(SETTINGS);
    place.learn("out", &format!("{WORLD} --steps 20"));
    let rows = place.learn("out", &format!("{WORLD} --steps 20 --resume --seed 7"));
    assert_eq!(rows.len(), 40);
    assert_eq!(rows[39][1], "40");
    assert!(!rows[39][LOSS].is_empty());
}

#[test]
fn frozen_networks_stay_as_they_are() {
    let place = place(SETTINGS);
    let learned = place.learn("out", &format!("{WORLD} --steps 20"));
    let checkpoint = std::fs::read(place.checkpoint("out")).expect("a checkpoint");
    let after = place.learn("out", &format!("{WORLD} --steps 9 --resume --freeze"));
    assert_eq!(learned, after, "metrics of learning");
    let again = std::fs::read(place.checkpoint("out")).expect("a checkpoint");
    assert!(checkpoint == again, "the checkpoint changed");
    let frozen = std::fs::read_to_string(place.path("out").join("frozen.csv"));
    assert_eq!(frozen.expect("its own metrics").lines().count(), 1 + 9);
}

#[test]
fn a_kill_costs_no_more_than_the_steps_since_the_checkpoint() {
    let place = place(SETTINGS);
    let rows = place.learn("out", &format!("{WORLD} --steps 20"));
    let metrics = place.path("out").join("metrics.csv");
    let text = std::fs::read_to_string(&metrics).expect("the metrics");
    let last = text.lines().last().expect("rows").replace(",20,", ",21,");
    // What a kill leaves: a row after the checkpoint, and half of another.
    std::fs::write(&metrics, format!("{text}{last}\n{}", &last[..9])).expect("written");
    let after = place.learn("out", &format!("{WORLD} --steps 5 --resume"));
    assert_eq!(after[..20], rows[..]);
    let steps: Vec<&str> = after[20..].iter().map(|row| &*row[1]).collect();
    assert_eq!(steps, ["21", "22", "23", "24", "25"]);
    std::fs::write(&metrics, "update,loss\n").expect("written");
    let resume = place.words("out", &format!("{WORLD} --steps 5 --resume"));
    let words = "metrics.csv: expected the columns update,world_steps | got update,loss";
    check(AGENT, &resume, words);
}

#[test]
fn episodes_that_end_are_begun_again() {
    let place = place(&SETTINGS.replace("[dqn]", "[dqn]\nn_step = 2"));
    let server = Server::start(&format!("{WORLD} --coverage client --max-steps 7"));
    let instance = format!("--instance {}", server.instance.name());
    let rows = place.learn("out", &format!("{instance} --steps 30"));
    assert!(!rows[29][LOSS].is_empty() && !rows[29][DQN_LOSS].is_empty());
    assert_eq!(server.status().worlds[0].info.step, 30 % 7);
    // An agent that stopped at an episode's end leaves a world that only a reset goes on from.
    let mut client = server.acquire(0..1);
    for _ in 30 % 7..7 {
        fly(&mut client, vec![Move::Up; 5]);
    }
    client.release().expect("released");
    let rows = place.learn("out", &format!("{instance} --steps 3 --resume"));
    assert_eq!(rows.len(), 33);
    assert_eq!(server.status().worlds[0].info.step, 3);
}

#[test]
fn episodes_shorter_than_a_window_are_refused() {
    let place = place(SETTINGS);
    for (max_steps, n_frames) in [(1, 2), (2, 3)] {
        let server = Server::start(&format!(
            "{WORLD} --coverage client --max-steps {max_steps}"
        ));
        let words = place.words("out", &format!("--instance {}", server.instance.name()));
        let expected =
            format!("autoencoder.window: expected at most the {n_frames} frames | got 4");
        check(AGENT, &words, &expected);
    }
    let server = Server::start(&format!("{WORLD} --coverage client --max-steps 3"));
    let flags = format!("--instance {} --steps 9", server.instance.name());
    let rows = place.learn("out", &flags);
    assert!(!rows[8][LOSS].is_empty(), "a window is a whole episode");
    let few = place.train(
        "few",
        &format!("{flags} --steps 2").replace("--steps 9 ", ""),
    );
    few.check_says(
        "nothing was learned in 2 world steps: an update learns from a window of 4 frames",
    );
}

#[test]
fn full_observation_tells_which_state_pays() {
    let place = place(SETTINGS);
    let server = Server::start(&format!("{WORLD} --coverage full"));
    let name = server.instance.name();
    let rows = place.learn("out", &format!("--instance {name} --steps 30"));
    assert!(!rows[29][LOSS].is_empty());
    let rewards: f64 = rows
        .iter()
        .filter_map(|row| row[4].parse::<f64>().ok())
        .sum();
    let estimate = state(&contents(&place.checkpoint("out")))
        .position
        .reward
        .rewards;
    assert_eq!(rewards > 0.0, estimate.iter().sum::<f64>() > 0.0);
}

#[test]
fn numbers_that_are_not_finite_stop_training_with_a_checkpoint() {
    for (section, tensor) in [("autoencoder", "decoder.0.weight"), ("dqn", "dqn.network")] {
        let place = place(SETTINGS);
        place.learn("out", &format!("{WORLD} --steps 10"));
        let path = place.checkpoint("out");
        let (_, mut broken) = checkpoint::read(&path).expect("a checkpoint");
        let numbers = broken.tensors.iter_mut();
        for (name, stored) in numbers {
            if name.starts_with(tensor) {
                // Finite, so that it is read, and too large to be worked with.
                stored.numbers.fill(3e38);
            }
        }
        checkpoint::write(&path, "autoencoder", &broken).expect("written");
        let resume = place.words("out", &format!("{WORLD} --steps 10 --resume"));
        let words = "world steps: update  | expected finite numbers | is in";
        check(AGENT, &resume, words);
        let saved = contents(&path);
        assert!(saved.tensors.contains_key("W_obs_param"), "{section}");
        // What was saved is read again, and stops again.
        check(AGENT, &resume, words);
    }
}

#[test]
fn a_checkpoint_enters_the_ladder() {
    let place = place(SETTINGS);
    place.learn("out", &format!("{WORLD} --steps 12"));
    let checkpoint = place.checkpoint("out");
    let checkpoint = checkpoint.display();
    let worlds = format!("--seeds 3..5 --steps 5 {WORLD} --beam-width 4 --shooting-samples 16");
    let compared = agent(&format!("compare --checkpoint {checkpoint} {worlds}"));
    let evaluated = agent(&format!("evaluate --checkpoint {checkpoint} {worlds}"));
    for policy in [
        "autoencoder_exploit",
        "autoencoder/shooting/explore",
        "autoencoder_policy",
        "autoencoder/beam/exploit",
    ] {
        compared.check_prints(policy);
        evaluated.check_prints(policy);
    }
    evaluated.check_prints("autoencoder - known_model");
    let server = Server::start(WORLD);
    let name = server.instance.name();
    let run = format!("run --instance {name} --steps 5 --policy autoencoder_policy");
    agent(&format!("{run} --checkpoint {checkpoint}"));
    let words = "autoencoder_policy | needs --checkpoint FILE: expected a checkpoint of `train --learner autoencoder`";
    check(AGENT, &run, words);
    let twice = format!("compare --checkpoint {checkpoint} --checkpoint {checkpoint} {worlds}");
    let words = "expected one checkpoint of autoencoder, got two";
    check(AGENT, &twice, words);
    let other = worlds.replace("--height 6", "--height 7");
    let other =
        format!("compare --policies autoencoder/beam/exploit --checkpoint {checkpoint} {other}");
    let words = "expected a network for 7 x 9 cells | got one for 6 x 9";
    check(AGENT, &other, words);
}

#[test]
fn what_does_not_fit_is_named() {
    let place = place(SETTINGS);
    let words = |flags: &str| place.words("out", flags);
    let two = words(&format!("{WORLD} --worlds 2"));
    check(
        AGENT,
        &two,
        "--worlds: expected 1 for the autoencoder | got 2",
    );
    let server = Server::start(WORLD);
    let instance = format!("--instance {}", server.instance.name());
    let full = "autoencoder.full_frames: 6 frames | --coverage client";
    check(AGENT, &words(&instance), full);
    place.learn("out", &format!("{WORLD} --steps 8"));
    let resume = words(&format!("{WORLD} --steps 8 --resume"));
    let check_settings = |settings: &str, expected: &str| {
        place.set(settings);
        check(AGENT, &resume, expected);
    };
    check_settings(
        &SETTINGS.replace("[dqn]", "hidden = 5\n[dqn]"),
        "decoder.0.weight: expected shape [5, 128, 1, 1], got [4, ",
    );
    check_settings(
        &SETTINGS.replace("learner = \"autoencoder\"\n", ""),
        "expected a checkpoint of learned_filter, got one of autoencoder",
    );
}
