//! Tests of maps, no-fly cells and a wide sensor on a running server. The expected observations and rewards are
//! derived only from the paths, the hidden states and the reply to `hello`.

use crate::commands::{agent, check};
use crate::trainings::on;
use emberwatch_protocol::observer::Observer;
use emberwatch_protocol::{Model, UNOBSERVED};
use ndarray::Array2;
use ndarray_npy::NpzWriter;
use std::collections::BTreeSet;
use std::io::Cursor;
use tests::harness::{Folder, PATIENCE, Paths, SERVER, Server, reset, run};

const N_MOVES: usize = 6;

/// Returns a map of 7 x 9 cells as TOML.
fn map(value: impl Fn(usize, usize) -> usize) -> String {
    let row = |row| Vec::from_iter((0..9).map(|col| value(row, col)));
    format!("{:?}", Vec::from_iter((0..7).map(row)))
}

/// Writes a model with a map of fuel, a sensor radius and a wall of no-fly cells with a gap.
fn write_model(folder: &Folder, radius: usize) -> String {
    let burnout = Model::built_in("wildfire-burnout").expect("built in");
    let mut file = burnout.file().clone();
    file.name = "land".into();
    file.transitions[0].base = 0.02;
    file.transitions[0].times = vec!["fuel".into()];
    let fuel = Array2::from_shape_fn((7, 9), |(row, col)| (row * col % 3) as f32);
    let mut archive = NpzWriter::new(Cursor::new(Vec::new()));
    archive.add_array("fuel", &fuel).expect("an array");
    let archive = archive.finish().expect("an archive");
    std::fs::write(folder.path("land.npz"), archive.into_inner()).expect("a file");
    let rest = toml::to_string(&file).expect("TOML");
    let wall = map(|row, col| usize::from(col == 4 && row != 3));
    let text =
        format!("maps = \"land.npz\"\nno_fly = {wall}\n{rest}\n[sensor]\nradius = {radius}\n");
    folder.write("land.toml", text)
}

fn flags(model: &str) -> String {
    format!(
        "--model {model} --height 7 --width 9 --moves {N_MOVES} --burn-in 3000 --robots 2 --publish-truth --start random"
    )
}

#[test]
fn robots_see_and_earn_what_hello_and_the_hidden_states_say() {
    let folder = Folder::default();
    let server = Server::start(&flags(&write_model(&folder, 2)));
    let info = server.info();
    let airspace = info.airspace().expect("an airspace");
    assert_eq!((airspace.radius(), info.n_observations), (2, 3));
    let model = info.model.as_ref().expect("a model");
    let model = Model::from_toml(model).expect("a model with its map");
    let hazards = model.hazards().expect("hazards");
    assert_eq!(hazards.maps()["fuel"].shape(), [7, 9]);
    let truth = Observer::truth(&server.instance).expect("truth");
    let mut client = server.acquire(0..2);
    reset(&mut client, 1000);
    let (mut paths, mut total) = (Paths::new(3), 0.0);
    // The number of cells observed next to the paths, how many of these were observed correctly, and the expected number.
    let (mut n_seen, mut n_right, mut n_expected) = (0.0_f64, 0.0, 0.0);
    let likelihood = model.likelihood();
    for _ in 0..200 {
        let starts = client.observe(0..2).expect("observe");
        let flown = paths.take(N_MOVES, 2);
        let seen = client.step(0..2, &flown).expect("step");
        let world = seen[0].world;
        let states = loop {
            let sample = truth.receive(PATIENCE).expect("receive").expect("a state");
            if (sample.header.step, sample.header.episode) == (world.step, world.episode) {
                break sample.payload;
            }
        };
        let mut paying = BTreeSet::new();
        for ((before, path), after) in starts.iter().zip(&flown).zip(&seen) {
            let flight = airspace.fly(before.robot.cell(), path);
            assert_eq!(after.robot.cell(), flight.end);
            assert_eq!(after.robot.n_visited as usize, flight.visited.len());
            let in_sight = airspace.see(&flight.visited);
            for (cell, &value) in after.frame.as_bytes().iter().enumerate() {
                let is_seen = in_sight.contains(&cell);
                assert_eq!(value != UNOBSERVED, is_seen, "cell {cell}");
                if is_seen && !flight.visited.contains(&cell) {
                    let state = usize::from(states[cell]);
                    n_seen += 1.0;
                    n_right += f64::from(u8::from(value == states[cell]));
                    n_expected += likelihood[[state, state]];
                }
            }
            paying.extend(flight.visited);
        }
        let burning = paying.iter().filter(|&&cell| states[cell] == 1).count();
        assert_eq!(world.reward, burning as f64);
        total += world.reward;
    }
    assert!(total > 0.0, "no fire was met");
    // A count of independent readings has a standard error of at most sqrt(n) / 2. Two robots may count a reading twice.
    let bound = 4.0 * n_seen.sqrt();
    let off = (n_right - n_expected).abs();
    assert!(off < bound, "{n_right} of {n_seen}: expected {n_expected}");
}

#[test]
fn agents_act_on_a_land_and_another_refuses_its_snapshot() {
    let folder = Folder::default();
    let model = write_model(&folder, 2);
    let snapshot = folder.word("a.snapshot");
    let server = Server::start(&flags(&model));
    server.command(&format!("snapshot {snapshot}")).check(0);
    for policy in [
        "known/beam/exploit",
        "known/shooting/explore",
        "random_walk",
        "known+spatial/beam/exploit",
        "oracle_ahead",
    ] {
        agent(&format!(
            "run {} --policy {policy} --steps 3 --team joint",
            on(&server)
        ));
    }
    let other = flags(&write_model(&folder, 1));
    let restore = format!("--restore {snapshot}");
    check(SERVER, &format!("{other} {restore}"), "model: expected");
}

#[test]
fn cells_that_no_fly_cells_cut_off_are_told_of() {
    let folder = Folder::default();
    let model = write_model(&folder, 2);
    let land = format!("--model {model} --height 7 --width 9 --burn-in 0");
    let text = folder.text("land.toml");
    let (head, rest) = text.split_once("no_fly = ").expect("a map");
    let (_, rest) = rest.split_once('\n').expect("its end");
    // A map in which no-fly cells enclose two free cells.
    let pocket = map(|row, col| {
        usize::from(row < 3 && col < 4 && (row, col) != (1, 1) && (row, col) != (1, 2))
    });
    folder.write("land.toml", format!("{head}no_fly = {pocket}\n{rest}"));
    let share = "no-fly cells cut off 2 of 53 free cells (3.77 %)";
    let random = run(SERVER, &format!("--check {land} --start random")).check(0);
    random.check_says(share).check_prints("start = \"random\"");
    random.check_says("model \"land\": 3 states, 3 transitions, maps 7 x 9");
    assert!(!random.stderr.contains("WARN"), "{}", random.stderr);
    let closed_in = run(SERVER, &format!("--check {land} --start 1,2")).check(0);
    closed_in.check_says(share).check_says(
        "start: no-fly cells enclose (1, 2): robots that start there reach 2 of 53 free cells",
    );
    let server = Server::start(&format!("{land} --start random"));
    server.program.wait_for_words(share);
}
