//! Tests of maps, no-fly cells and a wide sensor on a running server.

use crate::commands::{agent, check};
use crate::trainings::on;
use emberwatch_protocol::Model;
use ndarray::Array2;
use ndarray_npy::NpzWriter;
use std::io::Cursor;
use tests::harness::{Folder, SERVER, Server, run};

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
fn hello_describes_a_land_agents_act_on_it_and_another_refuses_its_snapshot() {
    let folder = Folder::default();
    let model = write_model(&folder, 2);
    let snapshot = folder.word("a.snapshot");
    let server = Server::start(&flags(&model));
    server.command(&format!("snapshot {snapshot}")).check(0);
    let info = server.info();
    let airspace = info.airspace().expect("an airspace");
    assert_eq!((airspace.radius(), airspace.is_open()), (2, false));
    let model = Model::from_toml(&info.model.expect("revealed")).expect("a model with its map");
    let maps = model.hazards().expect("hazards").maps();
    assert_eq!(maps["fuel"].shape(), [7, 9]);
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
    let checked = run(SERVER, &format!("--check {land} --start 1,2")).check(0);
    for words in [
        "no-fly cells cut off 2 of 53 free cells (3.77 %)",
        "start: no-fly cells enclose (1, 2): robots that start there reach 2 of 53 free cells",
        "model \"land\": 3 states, 3 transitions, maps 7 x 9",
    ] {
        checked.check_says(words);
    }
}
