//! Tests of `emberwatch-agent train`, and of commands that use its checkpoints.

use crate::commands::{agent, check, check_table};
use crate::trainings::{COMPARED, Place, WORLDS, on};
use emberwatch_learning::checkpoint::{self, Contents};
use emberwatch_learning::learners::filter::SavedFilter;
use rustix::process::Signal;
use tests::harness::{AGENT, Ended, LIMIT, Program, SMALL, Server};

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
        .n_updates
}

fn updates(row: &[String]) -> u64 {
    row[0].parse().expect("a number")
}

#[test]
fn a_training_that_made_no_update_says_so() {
    let place = place();
    let none = "nothing was learned in";
    for (flags, is_told) in [
        ("--steps 6", true),
        ("--steps 60 --resume", false),
        ("--steps 4 --resume", true),
    ] {
        let ended = place.train("out", &format!("{WORLDS} {flags}"));
        assert_eq!(ended.stderr.contains(none), is_told, "{}", ended.stderr);
    }
}

/// Returns the seed of the first world that a training reports.
fn first_seed(ended: &Ended) -> u64 {
    let (_, seed) = ended.stderr.split_once("seed=").expect("a seed");
    let digits = seed.split(|letter: char| !letter.is_ascii_digit());
    digits
        .into_iter()
        .next()
        .unwrap_or_default()
        .parse()
        .expect("a number")
}

#[test]
fn each_piece_of_a_training_sees_new_worlds_and_counts_on() {
    let place = place();
    let server = Server::start(&format!("{SMALL} --worlds 2 --seed 4"));
    let on = format!("{} --worlds 2", on(&server));
    for (out, worlds, first) in [("in", WORLDS, 1000), ("on", &on, 4)] {
        let mut seeds = vec![first_seed(
            &place.train(out, &format!("{worlds} --steps 80")),
        )];
        assert_eq!(seeds[0], first);
        place.refuse(out, worlds, "--out | add --resume");
        for n_steps in [140, 200] {
            let before = place.rows(out);
            let ended = place.train(out, &format!("{worlds} --steps 60 --resume"));
            ended.check_says("resumed in new worlds, with an empty replay buffer");
            seeds.push(first_seed(&ended));
            let rows = place.rows(out);
            let [last, first] = [before.len() - 1, before.len()].map(|row| &rows[row]);
            assert_eq!(rows[..before.len()], before);
            assert_eq!(updates(first), updates(last), "an empty replay at first");
            let end = rows.last().expect("rows");
            assert!(updates(end) > updates(first));
            assert_eq!(end[1], n_steps.to_string());
        }
        seeds.sort_unstable();
        seeds.dedup();
        assert_eq!(seeds.len(), 3, "{seeds:?}");
    }
}

#[test]
fn a_folder_has_one_training_at_a_time_and_a_link_stays_one() {
    let place = place();
    let server = Server::start(&format!("{SMALL} --worlds 2"));
    let first = Program::start(
        AGENT,
        &place.words("out", &format!("{} --worlds 2", on(&server))),
    );
    first.until(|| server.status().n_steps > 4);
    place.refuse(
        "out",
        WORLDS,
        "--out | expected a folder in which no training runs",
    );
    first.signal(Signal::INT);
    first.wait(LIMIT).check(0);
    let (link, target) = (place.checkpoint("out"), place.folder.path("elsewhere"));
    std::fs::rename(&link, &target).expect("moved");
    std::os::unix::fs::symlink(&target, &link).expect("linked");
    let before = std::fs::read(&target).expect("a checkpoint");
    place.train("out", &format!("{WORLDS} --steps 20 --resume"));
    assert!(link.is_symlink());
    assert!(std::fs::read(&target).expect("a checkpoint") != before);
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
    for (out, flags) in [("path", ""), ("full", "--coverage full")] {
        place.train(out, &format!("{WORLDS} --steps 60 {flags}"));
    }
    assert!(place.contents("path").tensors != place.contents("full").tensors);
    let server = Server::start(SMALL);
    for (out, flags, words) in [
        (
            "full",
            &*format!("{WORLDS} --resume --coverage path"),
            "--resume | cannot be used with | --coverage",
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
train --out OUT --model no.toml => model file no.toml | No such file
train --out OUT --world 3 => --instance
train --out OUT --robots 1,2 => --robots | expected 1 to 64
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
