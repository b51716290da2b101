//! Tests of recorded worlds: servers show and restore them, and agents act there without a known model.

use crate::commands::{agent, check, check_table};
use emberwatch_agent::benchmark::report::runs_file::read_runs;
use emberwatch_agent::client::truth::TruthFeed;
use emberwatch_protocol::Shape;
use emberwatch_protocol::model::Description;
use ndarray::{Array3, Axis};
use ndarray_npy::WriteNpyExt;
use tests::harness::{AGENT, Folder, SERVER, Server, fly_on, reset};
use tests::meter::memory;

const N_MOVES: usize = 4;

/// A model whose states never change and are observed without noise.
const STILL: &str = r##"
name = "lab"
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

/// Converts the model [`STILL`] to a description of recorded states, which lacks the kernel.
fn description() -> String {
    let (states, _) = STILL.split_once("kernel = [").expect("a model");
    let states = states.replace("kernel_size = [1, 1]", "step = \"10 min\"");
    states
        .replace("initial = 0.4, ", "")
        .replace("initial = 0.3, ", "")
}

/// A folder with recorded sequences, no two of whose recorded steps are equal.
struct Place {
    folder: Folder,
    sequences: Vec<Array3<u8>>,
}

impl Place {
    fn new(lengths: &[usize], (height, width): (usize, usize)) -> Self {
        let folder = Folder::default();
        let sequence = |(index, &length): (usize, &usize)| {
            // The states are base-3 digits of a hash, so that no step is symmetric and no two steps are equal.
            Array3::from_shape_fn((length, height, width), |(k, row, col)| {
                let number = ((index * 97 + k) * height + row) * width + col;
                let hash = (number as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
                ((hash >> 40) % 3) as u8
            })
        };
        let sequences: Vec<_> = lengths.iter().enumerate().map(sequence).collect();
        folder.write("states.toml", description());
        let place = Self { folder, sequences };
        for index in 0..lengths.len() {
            place.write(index, &place.sequences[index]);
        }
        place
    }

    fn write(&self, index: usize, states: &Array3<u8>) {
        let mut bytes = Vec::new();
        states.write_npy(&mut bytes).expect("into memory");
        self.folder.write(&format!("{index}.npy"), bytes);
    }

    fn flags(&self, more: &str) -> String {
        let folder = self.folder.word("");
        format!("--states {folder} --moves {N_MOVES} --publish-truth {more}")
    }
}

#[test]
fn a_restored_world_goes_on_and_another_states_file_is_refused() {
    let (place, other) = (Place::new(&[9, 12], (3, 5)), Place::new(&[9, 13], (3, 5)));
    let settings = "--states-symmetries --states-offset 3 --start random";
    let server = Server::start(&place.flags(settings));
    let info = server.info();
    let recorded = info.recorded_world.expect("it is one");
    assert_eq!((recorded.n_sequences, recorded.n_steps), (2, 5));
    assert_eq!((info.height, info.width, info.burn_in), (3, 5, 0));
    assert_eq!((info.model, &*info.observations[1]), (None, "hot"));
    let model = Description::model_of(&recorded.description.expect("revealed"));
    assert_eq!(model.expect("valid").name(), "lab");
    let future = |server: &Server| {
        let shape = Shape::new(3, 5).expect("a shape");
        let truth = TruthFeed::open(&server.instance, shape).expect("truth");
        let seen = fly_on(&mut server.acquire(0..1), 5, 3);
        let last = &seen[2].world;
        let states = truth.states(0..1, &[last.seed], last.step).expect("truth");
        (seen, states)
    };
    reset(&mut server.acquire(0..1), 21);
    let folder = Folder::default();
    let file = folder.word("lab.snapshot");
    server.command(&format!("snapshot {file}")).check(0);
    let settings = format!("{settings} --restore {file} --reveal-model false");
    let again = Server::start(&place.flags(&settings));
    assert_eq!(future(&again), future(&server));
    let hidden = again.info().recorded_world.expect("it is one");
    assert_eq!(hidden.description, None);
    let words = "states: expected 2 sequences of CRC-32 ";
    check(SERVER, &other.flags(&settings), words);
}

#[test]
fn a_server_takes_less_memory_than_twice_its_recorded_states() {
    let place = Place::new(&[1000], (256, 256));
    let server = Server::start(&place.flags(""));
    let most = memory("VmHWM:", server.program.pid());
    assert!(
        (64_000..128_000).contains(&most),
        "{most} kB for 64,000 kB of states"
    );
}

#[test]
fn agents_act_without_a_model_in_one_episode_after_the_other() {
    let place = Place::new(&[24, 30], (5, 6));
    let small = "[learning]\nwindow = 4\nblock_windows = 2\nstreams = 4\n";
    let results = Folder::default();
    let settings = results.write("agent.toml", small);
    let server = Server::start(&place.flags("--worlds 5 --coverage client"));
    let act = |words: &str| agent(&format!("{words} {}", server.flag()));
    let out = results.word("out");
    act(&format!(
        "train --worlds 2 --steps 400 --out {out} --config {settings}"
    ));
    let checkpoint = format!("--checkpoint {out}/checkpoint.safetensors");
    for policy in [
        "coverage",
        "oracle_ahead",
        "random_walk",
        "learned+spatial/beam/exploit",
    ] {
        let ended = act(&format!("run --policy {policy} --steps 70 {checkpoint}"));
        ended.check_says("steps=70");
        let n_ends = ended.stderr.matches("the next one starts").count();
        assert!(n_ends >= 2, "{policy}: {}", ended.stderr);
    }
    let ladder = act(&format!("compare --seeds 0..2 {checkpoint}"));
    for words in ["coverage", "learned_beam", "2 worlds, 23 steps each"] {
        ladder.check_prints(words);
    }
    assert!(!ladder.stdout.contains("| beam_"), "{}", ladder.stdout);
    let no_model = "filters with a model, and recorded worlds have none";
    let too_long = "--steps: expected at most 23, the length of the shortest episode, got 24";
    for (words, expected) in [
        ("run --policy known+spatial/beam/exploit", no_model),
        (
            "compare --seeds 0..1 --policies known/shooting/explore",
            no_model,
        ),
        ("compare --seeds 0..1 --steps 24", too_long),
    ] {
        check(AGENT, &format!("{words} {}", server.flag()), expected);
    }
}

#[test]
fn beliefs_of_a_given_model_run_on_recorded_states() {
    let place = Place::new(&[6], (3, 5));
    let mut states = place.sequences[0].clone();
    let first = place.sequences[0].index_axis(Axis(0), 0);
    states
        .outer_iter_mut()
        .for_each(|mut step| step.assign(&first));
    place.write(0, &states);
    let folder = Folder::default();
    let compare = format!(
        "compare --states {} --moves 4 --seeds 0..2 --steps 4 --policies known/beam/exploit,beam,coverage \
         --baseline coverage --csv {}",
        place.folder.word(""),
        folder.word("rows.csv")
    );
    let model = folder.write("still.toml", STILL);
    agent(&format!("{compare} --model {model}"));
    let mut runs = read_runs(&folder.path("rows.csv")).expect("rows");
    runs.retain(|run| run.policy != "coverage");
    assert_eq!(runs.len(), 4);
    for run in &runs {
        assert!(run.brier > Some(0.0) && run.log_likelihood < Some(0.0));
    }
    let unpaid = STILL.replace("reward = 1.0", "reward = 2.0");
    let unpaid = format!("--model {}", folder.write("unpaid.toml", unpaid));
    for (flags, words) in [
        (
            "--model wildfire",
            "--model: expected the recorded states unburnt, burning, burnt, got normal, latent, fire",
        ),
        (
            &unpaid,
            "--model: expected the rewards of the recorded states, [0.0, 1.0, 0.0], got [0.0, 2.0, 0.0]",
        ),
    ] {
        check(AGENT, &format!("{compare} {flags}"), words);
    }
    let states = format!("--states {}", place.folder.word(""));
    let table = format!(
        "train {states} --model wildfire --out x => model: expected to be left out, as the states file decides it
compare {states} --height 3 => height: expected to be left out, as the states file decides it"
    );
    check_table(AGENT, &table);
    let table = format!(
        "{states} --states-offset 5 => states_offset: expected 0 to 4
--states no/such.npz => states file no/such.npz: No such file"
    );
    check_table(SERVER, &table);
}
