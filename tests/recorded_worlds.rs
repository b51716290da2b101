//! Recorded worlds: what was recorded is what the truth channel shows, and agents act there without a model.

use crate::commands::{agent, check, check_table};
use crate::recording::{read, read_whole, start_recorder, start_replay, stop, truths};
use emberwatch_agent::benchmark::report::runs_file::read_runs;
use emberwatch_agent::client::truth::TruthFeed;
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::message::{Status, TruthHeader};
use emberwatch_protocol::model::Description;
use emberwatch_protocol::observer::Sample;
use emberwatch_protocol::recording::Event;
use emberwatch_protocol::{Client, Connection, Grid, Shape};
use ndarray::{Array3, ArrayView2, Axis};
use ndarray_npy::WriteNpyExt;
use rustix::fs::{CWD, FileType, Mode, mknodat};
use std::fs::File;
use tempfile::TempDir;
use tests::harness::{
    AGENT, PATIENCE, Paths, SERVER, Server, fly, new_instance, repository, reset, run,
};
use tests::meter::memory;

const N_MOVES: usize = 4;

/// Each state is observed as itself.
const DESCRIPTION: &str = r##"
name = "lab"
step = "10 min"
states = [
    { name = "unburnt", color = "#000000", observed_as = [1.0, 0.0, 0.0] },
    { name = "burning", color = "#ff0000", observed_as = [0.0, 1.0, 0.0], reward = 1.0 },
    { name = "burnt", color = "#777777", observed_as = [0.0, 0.0, 1.0] },
]
observations = [
    { name = "dark", color = "#000000" },
    { name = "hot", color = "#ff0000" },
    { name = "grey", color = "#777777" },
]
"##;

/// Sequences of such lengths in a folder; no two recorded steps are alike.
struct Place {
    folder: TempDir,
    sequences: Vec<Array3<u8>>,
}

impl Place {
    fn new(lengths: &[usize], (height, width): (usize, usize)) -> Self {
        let folder = TempDir::new().expect("a folder");
        let sequence = |(index, &length): (usize, &usize)| {
            // Digits to the base 3 of a hash: no symmetry, and no step like another.
            Array3::from_shape_fn((length, height, width), |(k, row, col)| {
                let number = ((index * 97 + k) * height + row) * width + col;
                let hash = (number as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
                ((hash >> 40) % 3) as u8
            })
        };
        let sequences: Vec<_> = lengths.iter().enumerate().map(sequence).collect();
        for (index, states) in sequences.iter().enumerate() {
            let file = File::create(folder.path().join(format!("{index}.npy")));
            states.write_npy(file.expect("create")).expect("write");
        }
        std::fs::write(folder.path().join("states.toml"), DESCRIPTION).expect("write");
        Self { folder, sequences }
    }

    fn flags(&self, more: &str) -> String {
        let folder = self.folder.path().display();
        format!("--states {folder} --moves {N_MOVES} --publish-truth {more}")
    }

    /// A recorded step as docs/recorded-worlds.md has symmetries, cell by cell.
    fn states(&self, seed: u64, n_symmetries: u64, recorded_step: usize) -> Grid<u8> {
        let n_sequences = self.sequences.len() as u64;
        let symmetry = seed / n_sequences % n_symmetries;
        let sequence = &self.sequences[(seed % n_sequences) as usize];
        let states = sequence.index_axis(Axis(0), recorded_step);
        turned(states, symmetry)
    }

    fn last(&self, seed: u64) -> usize {
        let index = seed as usize % self.sequences.len();
        self.sequences[index].len_of(Axis(0)) - 1
    }
}

fn turned(states: ArrayView2<'_, u8>, symmetry: u64) -> Grid<u8> {
    let (height, width) = states.dim();
    let is_transposed = symmetry >= 4;
    let dim = if is_transposed {
        (width, height)
    } else {
        (height, width)
    };
    let turn = |at, length, bit| {
        if symmetry & bit == 0 {
            at
        } else {
            length - 1 - at
        }
    };
    Grid::from_shape_fn(dim, |(row, col)| {
        let (row, col) = (turn(row, dim.0, 1), turn(col, dim.1, 2));
        states[if is_transposed {
            [col, row]
        } else {
            [row, col]
        }]
    })
}

/// What the truth channel and full frames show of a whole episode; it ends truncated.
fn episode(client: &mut Client, truth: &TruthFeed, seed: u64) -> Vec<Grid<u8>> {
    reset(client, seed);
    let first = client.observe(0..1).expect("observe").remove(0);
    assert_eq!((first.world.step, first.world.truncated), (0, 0));
    let mut shown = truth.states(0..1, &[seed], 0).expect("truth");
    let mut paths = Paths::new(seed);
    loop {
        let seen = fly(client, paths.next(N_MOVES));
        let states = truth.states(0..1, &[seed], seen.world.step).expect("truth");
        assert_eq!(seen.frame.values(), states[0], "sensors that never err");
        let n_burning = states[0].iter().filter(|&&state| state == 1).count();
        assert_eq!(seen.world.n_target_cells as usize, n_burning);
        shown.extend(states);
        if seen.world.truncated != 0 {
            return shown;
        }
    }
}

#[test]
fn recorded_states_replay_in_each_symmetry_and_offset() {
    for (side, n_symmetries) in [((4, 4), 8), ((3, 5), 4)] {
        let place = Place::new(&[5, 8], side);
        for (flags, most_offset) in [("", 0), ("--states-offset 3", 3)] {
            let flags = format!("--coverage full --states-symmetries {flags}");
            let server = Server::start(&place.flags(&flags));
            let shape = Shape::new(side.0, side.1).expect("a shape");
            let truth = TruthFeed::open(&server.instance, shape).expect("truth");
            let mut client = server.acquire(0..1);
            let mut offsets = Vec::new();
            for seed in 0..2 * n_symmetries {
                let shown = episode(&mut client, &truth, seed);
                let offset = place.last(seed) + 1 - shown.len();
                assert!(offset <= most_offset, "seed {seed}: {offset}");
                for (k, states) in shown.iter().enumerate() {
                    let expected = place.states(seed, n_symmetries, offset + k);
                    assert_eq!(*states, expected, "seed {seed}, step {k}");
                }
                offsets.push(offset);
            }
            offsets.sort_unstable();
            offsets.dedup();
            assert_eq!(offsets.len() > 1, most_offset > 0, "{offsets:?}");
            let over = client.step(0..1, &Paths::new(1).take(N_MOVES, 1));
            let over = over.expect_err("the episode is over");
            let ConnectionError::Refused { status, .. } = over else {
                panic!("expected a refusal, got {over}");
            };
            assert_eq!(status, Status::EpisodeOver);
        }
    }
}

#[test]
fn hello_tells_of_the_recorded_world_and_keeps_what_it_shall() {
    let place = Place::new(&[6, 9], (3, 5));
    let server = Server::start(&place.flags("--states-offset 2"));
    let info = server.info();
    let recorded = info.recorded_world.expect("it is one");
    assert_eq!((recorded.n_sequences, recorded.n_steps), (2, 3));
    assert_eq!((info.height, info.width, info.burn_in), (3, 5, 0));
    assert_eq!(info.model, None);
    assert_eq!(info.observations, ["dark", "hot", "grey"]);
    let model = Description::model_of(&recorded.description.expect("revealed"));
    assert_eq!(model.expect("valid").name(), "lab");
    let server = Server::start(&place.flags("--reveal-model false"));
    let recorded = server.info().recorded_world.expect("it is one");
    assert_eq!(recorded.description, None);
    let server = Server::start("--height 5 --width 7 --burn-in 20");
    assert_eq!(server.info().recorded_world, None);
}

#[test]
fn max_steps_truncate_before_the_last_recorded_step() {
    let place = Place::new(&[6], (3, 5));
    let server = Server::start(&place.flags("--coverage full --max-steps 3"));
    let shape = Shape::new(3, 5).expect("a shape");
    let truth = TruthFeed::open(&server.instance, shape).expect("truth");
    assert_eq!(episode(&mut server.acquire(0..1), &truth, 7).len(), 1 + 3);
}

#[test]
fn a_restored_world_goes_on_and_another_states_file_is_refused() {
    let (place, other) = (Place::new(&[9, 12], (4, 4)), Place::new(&[9, 13], (4, 4)));
    let folder = TempDir::new().expect("a folder");
    let file = folder.path().join("lab.snapshot");
    let settings = "--states-symmetries --states-offset 3 --start random --robots 2";
    let server = Server::start(&place.flags(settings));
    let shape = Shape::new(4, 4).expect("a shape");
    let feed = |server: &Server| TruthFeed::open(&server.instance, shape).expect("truth");
    let future = |client: &mut Client, truth: &TruthFeed| -> Vec<_> {
        let mut paths = Paths::new(5);
        let mut step = || {
            let shown = client.step(0..2, &paths.take(N_MOVES, 2)).expect("step");
            let states = truth.states(0..1, &[21], shown[0].world.step);
            (shown, states.expect("truth"))
        };
        (0..3).map(|_| step()).collect()
    };
    let (mut client, truth) = (server.acquire(0..2), feed(&server));
    reset(&mut client, 21);
    future(&mut client, &truth);
    let file = file.display();
    server.command(&format!("snapshot {file}")).check(0);
    let went_on = future(&mut client, &truth);
    let restore = format!("restore {file} --takeover");
    server.command(&restore).check(0);
    assert_eq!(future(&mut server.acquire(0..2), &truth), went_on);
    let again = Server::start(&place.flags(&format!("{settings} --restore {file}")));
    assert_eq!(future(&mut again.acquire(0..2), &feed(&again)), went_on);
    for (place, settings, words) in [
        (&other, settings, "states: expected 2 sequences of CRC-32 "),
        (
            &place,
            "--robots 2 --start random --states-offset 3",
            "states_symmetries: expected false as this server's, got true",
        ),
        (
            &place,
            "--robots 2 --start random --states-symmetries",
            "states_offset: expected 0 as this server's, got 3",
        ),
    ] {
        let server = Server::start(&place.flags(settings));
        server.command(&restore).check(1).check_says(words);
    }
}

#[test]
fn a_recording_and_its_replay_show_what_was_recorded() {
    let place = Place::new(&[7], (3, 5));
    let folder = TempDir::new().expect("a folder");
    let file = folder.path().join("lab.recording");
    let server = Server::start(&place.flags("--states-symmetries"));
    let recorder = start_recorder(&server.instance, &file, "--truth");
    let mut client = server.acquire(0..1);
    reset(&mut client, 2);
    let mut paths = Paths::new(1);
    while fly(&mut client, paths.next(N_MOVES)).world.truncated == 0 {}
    let is_last = |it: &Sample<TruthHeader>| it.header.step == place.last(2) as u64;
    recorder.until(|| truths(&read(&file).0).iter().any(is_last));
    stop(recorder);
    let records = read_whole(&file);
    let expected = |step: u64| place.states(2, 4, step as usize);
    let mut n_seen = 0;
    for sample in truths(&records).iter().filter(|it| it.header.seed == 2) {
        let states = Grid::from_shape_vec((3, 5), sample.payload.clone()).expect("a grid");
        assert_eq!(states, expected(sample.header.step));
        n_seen += 1;
    }
    assert_eq!(n_seen, 7);
    let Event::Server(info) = &records[0].event else {
        panic!("expected a server, got {:?}", records[0]);
    };
    assert_eq!(info.recorded_world, server.info().recorded_world);
    let again: Instance = new_instance();
    let replay = start_replay(&again, &file, "--loop");
    replay.wait_for_words("replaying");
    let connection = Connection::open(&again, "tests", PATIENCE).expect("connect");
    assert_eq!(connection.info().recorded_world, info.recorded_world);
}

#[test]
fn a_server_takes_less_memory_than_twice_its_recorded_states() {
    let place = Place::new(&[1000], (256, 256));
    let server = Server::start(&place.flags(""));
    let most = memory("VmHWM:", server.program.pid());
    assert!(
        (64_000..2 * 64_000).contains(&most),
        "{most} kB for 64,000 kB of states"
    );
}

#[test]
fn agents_act_without_a_model_in_one_episode_after_the_other() {
    let place = Place::new(&[24, 30], (5, 6));
    let folder = TempDir::new().expect("a folder");
    let settings = folder.path().join("agent.toml");
    let small = "[learning]\nwindow = 4\nblock_windows = 2\nstreams = 4\n";
    std::fs::write(&settings, small).expect("write");
    let out = folder.path().join("out");
    let server = Server::start(&place.flags("--worlds 5 --coverage client"));
    let instance = format!("--instance {}", server.instance.name());
    let act = |words: &str| agent(&format!("{words} {instance}"));
    let (settings, out) = (settings.display(), out.display());
    let learn = format!("train --worlds 2 --steps 400 --out {out} --config {settings}");
    act(&learn);
    let checkpoint = format!("--checkpoint {out}/checkpoint.safetensors");
    for policy in [
        "coverage",
        "oracle_beam",
        "oracle_ahead",
        "random_walk",
        "learned_beam",
        "learned_spatial_beam",
    ] {
        let ended = act(&format!("run --policy {policy} --steps 70 {checkpoint}"));
        ended.check_says("steps=70");
        let n_ends = ended.stderr.matches("the next begins").count();
        assert!(n_ends >= 2, "{policy}: {}", ended.stderr);
    }
    let figures = folder.path().join("figures");
    let draw = format!("--figures {}", figures.display());
    for policies in ["", "--policies random_walk,coverage"] {
        let compare = format!("compare --seeds 0..2 --steps 9 {checkpoint} {draw}");
        act(&format!("{compare} {policies}"));
        let svg = std::fs::read(figures.join("snapshot.svg")).expect("a snapshot");
        assert!(svg.starts_with(b"<svg"));
        std::fs::remove_file(figures.join("snapshot.svg")).expect("remove");
    }
    let ladder = act(&format!("compare --seeds 0..2 {checkpoint}")).stdout;
    for policy in ["coverage", "learned_beam", "clairvoyant_beam"] {
        assert!(ladder.contains(policy), "{ladder}");
    }
    assert!(
        ladder.contains("2 worlds, 23 steps each") && !ladder.contains("| beam_"),
        "{ladder}"
    );
    let refuse = |words: &str, expected| check(AGENT, &format!("{words} {instance}"), expected);
    let no_model = "filters with a model, and recorded worlds have none";
    let beam = format!("\"beam_exploit\" | {no_model}");
    refuse("run", &beam);
    refuse("run --policy spatial_beam", no_model);
    let ladder = "compare --policies coverage,shooting_explore --seeds 0..1";
    refuse(ladder, no_model);
    let words = "--steps: expected at most 23, as the shortest episode has, got 24";
    refuse("compare --seeds 0..1 --steps 24", words);
}

/// States that stay as they are.
const STILL: &str = r##"
name = "still"
kernel_size = [1, 1]
states = [
    { name = "unburnt", color = "#000000", initial = 0.4, observed_as = [1.0, 0.0, 0.0] },
    { name = "burning", color = "#ff0000", initial = 0.3, observed_as = [0.0, 1.0, 0.0], reward = 1.0 },
    { name = "burnt", color = "#777777", initial = 0.3, observed_as = [0.0, 0.0, 1.0] },
]
observations = [
    { name = "dark", color = "#000000" },
    { name = "hot", color = "#ff0000" },
    { name = "grey", color = "#777777" },
]
kernel = [
    { from = "unburnt", to = "unburnt", weights = [[1.0]] },
    { from = "burning", to = "burning", weights = [[1.0]] },
    { from = "burnt", to = "burnt", weights = [[1.0]] },
]
"##;

#[test]
fn beliefs_of_a_given_model_run_on_recorded_states() {
    let place = Place::new(&[6], (3, 5));
    let mut states = place.sequences[0].clone();
    let first = place.sequences[0].index_axis(Axis(0), 0);
    states
        .outer_iter_mut()
        .for_each(|mut step| step.assign(&first));
    let path = |name: &str| place.folder.path().join(name);
    let file = File::create(path("0.npy")).expect("create");
    states.write_npy(file).expect("write");
    let [model, rows] = ["still.toml", "rows.csv"].map(path);
    std::fs::write(&model, STILL).expect("write");
    let compare = format!(
        "compare --states {} --moves 4 --seeds 0..2 --steps 4 --policies beam_exploit,spatial_beam,coverage \
         --baseline coverage --csv {}",
        place.folder.path().display(),
        rows.display()
    );
    let measure = |flags: &str| {
        agent(&format!("{compare} --model {} {flags}", model.display())).check(0);
        let runs = read_runs(&rows).expect("rows");
        let known = runs.into_iter().filter(|run| run.policy != "coverage");
        known.collect::<Vec<_>>()
    };
    let (unknown, known) = (measure(""), measure("--first-state-known"));
    assert_eq!((unknown.len(), known.len()), (4, 4));
    for (unknown, known) in unknown.iter().zip(&known) {
        assert!(unknown.brier > Some(0.0) && unknown.log_likelihood < Some(0.0));
        assert_eq!((known.brier, known.log_likelihood), (Some(0.0), Some(0.0)));
        assert_ne!(unknown.policy_fingerprint, known.policy_fingerprint);
    }
    check(
        AGENT,
        &compare,
        "policy \"beam_exploit\" filters with a model, and recorded worlds have none",
    );
    let other =
        "--model: expected the recorded states unburnt, burning, burnt, got normal, latent, fire";
    check(AGENT, &format!("{compare} --model wildfire"), other);
    let unpaid = place.folder.path().join("unpaid.toml");
    std::fs::write(&unpaid, STILL.replace("reward = 1.0", "reward = 2.0")).expect("write");
    check(
        AGENT,
        &format!("{compare} --model {}", unpaid.display()),
        "--model: expected the rewards of the recorded states, [0.0, 1.0, 0.0], got [0.0, 2.0, 0.0]",
    );
    let train = format!(
        "train --states {} --model wildfire",
        place.folder.path().display()
    );
    let out = path("out").display().to_string();
    check(
        AGENT,
        &format!("{train} --out {out}"),
        "--model cannot be used with --states",
    );
    check(
        AGENT,
        &format!("{compare} --first-state-known --prior uniform"),
        "cannot be used with",
    );
}

#[test]
fn settings_that_a_states_file_decides_are_refused_as_flags() {
    let place = Place::new(&[3], (3, 5));
    let states = format!("--states {}", place.folder.path().display());
    for (flag, setting) in [
        ("--height 3", "height"),
        ("--width 5", "width"),
        ("--burn-in 0", "burn_in"),
        ("--model wildfire", "model"),
    ] {
        let words = format!("{setting}: expected to be left out, as the states file decides it");
        check(SERVER, &format!("{states} {flag}"), &words);
    }
    let table = "--states-offset 3 => expected none without a states file
STATES --states-offset 2 => states_offset: expected 0 to 1
--states no/such.npz => states file no/such.npz: No such file";
    check_table(SERVER, &table.replace("STATES", &states));
    for (command, flag) in [("compare", "--height"), ("train --out x", "--burn-in")] {
        let words = format!("--states <NAME|FILE|FOLDER> | cannot be used with | {flag}");
        check(AGENT, &format!("{command} {states} {flag} 3"), &words);
    }
}

#[test]
fn the_landscape_that_ships_is_a_states_file() {
    let states = repository().join("config/landscapes/jacksboro/jacksboro.npz");
    run(SERVER, &format!("--check --states {}", states.display())).check(0);
}

#[test]
fn a_pipe_is_no_states_file() {
    let folder = TempDir::new().expect("a folder");
    std::fs::write(folder.path().join("states.toml"), DESCRIPTION).expect("write");
    let pipe = folder.path().join("0.npy");
    mknodat(CWD, &pipe, FileType::Fifo, Mode::RUSR, 0).expect("a pipe");
    let states = format!("--states {}", folder.path().display());
    check(SERVER, &states, "0.npy: expected a regular file");
}
