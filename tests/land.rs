//! A land and a sensor like real ones on a running server: what robots see, earn and where they fly, from the paths, the
//! hidden states and `hello` alone.

use crate::commands::{agent, check};
use crate::recording::{read_whole, start_recorder, stop};
use emberwatch_protocol::client::Observation;
use emberwatch_protocol::observer::Observer;
use emberwatch_protocol::recording::Event;
use emberwatch_protocol::{Cell, Model, Move, UNOBSERVED};
use std::collections::BTreeMap;
use std::path::Path;
use tempfile::TempDir;
use tests::harness::{PATIENCE, Paths, SERVER, Server, reset, run};

const N_MOVES: usize = 6;

/// A model of 7 x 9 cells in three zones, with two observation matrices and a wall that has a gap.
fn write_model(folder: &Path, pays: &str) -> String {
    let wildfire = Model::built_in("wildfire-small").expect("built in");
    let mut file = wildfire.file().clone();
    let kernel = std::mem::take(&mut file.kernel);
    let mut text = String::from("zone_map = [");
    for row in 0..7 {
        let zones: Vec<String> = (0..9).map(|col| ((row + col) % 3).to_string()).collect();
        text += &format!("[{}],", zones.join(","));
    }
    text += "]\nno_fly = [";
    for row in 0..7 {
        let closed: Vec<&str> = (0..9)
            .map(|col| if col == 4 && row != 3 { "1" } else { "0" })
            .collect();
        text += &format!("[{}],", closed.join(","));
    }
    text += "]\n";
    file.name = "land".into();
    let rest = toml::to_string(&file)
        .expect("TOML")
        .replace("kernel = []\n", "");
    text += &rest;
    text += &format!("\n[sensor]\nradius = 2\npays = {pays:?}\n[[sensor.rings]]\nobserved_as = ");
    text += "[[0.8, 0.1, 0.1], [0.3, 0.4, 0.3], [0.1, 0.1, 0.8]]\n";
    for zone in 0..3 {
        text += &format!("[[zones]]\nname = \"z{zone}\"\ncolor = \"#80{zone}{zone}80\"\n");
        for entry in &kernel {
            let scale = entry.scale * f64::from(1 + zone);
            text += &format!(
                "[[kernel]]\nzone = \"z{zone}\"\nfrom = {:?}\nto = {:?}\nscale = {scale:?}\nweights = {:?}\n",
                entry.from, entry.to, entry.weights
            );
        }
    }
    let path = folder.join("land.toml");
    std::fs::write(&path, text).expect("a file");
    path.display().to_string()
}

fn flags(model: &str) -> String {
    format!(
        "--model {model} --height 7 --width 9 --moves {N_MOVES} --burn-in 3000 --robots 2 --publish-truth --start random"
    )
}

/// The distance of each cell in sight from the nearest cell of a path, and the path's distinct cells.
fn in_sight(start: Cell, path: &[Move]) -> (BTreeMap<usize, usize>, Vec<usize>, Cell) {
    let (mut row, mut col) = (start.row as isize, start.col as isize);
    let mut visited = Vec::new();
    for step in path {
        let [down, right] = [[-1, 0], [1, 0], [0, -1], [0, 1]][*step as usize];
        let next = (row + down, col + right);
        let is_on_grid = (0..7).contains(&next.0) && (0..9).contains(&next.1);
        if is_on_grid && (next.1 != 4 || next.0 == 3) {
            (row, col) = next;
        }
        let cell = (row * 9 + col) as usize;
        if !visited.contains(&cell) {
            visited.push(cell);
        }
    }
    let mut distances = BTreeMap::new();
    for cell in 0..63 {
        let distance = |&at: &usize| (at / 9).abs_diff(cell / 9).max((at % 9).abs_diff(cell % 9));
        if let Some(nearest) = visited.iter().map(distance).min().filter(|&it| it <= 2) {
            distances.insert(cell, nearest);
        }
    }
    let (row, col) = (row as usize, col as usize);
    (distances, visited, Cell { row, col })
}

#[test]
fn robots_see_earn_and_fly_as_plain_loops_say() {
    let folder = TempDir::new().expect("a folder");
    for pays in ["visited", "seen"] {
        let model = write_model(folder.path(), pays);
        let server = Server::start(&flags(&model));
        let info = server.info();
        let airspace = info.airspace.clone().expect("an airspace");
        assert_eq!(
            (airspace.radius, airspace.n_rings, info.n_observations),
            (2, 2, 6)
        );
        assert_eq!(info.zones.as_ref().map(|zones| zones.names.len()), Some(3));
        let truth = Observer::truth(&server.instance).expect("truth");
        let mut client = server.acquire(0..2);
        let mut paths = Paths::new(3);
        let (mut n_seen, mut n_right) = ([0; 2], [0; 2]);
        reset(&mut client, 1000);
        let mut total = 0.0;
        for _ in 0..200 {
            let starts = client.observe(0..2).expect("observe");
            let flown = paths.take(N_MOVES, 2);
            let seen = client.step(0..2, &flown).expect("step");
            let step = seen[0].world.step;
            let states = loop {
                let sample = truth.receive(PATIENCE).expect("receive").expect("a state");
                if sample.header.step == step && sample.header.episode == seen[0].world.episode {
                    break sample.payload;
                }
            };
            let mut paying: BTreeMap<usize, u32> = BTreeMap::new();
            for ((before, path), after) in starts.iter().zip(&flown).zip(&seen) {
                let (distances, visited, end) = in_sight(before.robot.cell(), path);
                assert_eq!(after.robot.cell(), end);
                assert_eq!(after.robot.n_visited as usize, visited.len());
                for (cell, &value) in after.frame.as_bytes().iter().enumerate() {
                    let matrix = distances.get(&cell).map(|&distance| distance.min(1));
                    let got = (value != UNOBSERVED).then_some(usize::from(value) / 3);
                    assert_eq!(got, matrix, "cell {cell}");
                    if let Some(matrix) = matrix {
                        n_seen[matrix] += 1;
                        n_right[matrix] += usize::from(value % 3 == states[cell]);
                    }
                }
                let cells: Vec<usize> = match pays {
                    "seen" => distances.keys().copied().collect(),
                    _ => visited,
                };
                cells
                    .into_iter()
                    .for_each(|cell| *paying.entry(cell).or_default() += 1);
            }
            let burning = paying.keys().filter(|&&cell| states[cell] == 2).count();
            assert_eq!(seen[0].world.reward, burning as f64);
            total += seen[0].world.reward;
            check_team_frame(&mut client, &seen);
        }
        assert!(total > 0.0, "no fire was met");
        let share = |matrix: usize| n_right[matrix] as f64 / n_seen[matrix] as f64;
        assert!(share(0) > share(1) + 0.1, "{} {}", share(0), share(1));
    }
}

/// A team frame has the lowest value of its robots' frames.
fn check_team_frame(client: &mut emberwatch_protocol::Client, seen: &[Observation]) {
    client.share_frames(true);
    let team = client.observe(0..2).expect("observe");
    client.share_frames(false);
    let frames = seen[0]
        .frame
        .as_bytes()
        .iter()
        .zip(seen[1].frame.as_bytes());
    let lowest: Vec<u8> = frames.map(|(one, other)| *one.min(other)).collect();
    assert_eq!(team[0].frame.as_bytes(), lowest);
}

#[test]
fn snapshots_and_recordings_of_a_land_go_on() {
    let folder = TempDir::new().expect("a folder");
    let model = write_model(folder.path(), "seen");
    let (snapshot, recording) = (
        folder.path().join("a.snapshot"),
        folder.path().join("a.recording"),
    );
    let server = Server::start(&flags(&model));
    let recorder = start_recorder(&server.instance, &recording, "");
    let mut client = server.acquire(0..2);
    let future = |client: &mut emberwatch_protocol::Client, seed| {
        let paths = Paths::new(seed).take(N_MOVES, 10);
        let pairs = paths
            .chunks(2)
            .map(|pair| client.step(0..2, pair).expect("step"));
        pairs.collect::<Vec<_>>()
    };
    future(&mut client, 1);
    server
        .command(&format!("snapshot {}", snapshot.display()))
        .check(0);
    let went_on = future(&mut client, 2);
    stop(recorder);
    let restored = format!("{} --restore {}", flags(&model), snapshot.display());
    let again = Server::start(&restored);
    assert_eq!(future(&mut again.acquire(0..2), 2), went_on);
    let other = write_model(folder.path(), "visited");
    let other = format!("{} --restore {}", flags(&other), snapshot.display());
    check(SERVER, &other, "model: expected");
    let info = server.info();
    let has_land = |event: &Event| match event {
        Event::Server(told) => told.airspace == info.airspace && told.zones == info.zones,
        _ => false,
    };
    assert!(
        read_whole(&recording)
            .iter()
            .any(|record| has_land(&record.event))
    );
    // Agents of every kind fly there.
    for policy in [
        "beam_exploit",
        "shooting_explore",
        "random_walk",
        "spatial_beam",
        "oracle_ahead",
    ] {
        let run = format!(
            "run --instance {} --policy {policy} --steps 3 --team",
            again.instance.name()
        );
        agent(&run).check(0);
    }
}

#[test]
fn a_server_refuses_a_land_that_cannot_be() {
    let folder = TempDir::new().expect("a folder");
    let model = write_model(folder.path(), "seen");
    let check = |flags: &str, words: &str| check(SERVER, flags, words);
    let land = format!("--model {model} --height 7 --width 9 --burn-in 0");
    check(
        &format!("{land} --start 0,4"),
        "start: expected a cell where robots may be, got (0, 4), a no-fly cell",
    );
    check(
        &format!("--model {model} --height 9 --width 7 --burn-in 0"),
        "zone_map: expected a map of the 9 x 7 grid, got 7 x 9",
    );
    check("--sensor-radius 9", "--sensor-radius");
    check(
        "--task small --sensor-radius 1",
        "sensor_radius: expected to be left out, as the task decides it",
    );
    let text = std::fs::read_to_string(&model).expect("the model");
    let (head, rest) = text.split_once("no_fly = ").expect("a map");
    let (_, rest) = rest.split_once('\n').expect("its end");
    let with = |map: &str| {
        std::fs::write(&model, format!("{head}no_fly = {map}\n{rest}")).expect("a file")
    };
    let rows = |closed: fn(usize, usize) -> bool| {
        let row = |row| {
            (0..9)
                .map(|col| u8::from(closed(row, col)))
                .collect::<Vec<_>>()
        };
        format!("{:?}", (0..7).map(row).collect::<Vec<_>>())
    };
    with(&rows(|row, col| row + col == 1));
    check(
        &land,
        "start: expected a cell that robots can leave, got (0, 0), which no-fly cells cut off",
    );
    with(&rows(|_, _| true));
    check(
        &land,
        "no_fly: expected a cell where robots may be, got none",
    );
    with(&rows(|row, col| (row + col) % 2 == 1));
    check(
        &format!("{land} --start random"),
        "start: expected a cell that robots can leave",
    );
    with("\"missing.npy\"");
    check(&land, "missing.npy");
}

#[test]
fn the_share_of_cells_that_no_fly_cells_close_off_is_logged() {
    let folder = TempDir::new().expect("a folder");
    let path = folder.path().join("pocket.toml");
    let row = |row: usize| match row {
        1 => [1, 0, 0, 1, 0],
        0 | 2 => [1, 1, 1, 1, 0],
        _ => [0; 5],
    };
    let rows: Vec<[u8; 5]> = (0..5).map(row).collect();
    let text = include_str!("../config/models/wildfire.toml");
    std::fs::write(&path, format!("no_fly = {rows:?}\n{text}")).expect("a model");
    let flags = format!(
        "--model {} --height 5 --width 5 --burn-in 0",
        path.display()
    );
    let share = "no-fly cells close off 2 of 15 free cells (13.33 %)";
    let checked = |start: &str| run(SERVER, &format!("--check {flags} --start {start}")).check(0);
    let random = checked("random");
    random.check_says(share).check_prints("start = \"random\"");
    assert!(!random.stderr.contains("WARN"), "{}", random.stderr);
    let closed_in = checked("1,2");
    closed_in.check_says(share);
    closed_in.check_says(
        "start: no-fly cells close in (1, 2): robots that start there reach 2 of 15 free cells",
    );
    let server = Server::start(&format!("{flags} --start random"));
    server.program.wait_for_words(share);
}
