//! Where robots may fly and what they see, against plain loops over all cells of the grid.

use super::models::{shape, unit};
use emberwatch_model::{
    Airspace, CellMap, KernelEntry, ModelFile, Parts, Pays, RingEntry, SensorEntry, StateEntry,
    ZoneEntry,
};
use emberwatch_model::{Cell, Grid, Model, Move};
use proptest::prelude::*;
use std::collections::BTreeMap;
use std::sync::Arc;

fn random_map(key: u64, (height, width): (usize, usize)) -> Grid<bool> {
    let blocked = |(row, col): (usize, usize)| unit(key, row * width + col) < 0.3;
    Grid::from_shape_fn((height, width), blocked)
}

proptest! {
    // No file of failures: tests leave the source tree alone.
    #![proptest_config(ProptestConfig { cases: 300, failure_persistence: None, ..Default::default() })]

    #[test]
    fn flights_and_what_is_seen_are_those_of_plain_loops(
        key in 0_u64..1_000_000,
        side in (1_usize..20, 1_usize..20),
        radius in 0_usize..9,
        n_moves in 0_usize..30,
    ) {
        let (height, width) = side;
        let mut map = random_map(key, side);
        let start = [(unit(key, 900) * height as f64) as usize, (unit(key, 901) * width as f64) as usize];
        map[start] = false;
        let n_rings = 1 + (unit(key, 902) * (radius + 1) as f64) as usize;
        let moves: Vec<usize> = (0..n_moves).map(|t| (unit(key + 1, t) * 4.0) as usize).collect();

        let mut at = start.map(|at| at as isize);
        let mut visited = Vec::new();
        for &step in &moves {
            let [down, right] = [[-1, 0], [1, 0], [0, -1], [0, 1]][step];
            let next = [at[0] + down, at[1] + right];
            let index = [next[0] as usize, next[1] as usize];
            if map.get(index).is_some_and(|blocked| !blocked) {
                at = next;
            }
            let cell = at[0] as usize * width + at[1] as usize;
            if !visited.contains(&cell) {
                visited.push(cell);
            }
        }
        let mut expected = BTreeMap::new();
        for (row, col) in ndarray::indices(side) {
            let distance = |&from: &usize| (from / width).abs_diff(row).max((from % width).abs_diff(col));
            if let Some(nearest) = visited.iter().map(distance).min().filter(|&it| it <= radius) {
                expected.insert(row * width + col, nearest.min(n_rings - 1) as u8);
            }
        }

        let air = Airspace::new(shape(height, width), Some(Arc::new(map)), radius, n_rings, Pays::Seen);
        let path: Vec<Move> = moves.iter().map(|&step| Move::from_low_bits(step as u64)).collect();
        let flight = air.fly(Cell { row: start[0], col: start[1] }, &path);
        prop_assert_eq!(&flight.visited, &visited);
        prop_assert_eq!([flight.end.row as isize, flight.end.col as isize], at);
        let seen = air.see(&flight.visited);
        prop_assert_eq!(seen.len(), expected.len());
        for it in seen {
            prop_assert_eq!(expected.get(&it.cell), Some(&it.ring));
        }
    }
}

/// The parts of a map's free cells, by joining neighbours until nothing changes.
fn parts(map: &Grid<bool>) -> Vec<Vec<usize>> {
    let width = map.ncols();
    let free: Vec<usize> = (0..map.len())
        .filter(|&at| !map[[at / width, at % width]])
        .collect();
    let mut parts: Vec<Vec<usize>> = free.iter().map(|&cell| vec![cell]).collect();
    let touch = |&a: &usize, &b: &usize| {
        (a / width).abs_diff(b / width) + (a % width).abs_diff(b % width) == 1
    };
    let joined = |a: &Vec<usize>, b: &Vec<usize>| a.iter().any(|a| b.iter().any(|b| touch(a, b)));
    let mut at = 0;
    while at < parts.len() {
        match (at + 1..parts.len()).find(|&other| joined(&parts[at], &parts[other])) {
            Some(other) => {
                let other = parts.remove(other);
                parts[at].extend(other);
            }
            None => at += 1,
        }
    }
    parts.iter_mut().for_each(|part| part.sort_unstable());
    parts
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, failure_persistence: None, ..Default::default() })]

    #[test]
    fn random_starts_are_the_largest_connected_part(
        key in 0_u64..1_000_000,
        side in (1_usize..9, 1_usize..9),
    ) {
        let map = random_map(key, side);
        let parts = parts(&map);
        let air = Airspace::new(shape(side.0, side.1), Some(Arc::new(map)), 0, 1, Pays::Visited);
        let found = Parts::of(&air);
        let n_largest = parts.iter().map(Vec::len).max().unwrap_or(0);
        prop_assert_eq!(found.n_largest(), n_largest);
        prop_assert_eq!(found.n_free(), parts.iter().map(Vec::len).sum::<usize>());
        let mut largest = parts.iter().filter(|part| part.len() == n_largest && n_largest > 1);
        let first = largest.clone().min_by_key(|part| part[0]).cloned().unwrap_or_default();
        prop_assert_eq!(found.starts(), first);
        let reached = |cell: usize| found.n_around(air.shape().cell(cell));
        prop_assert!(parts.iter().all(|part| part.iter().all(|&cell| reached(cell) == part.len())));
        // Of a connected map, all free cells are starts, in the order of their indices.
        if parts.len() == 1 {
            prop_assert!(largest.next().is_none_or(|all| all.len() == found.n_free()));
        }
    }
}

fn with_sensor(radius: usize, n_rings: usize) -> ModelFile {
    let mut file = Model::wildfire().file().clone();
    let ring = |ring: usize| {
        let blur = 0.1 * ring as f64;
        let row =
            |state: usize| (0..3).map(move |y| if y == state { 1.0 - 2.0 * blur } else { blur });
        RingEntry {
            observed_as: (0..3).map(|state| row(state).collect()).collect(),
        }
    };
    file.sensor = Some(SensorEntry {
        radius,
        pays: Pays::Visited,
        rings: (1..=n_rings).map(ring).collect(),
    });
    file
}

#[test]
fn each_ring_has_its_own_observations() {
    let model = Model::new(with_sensor(3, 2)).expect("a model");
    assert_eq!((model.n_rings(), model.n_observations()), (3, 9));
    let row: Vec<f64> = model.likelihood().row(2).to_vec();
    let expected = [0.01, 0.01, 0.98, 0.1, 0.1, 0.8, 0.2, 0.2, 0.6];
    assert!(
        row.iter()
            .zip(expected)
            .all(|(got, expected)| (got - expected).abs() < 1e-12)
    );
    let names = model.observation_names();
    assert_eq!(
        [&*names[2], &*names[3], &*names[8]],
        ["fire", "normal ring 1", "fire ring 2"]
    );
    let text = toml::to_string(model.file()).expect("TOML");
    assert_eq!(Model::from_toml(&text), Ok(model.clone()));
    assert_eq!(model.clone().with_radius(1).expect("a model").n_rings(), 2);
    assert_eq!(model.with_radius(8).expect("a model").n_rings(), 3);
    assert_eq!(Model::wildfire().with_radius(0), Ok(Model::wildfire()));
}

#[test]
fn what_no_sensor_or_map_can_be_is_refused_by_name() {
    let check = |change: &dyn Fn(&mut ModelFile), expected: &str| {
        let mut file = with_sensor(2, 1);
        change(&mut file);
        let error = Model::new(file).and_then(|model| model.check_on(shape(3, 4)));
        let error = error.expect_err(expected).to_string();
        assert!(
            error.contains(expected),
            "{error:?} does not say {expected:?}"
        );
    };
    let sensor = |change: fn(&mut SensorEntry)| {
        move |file: &mut ModelFile| change(file.sensor.as_mut().expect("a sensor"))
    };
    check(
        &sensor(|it| it.radius = 9),
        "sensor: radius: expected 0 to 8 cells, got 9",
    );
    check(
        &sensor(|it| it.radius = 0),
        "sensor: rings: expected at most 0 rings, as the radius is, got 1",
    );
    check(
        &sensor(|it| drop(it.rings[0].observed_as.pop())),
        "sensor: ring 1: observed_as: expected 3 rows, one per state, got 2",
    );
    check(
        &sensor(|it| it.rings[0].observed_as[1] = vec![0.5, 0.5]),
        "sensor: ring 1: observed_as of state \"latent\": expected 3 probabilities",
    );
    check(
        &sensor(|it| it.rings[0].observed_as[1] = vec![0.0; 3]),
        "sensor: ring 1: observed_as of state \"latent\": expected a sum of 1, got 0",
    );
    let map =
        |rows: Vec<Vec<u8>>| move |f: &mut ModelFile| f.no_fly = Some(CellMap::Rows(rows.clone()));
    check(
        &map(vec![vec![0; 4]; 4]),
        "no_fly: expected a map of the 3 x 4 grid, got 4 x 4",
    );
    check(
        &map(vec![vec![0; 4], vec![1; 4], vec![2; 4]]),
        "no_fly: expected 0 or 1 for each cell, got 2",
    );
    check(
        &map(vec![vec![1; 4]; 3]),
        "no_fly: expected a cell where robots may be, got none",
    );
    let text = toml::to_string(&with_sensor(2, 1))
        .expect("TOML")
        .replace("visited", "bought");
    let error = Model::from_toml(&text)
        .expect_err("no such pay")
        .to_string();
    assert!(error.contains("expected `visited` or `seen`"), "{error}");
}

#[test]
fn maps_are_read_beside_the_model() {
    let folder = std::env::temp_dir().join(format!("emberwatch-maps-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder");
    let path = folder.join("model.toml");
    let mut file = Model::wildfire().file().clone();
    file.no_fly = Some(CellMap::File("no_fly.npy".into()));
    std::fs::write(&path, toml::to_string(&file).expect("TOML")).expect("a file");
    let map = random_map(3, (4, 5));
    let error = Model::read(&path).expect_err("no map yet").to_string();
    assert!(error.contains("no_fly.npy"), "{error}");
    ndarray_npy::write_npy(folder.join("no_fly.npy"), &map).expect("bool");
    let model = Model::read(&path).expect("a model");
    let air = model.airspace(shape(4, 5)).expect("the grid");
    assert_eq!(air.no_fly().map(|it| (**it).clone()), Some(map.clone()));
    ndarray_npy::write_npy(folder.join("no_fly.npy"), &map.mapv(u8::from)).expect("uint8");
    assert_eq!(Model::read(&path), Ok(model));
    ndarray_npy::write_npy(
        folder.join("no_fly.npy"),
        &map.mapv(|it| f64::from(u8::from(it))),
    )
    .expect("f64");
    let error = Model::read(&path).expect_err("not bytes").to_string();
    assert!(
        error.contains("expected an array [H, W] of uint8 or bool"),
        "{error}"
    );
    std::fs::remove_dir_all(&folder).expect("removed");
}

#[test]
fn an_array_shorter_than_its_header_says_allocates_nothing() {
    let folder = std::env::temp_dir().join(format!("emberwatch-claims-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder");
    let (path, map) = (folder.join("model.toml"), folder.join("no_fly.npy"));
    let mut file = Model::wildfire().file().clone();
    file.no_fly = Some(CellMap::File("no_fly.npy".into()));
    std::fs::write(&path, toml::to_string(&file).expect("TOML")).expect("a file");
    ndarray_npy::write_npy(&map, &Grid::from_elem((1, 1), 0_u8)).expect("a map");
    let whole = std::fs::read(&map).expect("the map");
    let (header, numbers) = whole.split_at(whole.len() - 1);
    let header = String::from_utf8_lossy(&header[10..]);
    for claimed in [
        "(4611686018427387904, 1)",
        "(1099511627776, 0)",
        "(2, 1)",
        "(1,)",
        "(1, 1, 1)",
    ] {
        let mut other = header.replace("(1, 1)", claimed);
        let n_spaces = other.len() - header.len().min(other.len());
        other = other.replacen(&" ".repeat(n_spaces), "", usize::from(n_spaces > 0));
        let length = (other.len() as u16).to_le_bytes();
        let bytes = [&whole[..8], &length, other.as_bytes(), numbers].concat();
        std::fs::write(&map, bytes).expect("a map");
        let error = Model::read(&path).expect_err(claimed).to_string();
        assert!(
            error.contains("expected an array [H, W] of uint8 or bool"),
            "{error}"
        );
    }
    std::fs::remove_dir_all(&folder).expect("removed");
}

#[test]
fn kernels_of_too_many_weights_are_refused_before_they_are_made() {
    let mut file = Model::wildfire().file().clone();
    let state = file.states[0].clone();
    file.states = (0..64)
        .map(|index| StateEntry {
            name: format!("s{index}"),
            initial: 1.0 / 64.0,
            ..state.clone()
        })
        .collect();
    file.kernel_size = [15, 15];
    let zone = |index| ZoneEntry {
        name: format!("z{index}"),
        color: "#808080".into(),
    };
    file.zones = (0..256).map(zone).collect();
    let entry = |zone: &ZoneEntry| KernelEntry {
        zone: Some(zone.name.clone()),
        own: Some("s0".into()),
        from: "s0".into(),
        to: "s0".into(),
        scale: 1.0,
        weights: vec![vec![1.0; 15]; 15],
    };
    file.kernel = file.zones.iter().map(entry).collect();
    let error = Model::new(file).expect_err("121 GB").to_string();
    assert!(
        error.contains("kernel: expected at most 67108864 weights in all zones, got"),
        "{error}"
    );
}

#[test]
fn maps_and_sensors_that_change_nothing_are_none() {
    let grid = shape(2, 3);
    let none = Some(Arc::new(Grid::from_elem((2, 3), false)));
    assert_eq!(
        Airspace::new(grid, none, 0, 1, Pays::Seen),
        Airspace::open(grid)
    );
}
