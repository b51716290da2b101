//! A running server with maps, no-fly cells and a wide sensor.

use crate::commands::{agent, check};
use emberwatch_protocol::Model;
use ndarray::Array2;
use ndarray_npy::NpzWriter;
use std::io::Cursor;
use tests::harness::{Folder, SERVER, Server, run};

/// Returns the flags of a server on a land of 7 x 9 cells: a model with a map of fuel, a sensor radius, and the no-fly
/// cells for which `is_closed` holds.
fn land(folder: &Folder, radius: usize, is_closed: fn(usize, usize) -> bool) -> String {
    let burnout = Model::built_in("wildfire-burnout").expect("built in");
    let mut file = burnout.file().clone();
    file.name = "land".into();
    file.transitions[0].base = 0.02;
    file.transitions[0].times = vec!["fuel".into()];
    let fuel = Array2::from_shape_fn((7, 9), |(row, col)| (row * col % 3) as f32);
    let mut archive = NpzWriter::new(Cursor::new(Vec::new()));
    archive.add_array("fuel", &fuel).expect("an array");
    let archive = archive.finish().expect("an archive");
    folder.write("land.npz", archive.into_inner());
    let rest = toml::to_string(&file).expect("TOML");
    let row = |row| Vec::from_iter((0..9).map(|col| u8::from(is_closed(row, col))));
    let no_fly = Vec::from_iter((0..7).map(row));
    let text =
        format!("maps = \"land.npz\"\nno_fly = {no_fly:?}\n{rest}\n[sensor]\nradius = {radius}\n");
    let model = folder.write("land.toml", text);
    format!("--model {model} --height 7 --width 9 --moves 6 --burn-in 3000")
}

#[test]
fn agents_act_on_a_land_that_hello_describes_and_another_refuses_its_snapshot() {
    let folder = Folder::default();
    let wall = |row, col| col == 4 && row != 3;
    let more = "--robots 2 --publish-truth --start random";
    let snapshot = folder.word("a.snapshot");
    let server = Server::start(&format!("{} {more}", land(&folder, 2, wall)));
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
        let flags = format!("--policy {policy} --steps 3 --team joint");
        agent(&format!("run {} {flags}", server.flag()));
    }
    let other = land(&folder, 1, wall);
    check(
        SERVER,
        &format!("{other} {more} --restore {snapshot}"),
        "model: expected",
    );
    // No-fly cells enclose two free cells.
    let pocket = |row, col| row < 3 && col < 4 && (row, col) != (1, 1) && (row, col) != (1, 2);
    let checked = run(
        SERVER,
        &format!("--check {} --start 1,2", land(&folder, 2, pocket)),
    );
    for words in [
        "no-fly cells cut off 2 of 53 free cells (3.77 %)",
        "start: no-fly cells enclose (1, 2): robots that start there reach 2 of 53 free cells",
        "model \"land\": 3 states, 3 transitions, maps 7 x 9",
    ] {
        checked.check_says(words);
    }
}
