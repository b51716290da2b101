//! Tests of `emberwatch-agent train`, and of commands that use its checkpoints.

use crate::commands::{agent, check, check_table};
use crate::trainings::{COMPARED, Place, WORLDS, on};
use emberwatch_learning::checkpoint::{self, Contents};
use emberwatch_learning::learners::filter::SavedFilter;
use emberwatch_protocol::Move;
use rustix::process::Signal;
use tests::harness::{AGENT, LIMIT, Program, SMALL, Server, fly};

/// Settings with which learning starts after 16 world steps, summed over two worlds.
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

fn n_updates(contents: &Contents) -> u64 {
    contents
        .state::<SavedFilter>()
        .expect("its state")
        .fit
        .n_updates()
}

fn updates(row: &[String]) -> u64 {
    row[0].parse().expect("a number")
}

#[test]
fn a_training_that_made_no_update_says_why() {
    let place = place();
    let none = "nothing was learned in";
    place.set(&format!(
        "{SETTINGS}[decisions]\nbatch = 9\nupdates_per_step = 1.0\n"
    ));
    for (flags, cause) in [
        (
            "--steps 6",
            "6 world steps: an update needs 4 blocks of frames (learning.streams), and there were 2",
        ),
        (
            "--learner decisions --estimator known --steps 14",
            "14 world steps: an update learns from 9 transitions, and the steps yielded 6",
        ),
        (
            "--learner neural --steps 30",
            "30 world steps: too few for an update at neural.updates_per_step = 0.03125",
        ),
    ] {
        let out = flags.replace(' ', "");
        let ended = place.train(&out, &format!("{WORLDS} {flags}"));
        ended.check_says(&format!("{none} {cause}"));
    }
    for (flags, is_told) in [("--steps 60", false), ("--steps 4 --resume", true)] {
        let ended = place.train("learned", &format!("{WORLDS} {flags}"));
        assert_eq!(ended.stderr.contains(none), is_told, "{}", ended.stderr);
    }
}

#[test]
fn training_goes_on_bit_for_bit_where_it_stopped() {
    let place = place();
    place.set(&format!("{SETTINGS}[objective]\nbelief = \"estimate\"\n"));
    let train = |out: &str, stops: &[u64]| {
        let server = Server::start(&format!("{SMALL} --worlds 2 --seed 4"));
        let mut done = 0;
        for stop in stops {
            let resume = if done > 0 { "--resume" } else { "" };
            let flags = format!("--worlds 2 --steps {} {resume}", stop - done);
            let ended = place.train(out, &format!("{} {flags}", on(&server)));
            assert!(!ended.stderr.contains("start anew"), "{}", ended.stderr);
            // The number of steps is even, because the two worlds always step together.
            done = stop.next_multiple_of(2);
        }
        (place.rows(out), place.contents(out))
    };
    let (rows, whole) = train("whole", &[200]);
    // Stops the training three times: during the random walk, within a block and a window, and after the first updates.
    let (rows_of_parts, parts) = train("parts", &[22, 61, 100, 200]);
    assert_eq!(rows, rows_of_parts);
    let losses: Vec<f64> = rows.iter().filter_map(|row| row[2].parse().ok()).collect();
    assert!(losses.len() > 80, "{losses:?}");
    assert!(losses.iter().all(|loss| loss.is_finite()), "{losses:?}");
    assert_eq!(rows.last().map(|row| &*row[1]), Some("200"));
    // Equal checkpoints have equal parameters, moments, replay buffers, streams and beliefs.
    assert!(whole == parts, "checkpoints differ");
}

#[test]
fn a_server_and_worlds_in_the_process_teach_the_same() {
    let place = place();
    place.set(&format!(
        "{SETTINGS}[neural]\nepisode_steps = 30\nupdates_per_step = 0.5\n\
         [decisions]\nepisode_steps = 30\nbatch = 8\nupdates_per_step = 1.0\n"
    ));
    for (learner, of_server) in [
        ("filter", "--reveal-model false"),
        ("neural", "--reveal-model false --max-steps 30"),
        ("decisions --estimator known", "--max-steps 30"),
    ] {
        let flags = format!("--learner {learner} --steps 120");
        let [inside, outside] = ["in", "on"].map(|way| format!("{way}-{}", &learner[..5]));
        place.train(&inside, &format!("{WORLDS} {flags}"));
        let server = Server::start(&format!(
            "{WORLDS} --seed 1000 --coverage client {of_server}"
        ));
        let flags = format!("{} --worlds 2 {flags}", on(&server));
        place.train(&outside, &flags);
        let rows = [&inside, &outside].map(|out| place.folder.text(&format!("{out}/metrics.csv")));
        assert!(
            rows[0].lines().count() > 50 && rows[0] == rows[1],
            "{learner}"
        );
        assert!(place.contents(&inside) == place.contents(&outside));
    }
}

#[test]
fn a_filter_learns_from_frames_that_show_every_cell() {
    let place = place();
    place.train("path", &format!("{WORLDS} --steps 120"));
    place.train("full", &format!("{WORLDS} --steps 120 --coverage full"));
    // With full frames, the replay buffer stores 54 cells per step. Otherwise it stores at most six, the cells on a
    // path of five moves.
    let size = |out: &str| place.bytes(out).len();
    assert!(2 * size("full") > 3 * size("path"));
    // On a new server the replay buffer starts empty, and fills with full frames again.
    place.train("full", &format!("{WORLDS} --steps 120 --resume"));
    assert!(2 * size("full") > 3 * size("path"));
    let server = Server::start(SMALL);
    for (out, flags, words) in [
        (
            "full",
            &*format!("{WORLDS} --resume --coverage path"),
            "--coverage: expected full as in the checkpoint, got path",
        ),
        (
            "new",
            &format!("{} --worlds 1 --coverage full", on(&server)),
            "full_frames: expected a server with --coverage client or full, got path",
        ),
        (
            "new",
            &format!("{WORLDS} --learner neural --coverage full"),
            "--coverage applies only with --learner filter, got --learner neural",
        ),
    ] {
        place.refuse(out, flags, words);
    }
}

#[test]
fn other_worlds_begin_new_tracks_and_an_empty_replay() {
    let place = place();
    let before = place.learn("out", &format!("{WORLDS} --steps 80"));
    place.refuse("out", WORLDS, "--out | add --resume");
    let ended = place.train("out", &format!("{WORLDS} --steps 60 --resume"));
    ended.check_says("beliefs start anew robots=2");
    let rows = place.rows("out");
    let [last, first] = [before.len() - 1, before.len()].map(|row| &rows[row]);
    assert_eq!(first[1], "82", "world steps go on");
    assert_eq!(updates(first), updates(last), "an empty replay at first");
    let end = rows.last().expect("rows");
    assert!(updates(end) > updates(first));
    assert_eq!(end[1], "140");
}

#[test]
fn a_moved_world_begins_a_new_track_and_keeps_the_replay() {
    let place = place();
    let server = Server::start(&format!("{SMALL} --worlds 2 --max-steps 9"));
    let flags = format!("{} --worlds 2", on(&server));
    let n_rows = place.learn("out", &format!("{flags} --steps 60")).len();
    assert_eq!([0, 1].map(|world| server.step_of(world)), [30 % 9; 2]);
    fly(&mut server.acquire(0..1), vec![Move::from_low_bits(0); 6]);
    let ended = place.train("out", &format!("{flags} --steps 60 --resume"));
    ended.check_says("beliefs start anew robots=1");
    let rows = place.rows("out");
    assert!(updates(&rows[n_rows]) > updates(&rows[n_rows - 1]));
}

#[test]
fn a_number_that_is_not_finite_ends_training_by_name() {
    let place = place();
    place.train("out", &format!("{WORLDS} --steps 80"));
    // The saved moment is finite, but the update step that it causes at a high learning rate is not.
    place.set(&format!("{SETTINGS}rate = 1.0\nobservation_rate = 100.0\n"));
    let mut contents = place.contents("out");
    for (name, number) in [("first_moment", f32::MAX), ("second_moment", 0.0)] {
        let tensor = contents.tensors.get_mut(&format!("likelihood.{name}"));
        tensor.expect("a moment").numbers[4] = number;
    }
    let checkpoint = place.checkpoint("out");
    checkpoint::write(&checkpoint, "learned_filter", &contents).expect("written");
    let (n_rows, next) = (place.rows("out").len(), n_updates(&contents) + 1);
    let resume = format!("{WORLDS} --steps 80 --resume");
    let words = format!(
        "update {next}: likelihood: expected finite numbers, got a NaN or infinite step; \
         the last checkpoint, if there is one, is {}",
        checkpoint.display()
    );
    place.refuse("out", &resume, &words);
    let saved = place.contents("out");
    for name in ["kernel", "likelihood", "initial"] {
        let tensors = [&contents, &saved].map(|contents| contents.tensors.get(name));
        assert_eq!(tensors[0], tensors[1], "{name}: as before the update");
    }
    assert_eq!(n_updates(&saved), next - 1);
    assert!(place.rows("out").len() >= n_rows);
    // The checkpoint is complete, so a later run resumes from it and fails at the same point.
    place.refuse("out", &resume, "likelihood: expected finite numbers");
}

#[test]
fn signals_and_a_dead_server_end_training_with_a_checkpoint() {
    for signal in [Some(Signal::INT), Some(Signal::TERM), None] {
        let place = place();
        let server = Server::start(&format!("{SMALL} --worlds 2 --reveal-model false"));
        let words = place.words("out", &format!("{} --worlds 2", on(&server)));
        let program = Program::start(AGENT, &words);
        program.until(|| server.status().n_steps > 40);
        match signal {
            Some(signal) => {
                program.signal(signal);
                program.wait(LIMIT).check(0);
                server.acquire(0..2);
            }
            None => {
                server.kill();
                let ended = program.wait(LIMIT).check(1);
                assert!(!ended.stderr.contains("panicked"), "{}", ended.stderr);
            }
        }
        assert!(place.checkpoint("out").is_file());
    }
}

#[test]
fn a_checkpoint_is_compared_and_checked() {
    let place = place();
    place.train("out", &format!("{WORLDS} --steps 80"));
    place.train("other", &format!("{WORLDS} --steps 88"));
    let compared = place.compare("other", "");
    let (out, other) = (place.flag("out"), place.flag("other"));
    for policy in [
        "learned/shooting/exploit",
        "learned_beam",
        "learned+spatial/beam/exploit",
    ] {
        compared.check_prints(policy);
    }
    let both = format!("compare {out} {other} {COMPARED}");
    check(
        AGENT,
        &both,
        "expected one checkpoint of learned_filter, got two",
    );
    let server = Server::start(SMALL);
    let run = format!(
        "run {} --steps 5 --policy learned+spatial/beam/exploit",
        on(&server)
    );
    agent(&format!("{run} {other}"));
    let words = "learned+spatial/beam/exploit | needs --checkpoint FILE: expected a checkpoint of `train --learner filter`";
    check(AGENT, &run, words);
    let resume = format!("{WORLDS} --steps 8 --resume");
    place.train("other", &resume);
    place.set(&SETTINGS.replace("[learning]", "[learning]\nkernel = [5, 5]"));
    let shape = "checkpoint.safetensors: kernel: expected shape [3, 3, 5, 5], got [3, 3, 3, 3]";
    place.refuse("out", &resume, shape);
    let whole = place.bytes("out");
    std::fs::write(place.checkpoint("out"), &whole[..whole.len() / 2]).expect("cut");
    let damaged = "checkpoint.safetensors | damaged or truncated";
    place.refuse("out", &resume, damaged);
    check(AGENT, &format!("compare {COMPARED} {out}"), damaged);
}

/// Invalid flags of `train` and `compare`, and words of the resulting error.
const WRONG_FLAGS: &str = "
train => --out
train --out /proc/no => create /proc/no
train --out OUT --worlds 0 => --worlds | 1..=1024
train --out OUT --instance nobody => no server on instance \"nobody\"
train --out OUT --instance x --height 9 => --instance | --height
train --out OUT --time-limit=-1 => --time-limit | expected a number of seconds
train --out OUT --model no.toml => model file no.toml | No such file
train --out OUT --world 3 => --instance
train --out OUT --resume --burn-in 1 => checkpoint OUT/checkpoint.safetensors: No such file
compare --checkpoint no/such => checkpoint no/such: No such file
";

#[test]
fn wrong_flags_worlds_and_settings_of_learners_are_named() {
    let place = place();
    check_table(
        AGENT,
        &WRONG_FLAGS.replace("OUT", &place.folder.word("new")),
    );
    let server = Server::start(SMALL);
    let flags = |more: &str| format!("{} --worlds 1 {more}", on(&server));
    let more =
        "no such world: there are worlds 0 to 0; for more, set worlds (--worlds N of a server)";
    for world in ["--world 1", "--world 4294967294"] {
        place.refuse("out", &flags(world), more);
    }
    let _held = server.acquire(0..1);
    place.refuse("out", &flags(""), "pid");
    place.set("learner = \"filtre\"\n");
    let words = "learner: expected one of filter, neural, | \"filtre\"";
    place.refuse("out", &flags("--takeover --steps 1"), words);
}
