//! `emberwatch-agent train` and what becomes of its checkpoints.

use crate::commands::{agent, check, check_table};
use crate::trainings::Place;
use emberwatch_learning::checkpoint::{self, Contents};
use emberwatch_learning::learners::filter::SavedFilter;
use emberwatch_learning::learners::filter::fit::FilterFit;
use emberwatch_protocol::Move;
use rustix::process::Signal;
use std::ffi::OsString;
use std::path::Path;
use tempfile::TempDir;
use tests::harness::{AGENT, LIMIT, Program, SMALL, Server, fly, run};

/// A private server with small worlds.
const WORLDS: &str = "--worlds 2 --height 6 --width 9 --moves 5 --burn-in 60";

/// Settings with which learning starts after 16 world steps of two worlds.
const SETTINGS: &str = "[learning]
window = 2
streams = 4
block_windows = 2
explore_steps = 40
updates_per_step = 1.0
";

const HEADER: &str = "update,world_steps,loss,held_out_log_likelihood,mean_reward,rate";

fn place() -> Place {
    Place::new(SETTINGS, HEADER)
}

fn read(checkpoint: &Path) -> Contents {
    let (_, contents) = checkpoint::read(checkpoint).expect("a checkpoint");
    contents
}

fn learner(contents: &Contents) -> FilterFit {
    contents.state::<SavedFilter>().expect("its state").fit
}

fn bytes(path: &Path) -> Vec<u8> {
    std::fs::read(path).expect("a readable file")
}

#[test]
fn the_same_seed_gives_the_same_losses_bit_for_bit() {
    let place = place();
    for (out, seed) in [("a", 5), ("b", 5), ("c", 6)] {
        place.train(out, &format!("{WORLDS} --steps 120 --agent-seed {seed}"));
    }
    let [a, b, c] = ["a", "b", "c"].map(|out| bytes(&place.checkpoint(out)));
    assert!(a == b, "checkpoints of the same training differ");
    assert!(a != c);
    let [a, b, c] = ["a", "b", "c"].map(|out| place.rows(out));
    assert_eq!(a, b);
    assert_ne!(a, c);
    let losses: Vec<f64> = a.iter().filter_map(|row| row[2].parse().ok()).collect();
    assert!(
        losses.len() > 80 && losses.iter().all(|loss| loss.is_finite()),
        "{losses:?}"
    );
    assert_eq!(a.last().map(|row| &*row[1]), Some("120"));
}

#[test]
fn a_training_that_made_no_update_says_why() {
    let place = place();
    let none = "nothing was learned in";
    let learner = format!("{SETTINGS}[decisions]\nbatch = 9\nupdates_per_step = 1.0\n");
    for (out, settings, flags, cause) in [
        (
            "filter",
            SETTINGS,
            "--steps 6",
            "6 world steps: an update needs 4 blocks of frames (learning.streams), and there were 2",
        ),
        (
            "decisions",
            &learner,
            "--learner decisions --estimator known_model --steps 14",
            "14 world steps: an update learns from 9 transitions, and the steps gave 6",
        ),
        (
            "neural",
            SETTINGS,
            "--learner neural --steps 30",
            "30 world steps: too few for an update at neural.updates_per_step = 0.03125",
        ),
    ] {
        place.set(settings);
        let ended = place.train(out, &format!("{WORLDS} {flags}"));
        ended.check_says(&format!("{none} {cause}"));
    }
    place.set(SETTINGS);
    let ended = place.train("learned", &format!("{WORLDS} --steps 60"));
    assert!(!ended.stderr.contains(none), "{}", ended.stderr);
    let ended = place.train("learned", &format!("{WORLDS} --steps 4 --resume --freeze"));
    assert!(!ended.stderr.contains(none), "{}", ended.stderr);
    let ended = place.train("learned", &format!("{WORLDS} --steps 4 --resume"));
    ended.check_says(none);
}

#[test]
fn training_goes_on_bit_for_bit_where_it_stopped() {
    // 60 steps end in mid-block, mid-window and in the walk; 120 after the first updates.
    for (stops, belief) in [
        (&[60_u64][..], "predictor"),
        (&[120], "estimate"),
        (&[22, 61, 100], "estimate"),
    ] {
        let place = place();
        let settings = format!("{SETTINGS}[objective]\nbelief = \"{belief}\"\n");
        place.set(&settings);
        let [whole, parts] = ["whole", "parts"].map(|out| {
            let server = Server::start(&format!("{SMALL} --worlds 2 --seed 4"));
            let train = |flags: String| {
                let name = server.instance.name();
                place.train(out, &format!("--instance {name} --worlds 2 {flags}"))
            };
            let mut done = 0;
            for &stop in stops.iter().filter(|_| out == "parts") {
                let resume = if done > 0 { "--resume" } else { "" };
                train(format!("--steps {} {resume}", stop - done));
                // Two worlds step at once.
                done = stop.next_multiple_of(2);
            }
            let resume = if done > 0 { "--resume" } else { "" };
            let ended = train(format!("--steps {} {resume}", 200 - done));
            assert!(!ended.stderr.contains("a new track"), "{}", ended.stderr);
            (place.rows(out), read(&place.checkpoint(out)))
        });
        assert_eq!(whole.0, parts.0, "{stops:?}");
        assert_eq!(whole.0.last().map(|row| &*row[1]), Some("200"));
        // Parameters, moments, replay, streams and beliefs alike.
        assert!(whole.1 == parts.1, "{stops:?}: checkpoints differ");
    }
}

#[test]
fn a_filter_learns_from_frames_that_show_every_cell() {
    let place = place();
    place.train("path", &format!("{WORLDS} --steps 120"));
    place.train("full", &format!("{WORLDS} --steps 120 --coverage full"));
    // The replay keeps 54 cells of a step, where a path of five moves shows at most six.
    let size = |out: &str| bytes(&place.checkpoint(out)).len();
    assert!(2 * size("full") > 3 * size("path"));
    // On a new server the replay begins empty, and fills with full frames again.
    place.train("full", &format!("{WORLDS} --steps 120 --resume"));
    assert!(2 * size("full") > 3 * size("path"));
    let refused = place.words(
        "full",
        &format!("{WORLDS} --steps 20 --resume --coverage path"),
    );
    check(
        AGENT,
        &refused,
        "--coverage: expected the checkpoint's, full",
    );
    let server = Server::start(&format!("{SMALL} --worlds 2"));
    let name = server.instance.name();
    for (flags, words) in [
        (
            format!("--instance {name} --worlds 1"),
            "full_frames: expected a server with --coverage client or full, got path",
        ),
        (
            format!("{WORLDS} --learner neural"),
            "--coverage applies only with --learner filter, got neural",
        ),
    ] {
        let refused = place.words("refused", &format!("{flags} --coverage full"));
        check(AGENT, &refused, words);
    }
}

#[test]
fn other_worlds_begin_new_tracks_and_an_empty_replay() {
    let place = place();
    place.train("out", &format!("{WORLDS} --steps 60"));
    let n_rows = place.rows("out").len();
    let refused = place.words("out", &format!("{WORLDS} --steps 60"));
    check(AGENT, &refused, "--out | expected --resume");
    let ended = place.train("out", &format!("{WORLDS} --steps 60 --resume"));
    ended.check_says("beliefs begin again robots=2");
    let files = std::fs::read_dir(place.path("out")).expect("the folder");
    let names = files.map(|file| file.expect("a file").file_name());
    let is_of_tensorboard = |name: &OsString| name.to_string_lossy().contains(".tfevents.");
    assert_eq!(names.filter(is_of_tensorboard).count(), 2, "a run each");
    let rows = place.rows("out");
    assert_eq!(rows[n_rows][1], "62", "world steps go on");
    let updates = |row: &Vec<String>| row[0].parse::<u64>().expect("a number");
    assert_eq!(
        updates(&rows[n_rows]),
        updates(&rows[n_rows - 1]),
        "an empty replay at first"
    );
    assert!(rows.last().map(updates) > rows.get(n_rows).map(updates));
    assert_eq!(rows.last().map(|row| &*row[1]), Some("120"));
}

#[test]
fn a_moved_world_begins_a_new_track_and_keeps_the_replay() {
    let place = place();
    let server = Server::start(&format!("{SMALL} --worlds 2"));
    let flags = format!("--instance {} --worlds 2", server.instance.name());
    place.train("out", &format!("{flags} --steps 60"));
    let n_rows = place.rows("out").len();
    fly(&mut server.acquire(0..1), vec![Move::from_low_bits(0); 6]);
    let ended = place.train("out", &format!("{flags} --steps 60 --resume"));
    ended.check_says("beliefs begin again robots=1");
    let rows = place.rows("out");
    let updates = |row: &Vec<String>| row[0].parse::<u64>().expect("a number");
    assert!(updates(&rows[n_rows]) > updates(&rows[n_rows - 1]));
}

#[test]
fn a_number_that_is_not_finite_ends_training_by_name() {
    let place = place();
    place.train("out", &format!("{WORLDS} --steps 80"));
    let checkpoint = place.checkpoint("out");
    // Finite, but a large step along it is not.
    let settings = format!("{SETTINGS}rate = 1.0\nobservation_rate = 100.0\n");
    place.set(&settings);
    let mut contents = read(&place.checkpoint("out"));
    for (name, number) in [("first_moment", f32::MAX), ("second_moment", 0.0)] {
        let tensor = contents.tensors.get_mut(&format!("likelihood.{name}"));
        tensor.expect("a moment").numbers[4] = number;
    }
    checkpoint::write(&checkpoint, "learned_filter", &contents).expect("written");
    let n_rows = place.rows("out").len();
    let next = learner(&contents).n_updates() + 1;
    let words = place.words("out", &format!("{WORLDS} --steps 80 --resume"));
    let ended = run(AGENT, &words).check(1);
    let expected = format!(
        "update {next}: likelihood: expected finite numbers, got a step to a number that is not; \
         what was learned before is in {}",
        checkpoint.display()
    );
    ended.check_says(&expected);
    assert!(!ended.stderr.contains("panicked"), "{}", ended.stderr);
    let saved = read(&place.checkpoint("out"));
    for name in ["kernel", "likelihood", "initial"] {
        let tensors = [&contents, &saved].map(|contents| contents.tensors.get(name));
        assert_eq!(tensors[0], tensors[1], "{name}: as before the update");
    }
    assert_eq!(learner(&saved).n_updates(), next - 1);
    assert!(place.rows("out").len() >= n_rows);
    // It reads back whole: a later run gets as far, and no further.
    check(AGENT, &words, "likelihood: expected finite numbers");
}

#[test]
fn frozen_parameters_stay_as_they_are() {
    let place = place();
    place.train("out", &format!("{WORLDS} --steps 80"));
    let (rows, checkpoint) = (place.rows("out"), bytes(&place.checkpoint("out")));
    place.train("out", &format!("{WORLDS} --steps 80 --resume --freeze"));
    assert_eq!(place.rows("out"), rows, "metrics of learning");
    assert!(bytes(&place.checkpoint("out")) == checkpoint);
    let frozen = std::fs::read_to_string(place.path("out").join("frozen.csv"));
    assert_eq!(frozen.expect("its own metrics").lines().count(), 1 + 40);
}

#[test]
fn a_signal_ends_training_with_a_checkpoint_and_a_free_world() {
    for signal in [Signal::INT, Signal::TERM] {
        let place = place();
        let server = Server::start(&format!("{SMALL} --worlds 2 --reveal-model false"));
        let name = server.instance.name();
        let words = place.words("out", &format!("--instance {name} --worlds 2"));
        let program = Program::start(AGENT, &words);
        program.until(|| server.status().n_steps > 40);
        program.signal(signal);
        program.wait(LIMIT).check(0);
        assert!(place.checkpoint("out").is_file());
        server.acquire(0..2);
    }
}

#[test]
fn a_server_that_dies_leaves_what_was_learned() {
    let place = place();
    let server = Server::start(&format!("{SMALL} --worlds 2"));
    let name = server.instance.name();
    let words = place.words("out", &format!("--instance {name} --worlds 2"));
    let program = Program::start(AGENT, &words);
    program.until(|| server.status().n_steps > 40);
    server.kill();
    let ended = program.wait(LIMIT).check(1);
    assert!(!ended.stderr.contains("panicked"), "{}", ended.stderr);
    assert!(place.checkpoint("out").is_file());
}

#[test]
fn episodes_that_end_are_begun_again() {
    let place = place();
    let server = Server::start(&format!("{SMALL} --worlds 2 --max-steps 9"));
    let name = server.instance.name();
    place.train("out", &format!("--instance {name} --worlds 2 --steps 80"));
    assert_eq!([0, 1].map(|world| server.step_of(world)), [40 % 9; 2]);
    let rows = place.rows("out");
    assert!(rows.last().is_some_and(|row| !row[2].is_empty()));
}

#[test]
fn a_checkpoint_is_compared_and_evaluated() {
    let place = place();
    place.train("out", &format!("{WORLDS} --steps 80"));
    place.train("own", &format!("{WORLDS} --steps 80 --kernels own"));
    let [checkpoint, own] = ["out", "own"].map(|out| place.checkpoint(out));
    let (checkpoint, own) = (checkpoint.display(), own.display());
    let worlds = "--seeds 3..5 --steps 5 --height 6 --width 9 --moves 5 --burn-in 60 \
                  --beam-width 4 --shooting-samples 16";
    for checkpoint in [&checkpoint, &own] {
        let compared = agent(&format!("compare --checkpoint {checkpoint} {worlds}"));
        let evaluated = agent(&format!("evaluate --checkpoint {checkpoint} {worlds}"));
        for policy in [
            "learned/shooting/exploit",
            "learned_beam",
            "learned_spatial_beam",
        ] {
            compared.check_prints(policy);
            evaluated.check_prints(policy);
        }
        for row in [
            "class frequencies",
            "known_model",
            "learned_filter - known_model",
        ] {
            evaluated.check_prints(row);
        }
    }
    let both = format!("compare --checkpoint {checkpoint} --checkpoint {own} {worlds}");
    check(
        AGENT,
        &both,
        "expected one checkpoint of learned_filter, got two",
    );
    let server = Server::start(SMALL);
    let name = server.instance.name();
    let flags = format!("--instance {name} --steps 5 --policy learned+spatial/beam/exploit");
    agent(&format!("run {flags} --checkpoint {own}"));
    let words = "learned_spatial_beam | needs --checkpoint FILE: expected a checkpoint of `train --learner filter`";
    check(AGENT, &format!("run {flags}"), words);
    let resume = format!("{WORLDS} --steps 8 --resume");
    let other = place.words("own", &format!("{resume} --kernels neighbours"));
    check(
        AGENT,
        &other,
        "--kernels: expected own as in the checkpoint, got neighbours",
    );
    place.train("own", &resume);
    for flags in [
        "--learner neural",
        "--learner decisions --estimator known_model",
        "--learner decisions --estimator neural_belief",
        "--learner decisions --resume",
    ] {
        let ignored = place.words("new", &format!("{WORLDS} {flags} --kernels own"));
        let words = "--kernels: expected a filter that is learned";
        check(AGENT, &ignored, words);
    }
}

#[test]
fn a_checkpoint_that_does_not_fit_is_refused_by_name() {
    let place = place();
    place.train("out", &format!("{WORLDS} --steps 40"));
    let checkpoint = place.checkpoint("out");
    let whole = bytes(&checkpoint);
    let resume = place.words("out", &format!("{WORLDS} --steps 8 --resume"));
    let settings = SETTINGS.replace("[learning]", "[learning]\nkernel = [5, 5]");
    place.set(&settings);
    let shape = "checkpoint.safetensors: kernel: expected shape [3, 3, 5, 5], got [3, 3, 3, 3]";
    check(AGENT, &resume, shape);
    let evaluate = format!(
        "evaluate --checkpoint {} --seeds 0..1 --steps 1 --height 4 --width 4 --moves 2 --burn-in 1",
        checkpoint.display()
    );
    std::fs::write(&checkpoint, &whole[..whole.len() / 2]).expect("cut");
    let damaged = "checkpoint.safetensors | damaged or cut off";
    check(AGENT, &resume, damaged);
    check(AGENT, &evaluate, damaged);
    let mut flipped = whole.clone();
    *flipped.last_mut().expect("not empty") ^= 1;
    std::fs::write(&checkpoint, flipped).expect("flipped");
    let words = "checkpoint.safetensors | expected contents with digest";
    check(AGENT, &resume, words);
    std::fs::write(&checkpoint, "not a checkpoint").expect("written");
    check(AGENT, &evaluate, damaged);
}

/// Flags of `train`, `evaluate` and `compare`, and the words of their refusal.
const WRONG_FLAGS: &str = "
train => --out
train --out /proc/no => create /proc/no
train --out /tmp --freeze => --resume
train --out OUT --worlds 0 => --worlds | 1..=1024
train --out OUT --instance nobody --wait 0 => no server on instance \"nobody\"
train --out OUT --instance a/b => instance name | \"a/b\"
train --out OUT --instance x --height 9 => --instance | --height
train --out OUT --time-limit=-1 => --time-limit | expected seconds
train --out OUT --time-limit soon => --time-limit | expected seconds
train --out OUT --model no.toml => model file no.toml | No such file
train --out OUT --world 3 => --world: expected 0
train --out OUT --server no/such => start no/such | No such file
train --out OUT --resume --burn-in 1 => checkpoint OUT/checkpoint.safetensors: No such file
evaluate => --checkpoint
evaluate --checkpoint no/such => checkpoint no/such: No such file
compare --checkpoint no/such => checkpoint no/such: No such file
compare --policies learned_beam => \"learned_beam\" needs --checkpoint FILE: expected a checkpoint of `train --learner filter`, got none
";

#[test]
fn wrong_flags_of_learners_are_named() {
    let folder = TempDir::new().expect("a folder");
    let out = folder.path().join("out");
    check_table(
        AGENT,
        &WRONG_FLAGS.replace("OUT", &out.display().to_string()),
    );
}

#[test]
fn worlds_and_settings_that_do_not_fit_are_named() {
    let place = place();
    let server = Server::start(SMALL);
    let words = |flags: &str| {
        let name = server.instance.name();
        place.words("out", &format!("--instance {name} {flags}"))
    };
    let more =
        "no such world: there are worlds 0 to 0; for more, set worlds (--worlds N of a server)";
    for flags in [
        "--worlds 2",
        "--worlds 1 --world 1",
        "--worlds 1 --world 4294967294",
    ] {
        check(AGENT, &words(flags), more);
    }
    let _held = server.acquire(0..1);
    check(AGENT, &words("--worlds 1"), "pid");
    place.set("[learning]\nkernel = [2, 3]\n");
    let words = words("--worlds 1 --takeover --steps 1");
    let kernel = "kernel: expected odd sides up to 15, got 2 x 3";
    check(AGENT, &words, kernel);
    place.set("[learning]\nrate = 2.0\n");
    check(AGENT, &words, "learning.rate: expected 0 to 1, got 2");
    place.set("learner = \"filtre\"\n");
    check(
        AGENT,
        &words,
        "learner: expected one of filter, neural, | \"filtre\"",
    );
    place.set("[decisions]\nestimator = \"filter\"\n");
    let estimator =
        "decisions.estimator: expected one of known_model, spatial_filter, | \"filter\"";
    check(AGENT, &words, estimator);
}
