//! Tests of `emberwatch-agent train` with the autoencoder: the paper's Algorithm 1 on small worlds.

use crate::commands::{agent, check};
use crate::trainings::{COMPARED, Place, on};
use tests::harness::{AGENT, Server};

/// A server with one small world.
const WORLD: &str = "--height 6 --width 9 --moves 5 --burn-in 60";

/// Settings with which both networks start to learn after a few steps.
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

/// Columns of the metrics.
const HEADER: &str = "update,world_steps,loss,held_out_log_likelihood,mean_reward,rate,\
                      dqn_loss,dqn_rate,action,action_value,epsilon";
const LOSS: usize = 2;
const DQN_LOSS: usize = 6;

fn place() -> Place {
    Place::new(SETTINGS, HEADER)
}

#[test]
fn networks_learn_with_one_step_and_with_several() {
    for settings in [SETTINGS, &SETTINGS.replace("[dqn]", "[dqn]\nn_step = 3")] {
        let place = Place::new(settings, HEADER);
        let rows = place.learn("out", &format!("{WORLD} --steps 24"));
        for column in [LOSS, DQN_LOSS] {
            let losses = rows
                .iter()
                .filter_map(|row| row[column].parse::<f64>().ok());
            let losses: Vec<f64> = losses.collect();
            assert!(losses.len() >= 18, "{column}: {losses:?}");
            assert!(losses.iter().all(|loss| loss.is_finite()), "{losses:?}");
        }
    }
}

#[test]
fn a_checkpoint_is_resumed_and_acted_on() {
    let place = place();
    let rows = place.learn("out", &format!("{WORLD} --steps 20"));
    for policy in ["autoencoder/shooting/learned", "autoencoder/beam/exploit"] {
        let flags = format!("--policies {policy},coverage --baseline coverage");
        place.compare("out", &flags).check_prints(policy);
    }
    let (ladder, flag) = (place.compare("out", ""), place.flag("out"));
    for policy in [
        "autoencoder/shooting/exploit",
        "autoencoder/shooting/explore",
        "autoencoder/shooting/learned",
    ] {
        ladder.check_prints(policy);
    }
    let server = Server::start(WORLD);
    let run = format!(
        "run {} --steps 5 --policy autoencoder/shooting/learned",
        on(&server)
    );
    agent(&format!("{run} {flag}"));
    let words = "autoencoder/shooting/learned | needs --checkpoint FILE: expected a checkpoint of `train --learner autoencoder`";
    check(AGENT, &run, words);
    let twice = format!("compare {flag} {flag} {COMPARED}");
    check(
        AGENT,
        &twice,
        "expected one checkpoint of autoencoder, got two",
    );
    let other = COMPARED.replace("--height 6", "--height 7");
    let other = format!("compare --policies autoencoder/beam/exploit {flag} {other}");
    check(
        AGENT,
        &other,
        "expected a network for the world's grid, 7 x 9 | got one for 6 x 9",
    );

    place.refuse(
        "out",
        &format!("{WORLD} --steps 11"),
        "--out | add --resume",
    );
    // Resuming drops rows that are newer than the checkpoint or cut
    // short.
    let metrics = place.folder.text("out/metrics.csv");
    let last = metrics
        .lines()
        .last()
        .expect("rows")
        .replace(",20,", ",21,");
    place.folder.write(
        "out/metrics.csv",
        format!("{metrics}{last}\n{}", &last[..9]),
    );
    let after = place.learn("out", &format!("{WORLD} --steps 10 --resume"));
    assert_eq!(after[..20], rows[..]);
    assert!(
        after[20..]
            .iter()
            .map(|row| &*row[1])
            .eq((21..31).map(|n| n.to_string()))
    );
    assert!(!after[29][LOSS].is_empty());
    place.folder.write("out/metrics.csv", "update,loss\n");
    let words = "metrics.csv: expected the columns update,world_steps | got update,loss";
    place.refuse("out", &format!("{WORLD} --steps 5 --resume"), words);
}

#[test]
fn episodes_that_end_are_begun_again() {
    let place = Place::new(&SETTINGS.replace("[dqn]", "[dqn]\nn_step = 2"), HEADER);
    let server = Server::start(&format!("{WORLD} --coverage client --max-steps 7"));
    let rows = place.learn("out", &format!("{} --steps 30", on(&server)));
    assert!(!rows[29][LOSS].is_empty() && !rows[29][DQN_LOSS].is_empty());
    assert_eq!(server.step_of(0), 30 % 7);
    place.learn("out", &format!("{} --steps 3 --resume", on(&server)));
    assert_eq!(server.step_of(0), 3);
    // Here a window of frames covers a whole episode.
    let server = Server::start(&format!("{WORLD} --coverage client --max-steps 3"));
    let rows = place.learn("whole", &format!("{} --steps 9", on(&server)));
    assert!(!rows[8][LOSS].is_empty());
    let few = place.train("few", &format!("{} --steps 2", on(&server)));
    few.check_says("nothing was learned in 2 world steps");
}

#[test]
fn what_does_not_fit_is_named() {
    let place = place();
    let two = "--worlds: expected 1 for the autoencoder | got 2";
    place.refuse("out", &format!("{WORLD} --worlds 2"), two);
    for (flags, words) in [
        ("", "autoencoder.full_frames: 6 frames | --coverage client"),
        (
            "--coverage client --max-steps 2",
            "autoencoder.window: expected at most the 3 frames | got 4",
        ),
    ] {
        let server = Server::start(&format!("{WORLD} {flags}"));
        place.refuse("out", &on(&server), words);
    }
    place.learn("out", &format!("{WORLD} --steps 8"));
    for (from, to, words) in [
        (
            "[dqn]",
            "hidden = 5\n[dqn]",
            "decoder.0.weight: expected shape [5, 128, 1, 1], got [4, ",
        ),
        (
            "learner = \"autoencoder\"\n",
            "",
            "expected a checkpoint of learned_filter, got one of autoencoder",
        ),
    ] {
        place.set(&SETTINGS.replace(from, to));
        place.refuse("out", &format!("{WORLD} --steps 8 --resume"), words);
    }
}
