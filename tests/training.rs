//! Tests of `emberwatch-agent train` with every learner, and of commands that use its checkpoints.

use crate::commands::{agent, check};
use emberwatch_learning::checkpoint::{self, Contents};
use emberwatch_learning::learners::decisions::SavedDecisions;
use emberwatch_learning::learners::filter::SavedFilter;
use rustix::process::Signal;
use std::path::PathBuf;
use tests::harness::{AGENT, Ended, Folder, LIMIT, Program, SMALL, Server, repository};

/// Settings with which every learner makes updates after a few steps.
const SETTINGS: &str = "beam_width = 4
shooting_samples = 16
prior_worlds = 2
[learning]
window = 2
streams = 4
block_windows = 2
explore_steps = 40
updates_per_step = 1.0
[neural]
steps = 40
episode_steps = 30
batch = 4
updates_per_step = 0.5
[decisions]
filter_steps = 40
steps = 60
batch = 8
replay = 100
updates_per_step = 1.0
episode_steps = 30
[autoencoder]
window = 4
replay_frames = 12
full_frames = 6
[dqn]
batch = 4
replay = 20
";

/// One small world, the only kind that the autoencoder learns in.
const WORLD: &str = "--height 6 --width 9 --moves 5 --burn-in 60";

const WORLDS: &str = "--worlds 2 --height 6 --width 9 --moves 5 --burn-in 60";

/// Flags of a very short comparison.
const COMPARED: &str = "compare --seeds 3..5 --steps 5 --height 6 --width 9 --moves 5 --burn-in 60 --baseline coverage";

const WORLD_STEPS: usize = 1;
const LOSS: usize = 2;
const DQN_LOSS: usize = 6;

/// A folder with a settings file and the output folders of trainings.
struct Place(Folder);

impl Place {
    fn new() -> Self {
        let place = Self(Folder::default());
        place.set(SETTINGS);
        place
    }

    /// Replaces the settings file.
    fn set(&self, settings: &str) {
        self.0.write("agent.toml", settings);
    }

    fn checkpoint(&self, out: &str) -> PathBuf {
        self.0.path(out).join("checkpoint.safetensors")
    }

    /// Returns the flag that names a checkpoint.
    fn flag(&self, out: &str) -> String {
        format!("--checkpoint {}", self.checkpoint(out).display())
    }

    fn contents(&self, out: &str) -> Contents {
        let read = checkpoint::read(&self.checkpoint(out));
        read.expect("a checkpoint").1
    }

    /// Returns the arguments of a training into a folder.
    fn words(&self, out: &str, flags: &str) -> String {
        let [config, out] = ["agent.toml", out].map(|name| self.0.word(name));
        format!("train --config {config} --out {out} {flags}")
    }

    fn train(&self, out: &str, flags: &str) -> Ended {
        agent(&self.words(out, flags))
    }

    fn refuse(&self, out: &str, flags: &str, words: &str) {
        check(AGENT, &self.words(out, flags), words);
    }

    /// Checks that the flags in each line `flags => words` of a table are refused.
    fn refuse_all(&self, out: &str, flags: &str, table: &str) {
        for line in table.lines() {
            let (more, words) = line.split_once(" => ").expect("flags and words");
            self.refuse(out, &format!("{flags} {more}"), words);
        }
    }

    /// Returns the rows of the metrics.
    fn rows(&self, out: &str) -> Vec<Vec<String>> {
        let text = self.0.text(&format!("{out}/metrics.csv"));
        let rows = text.lines().skip(1);
        rows.map(|line| line.split(',').map(String::from).collect())
            .collect()
    }
}

/// Returns the seed of the first world that a training reports.
fn first_seed(ended: &Ended) -> u64 {
    let (_, seed) = ended.stderr.split_once("seed=").expect("a seed");
    let mut digits = seed.split(|letter: char| !letter.is_ascii_digit());
    digits.next().unwrap_or_default().parse().expect("a number")
}

#[test]
fn each_piece_of_a_training_sees_new_worlds_and_counts_on() {
    let place = Place::new();
    let server = Server::start(&format!("{SMALL} --worlds 2 --seed 4"));
    let on = format!("{} --worlds 2", server.flag());
    let updates = |row: &[String]| row[0].parse::<u64>().expect("a number");
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
            assert_eq!(end[WORLD_STEPS], n_steps.to_string());
        }
        seeds.sort_unstable();
        seeds.dedup();
        assert_eq!(seeds.len(), 3, "{seeds:?}");
    }
    for (flags, is_told) in [("--steps 6", true), ("--steps 60 --resume", false)] {
        let ended = place.train("few", &format!("{WORLDS} {flags}"));
        let says = ended.stderr.contains("nothing was learned in");
        assert_eq!(says, is_told, "{}", ended.stderr);
    }
}

#[test]
fn a_server_and_worlds_in_the_process_teach_the_same() {
    let place = Place::new();
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
        let flags = format!("{} --worlds 2 {flags}", server.flag());
        place.train(&outside, &flags);
        let rows = [&inside, &outside].map(|out| place.0.text(&format!("{out}/metrics.csv")));
        assert!(
            rows[0].lines().count() > 50 && rows[0] == rows[1],
            "{learner}"
        );
        assert!(place.contents(&inside) == place.contents(&outside));
    }
}

#[test]
fn checkpoints_of_every_learner_act_and_are_asked_for() {
    let place = Place::new();
    let server = Server::start(WORLD);
    for (learner, worlds, policies) in [
        (
            "filter",
            WORLDS,
            "learned/shooting/exploit learned_beam learned+spatial/beam/exploit",
        ),
        ("neural", WORLDS, "neural/shooting/exploit neural_beam"),
        ("decisions", WORLDS, "learned_policy"),
        (
            "autoencoder",
            WORLD,
            "autoencoder/shooting/explore autoencoder/beam/exploit autoencoder/shooting/learned",
        ),
    ] {
        place.train(learner, &format!("{worlds} --learner {learner} --steps 60"));
        let rows = place.rows(learner);
        let losses = rows
            .iter()
            .flat_map(|row| [row.get(LOSS), row.get(DQN_LOSS)]);
        let losses = losses.filter_map(|loss| loss?.parse::<f64>().ok());
        let losses = Vec::from_iter(losses);
        assert!(losses.len() > 10 && losses.iter().all(|loss| loss.is_finite()));
        let flag = place.flag(learner);
        let ladder = agent(&format!("{COMPARED} {flag}"));
        let policies = Vec::from_iter(policies.split(' '));
        policies
            .iter()
            .for_each(|policy| _ = ladder.check_prints(policy));
        let run = format!(
            "run {} --steps 5 --policy {}",
            server.flag(),
            policies[policies.len() - 1]
        );
        agent(&format!("{run} {flag}"));
        let words = "needs --checkpoint FILE: expected a checkpoint of `train --learner";
        // Without a filter, the decisions are not missed.
        let missing = learner.replace("decisions", "filter");
        check(AGENT, &run, &format!("{words} {missing}`"));
    }
    // A comparison accepts decisions together with their own filter only.
    let policies = "--policies learned_policy,learned_beam,coverage";
    let [decisions, own, other] =
        ["decisions", "decisions/belief", "filter"].map(|of| place.flag(of));
    agent(&format!("{COMPARED} {policies} {own} {decisions}"));
    let both = format!("{COMPARED} {policies} {decisions} {other}");
    check(AGENT, &both, "checkpoint | expected one | got two");
    let two = format!("{COMPARED} {own} {other}");
    check(
        AGENT,
        &two,
        "expected one checkpoint of learned_filter, got two",
    );
    let network = format!(
        "{} --policies autoencoder/beam/exploit",
        place.flag("autoencoder")
    );
    let larger = COMPARED
        .replace("--height 6", "--height 7")
        .replace("coverage", "autoencoder/beam/exploit");
    let words = "expected a network for the world's grid, 7 x 9 | got one for 6 x 9";
    check(AGENT, &format!("{larger} {network}"), words);
    let resume = format!("{WORLDS} --resume --steps 8");
    place.set(&SETTINGS.replace("[learning]", "[learning]\nkernel = [5, 5]"));
    let words = "checkpoint.safetensors: kernel: expected shape [3, 3, 5, 5], got [3, 3, 3, 3]";
    place.refuse("filter", &resume, words);
    let words = "expected a checkpoint of learned_filter, got one of autoencoder";
    place.refuse("autoencoder", &format!("{WORLD} --resume"), words);
    let whole = place.0.bytes("filter/checkpoint.safetensors");
    place
        .0
        .write("filter/checkpoint.safetensors", &whole[..whole.len() / 2]);
    let damaged = "checkpoint.safetensors | damaged or truncated";
    place.refuse("filter", &resume, damaged);
    check(AGENT, &format!("{COMPARED} {other}"), damaged);
}

#[test]
fn a_filter_learns_from_frames_that_show_every_cell() {
    let place = Place::new();
    for (out, flags) in [("path", ""), ("full", "--coverage full")] {
        place.train(out, &format!("{WORLDS} --steps 60 {flags}"));
    }
    assert!(place.contents("path").tensors != place.contents("full").tensors);
    let words = "--resume | cannot be used with | --coverage";
    place.refuse("full", &format!("{WORLDS} --resume --coverage path"), words);
    let server = Server::start(SMALL);
    let words = "full_frames: expected a server with --coverage client or full, got path";
    place.refuse(
        "new",
        &format!("{} --worlds 1 --coverage full", server.flag()),
        words,
    );
    let words = "--coverage applies only with --learner filter, got --learner neural";
    place.refuse(
        "new",
        &format!("{WORLDS} --learner neural --coverage full"),
        words,
    );
}

#[test]
fn a_number_that_is_not_finite_ends_training_by_name() {
    let place = Place::new();
    place.train("out", &format!("{WORLDS} --steps 80"));
    // The saved moment is finite, but the update step that it causes at a high learning rate is not.
    let fast = "[learning]\nrate = 1.0\nobservation_rate = 100.0";
    place.set(&SETTINGS.replace("[learning]", fast));
    let mut contents = place.contents("out");
    for (name, number) in [("first_moment", f32::MAX), ("second_moment", 0.0)] {
        let tensor = contents.tensors.get_mut(&format!("likelihood.{name}"));
        tensor.expect("a moment").numbers[4] = number;
    }
    let checkpoint = place.checkpoint("out");
    checkpoint::write(&checkpoint, "learned_filter", &contents).expect("written");
    let n_updates = |contents: &Contents| {
        let state = contents.state::<SavedFilter>();
        state.expect("its state").n_updates
    };
    let words = format!(
        "update {}: likelihood: expected finite numbers, got a NaN or infinite step; \
         the last checkpoint, if there is one, is {}",
        n_updates(&contents) + 1,
        checkpoint.display()
    );
    place.refuse("out", &format!("{WORLDS} --steps 80 --resume"), &words);
    let saved = place.contents("out");
    for name in ["kernel", "likelihood", "initial"] {
        let tensors = [&contents, &saved].map(|contents| contents.tensors.get(name));
        assert_eq!(tensors[0], tensors[1], "{name}: as before the update");
    }
    assert_eq!(n_updates(&saved), n_updates(&contents));
}

#[test]
fn signals_and_a_dead_server_end_training_with_a_checkpoint() {
    for signal in [Some(Signal::INT), Some(Signal::TERM), None] {
        let place = Place::new();
        let server = Server::start(&format!("{SMALL} --worlds 2 --reveal-model false"));
        let words = place.words("out", &format!("{} --worlds 2", server.flag()));
        let program = Program::start(AGENT, &words);
        program.until(|| server.status().n_steps > 40);
        let words = "--out | expected a folder in which no training runs";
        place.refuse("out", WORLDS, words);
        let Some(signal) = signal else {
            server.kill();
            let ended = program.wait(LIMIT).check(1);
            assert!(!ended.stderr.contains("panicked"), "{}", ended.stderr);
            assert!(place.checkpoint("out").is_file());
            continue;
        };
        program.signal(signal);
        program.wait(LIMIT).check(0);
        server.acquire(0..2);
        // A link at the checkpoint's path stays one.
        let (link, target) = (place.checkpoint("out"), place.0.path("elsewhere"));
        std::fs::rename(&link, &target).expect("moved");
        std::os::unix::fs::symlink(&target, &link).expect("linked");
        let before = place.0.bytes("elsewhere");
        place.train("out", &format!("{WORLDS} --steps 20 --resume"));
        assert!(link.is_symlink() && place.0.bytes("elsewhere") != before);
    }
}

#[test]
fn decisions_are_learned_on_the_belief_that_was_asked_for() {
    let place = Place::new();
    let learn = format!("{WORLDS} --steps 20");
    // A training that ended before its filter was complete resumes there.
    let settings = format!("learner = \"decisions\"\n{SETTINGS}");
    place.set(&settings.replace("filter_steps = 40", "filter_steps = 1000000"));
    let first = format!("{learn} --estimator learned+spatial");
    let program = Program::start(AGENT, &place.words("spatial", &first));
    program.wait_for_words("learning");
    program.signal(Signal::INT);
    program.wait(LIMIT).check(0);
    assert!(!place.checkpoint("spatial").exists());
    place.set(&settings);
    place.train("spatial", &format!("{learn} --resume"));
    let filter = place.flag("spatial/belief");
    let given = format!("--estimator learned+spatial {filter}");
    for (out, flags, estimator, is_given) in [
        ("spatial", "", "learned+spatial", false),
        ("given", &given, "learned+spatial", true),
        ("known", "--estimator known", "known", true),
        ("neural", "--estimator neural", "neural", false),
    ] {
        if !flags.is_empty() {
            place.train(out, &format!("{learn} {flags}"));
        }
        assert_eq!(place.0.path(&format!("{out}/belief")).exists(), !is_given);
        // Without `--steps`, a training resumes until the steps of the settings are done.
        let resume = format!("{WORLDS} --resume");
        place.train(out, &resume);
        let rows = place.rows(out);
        assert_eq!(rows.last().expect("rows")[WORLD_STEPS], "60", "{out}");
        place.refuse(out, &resume, "expected a number of steps, as all 60");
        let saved: SavedDecisions = place.contents(out).state().expect("its state");
        assert_eq!(saved.estimator, estimator);
    }
    let two = repository().join("config/models/epidemic.toml");
    let two = two.display();
    let table = format!(
        "--resume --estimator learned => --resume | cannot be used with | --estimator
--resume --model {two} => checkpoint: expected the world's 2 observations, got 3
--resume {filter} => --resume | cannot be used with | --checkpoint
{filter} --estimator known => --checkpoint | known
{filter} --learner filter => --checkpoint applies only with --learner neural or decisions
--learner filter --estimator known => --estimator applies only with
--estimator filter => --estimator | got"
    );
    place.refuse_all("spatial", &format!("{WORLDS} --steps 4"), &table);
}

#[test]
fn a_neural_belief_corrects_a_filter() {
    let place = Place::new();
    place.train("filter", &format!("{WORLDS} --steps 40"));
    let learn = format!("{WORLDS} --learner neural --steps 40");
    place.train("out", &format!("{learn} {}", place.flag("filter")));
    place.train("out", &format!("{learn} --resume"));
    let flags = format!("{} --policies neural_beam,coverage", place.flag("out"));
    agent(&format!("{COMPARED} {flags}")).check_prints("neural_beam");
    let words = "--checkpoint | for the estimator learned";
    place.refuse("other", &format!("{learn} {}", place.flag("out")), words);
}

#[test]
fn an_autoencoder_learns_in_one_world_whose_episodes_end() {
    let place = Place::new();
    let learn =
        |server: &Server, more: &str| format!("{} --learner autoencoder {more}", server.flag());
    let server = Server::start(&format!("{WORLD} --coverage client --max-steps 7"));
    place.train("out", &learn(&server, "--steps 30"));
    assert_eq!(server.step_of(0), 30 % 7);
    let before = place.rows("out");
    assert!(!before[29][LOSS].is_empty() && !before[29][DQN_LOSS].is_empty());
    // Resuming drops rows that are newer than the checkpoint or cut short.
    let metrics = place.0.text("out/metrics.csv");
    let last = metrics
        .lines()
        .last()
        .expect("rows")
        .replace(",30,", ",31,");
    place.0.write(
        "out/metrics.csv",
        format!("{metrics}{last}\n{}", &last[..9]),
    );
    place.train("out", &learn(&server, "--steps 3 --resume"));
    assert_eq!(server.step_of(0), 3);
    let rows = place.rows("out");
    assert_eq!(rows[..30], before);
    let steps = rows[30..].iter().map(|row| &*row[WORLD_STEPS]);
    assert_eq!(Vec::from_iter(steps), ["31", "32", "33"]);
    place.0.write("out/metrics.csv", "update,loss\n");
    let words = "metrics.csv: expected the columns update,world_steps,loss,held_out_log_likelihood,\
                 mean_reward,rate, | got update,loss";
    place.refuse("out", &learn(&server, "--steps 5 --resume"), words);
    // Here a window of frames covers a whole episode.
    let whole = Server::start(&format!("{WORLD} --coverage client --max-steps 3"));
    place.train("whole", &learn(&whole, "--steps 9"));
    assert!(!place.rows("whole")[8][LOSS].is_empty());
    let two = "--worlds: expected 1 for the autoencoder | got 2";
    place.refuse("new", &format!("{WORLDS} --learner autoencoder"), two);
    for (flags, words) in [
        ("", "autoencoder.full_frames: 6 frames | --coverage client"),
        (
            "--coverage client --max-steps 2",
            "autoencoder.window: expected at most the 3 frames | got 4",
        ),
    ] {
        let server = Server::start(&format!("{WORLD} {flags}"));
        place.refuse("new", &learn(&server, ""), words);
    }
}
