//! Compares the cells where robots may fly, and the cells that they see, with the results of plain loops over the grid.

use super::models::{shape, unit};
use emberwatch_model::{Airspace, Cell, CellMap, Grid, MapsEntry, Model, Move, Parts};
use proptest::prelude::*;
use std::collections::BTreeSet;
use std::sync::Arc;

fn random_map(key: u64, (height, width): (usize, usize)) -> Grid<bool> {
    let blocked = |(row, col): (usize, usize)| unit(key, row * width + col) < 0.3;
    Grid::from_shape_fn((height, width), blocked)
}

proptest! {
    // Failures are not written to a file, because tests must not change the source tree.
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..Default::default() })]

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
        let mut expected = BTreeSet::new();
        for (row, col) in ndarray::indices(side) {
            let distance = |&from: &usize| (from / width).abs_diff(row).max((from % width).abs_diff(col));
            if visited.iter().map(distance).min().is_some_and(|nearest| nearest <= radius) {
                expected.insert(row * width + col);
            }
        }

        let air = Airspace::new(shape(height, width), Some(Arc::new(map)), radius);
        let path: Vec<Move> = moves.iter().map(|&step| Move::from_low_bits(step as u64)).collect();
        let flight = air.fly(Cell { row: start[0], col: start[1] }, &path);
        prop_assert_eq!(&flight.visited, &visited);
        prop_assert_eq!([flight.end.row as isize, flight.end.col as isize], at);
        let seen = air.see(&flight.visited);
        prop_assert_eq!(seen.len(), expected.len());
        prop_assert_eq!(BTreeSet::from_iter(seen), expected);
    }
}

#[test]
fn random_starts_are_the_largest_connected_part() {
    // `#` marks no-fly cells and `*` random starts. A digit is the size of the connected part that contains the cell.
    for picture in [
        "33#** 3##** ##1#*",
        "*#2 *#2",
        "1# #1",
        "***** ####* ***** *#### *****",
    ] {
        let rows: Vec<&str> = picture.split(' ').collect();
        let (cells, grid) = (rows.concat(), shape(rows.len(), rows[0].len()));
        let map = cells.bytes().map(|it| it == b'#').collect();
        let map = Grid::from_shape_vec(grid.dim(), map).expect("rows of one length");
        let found = Parts::of(&Airspace::new(grid, Some(Arc::new(map)), 0));
        let starts: Vec<usize> = cells.match_indices('*').map(|(at, _)| at).collect();
        assert_eq!(found.n_free(), cells.replace('#', "").len(), "{picture}");
        assert_eq!(found.n_largest(), starts.len().max(1), "{picture}");
        for (cell, byte) in cells.bytes().enumerate() {
            let expected = match byte {
                b'*' => starts.len(),
                b'#' => 0,
                digit => usize::from(digit - b'0'),
            };
            assert_eq!(found.n_around(grid.cell(cell)), expected, "{picture}");
        }
        assert_eq!(found.starts(), starts, "{picture}");
    }
}

#[test]
fn an_airspace_without_effect_is_open() {
    assert_eq!(Model::wildfire().with_radius(0), Ok(Model::wildfire()));
    let nowhere = Some(Arc::new(Grid::from_elem((2, 3), false)));
    let air = Airspace::new(shape(2, 3), nowhere, 0);
    assert_eq!(air, Airspace::open(shape(2, 3)));
}

#[test]
fn maps_are_read_beside_the_model() {
    let folder = std::env::temp_dir().join(format!("emberwatch-maps-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder");
    let (path, place) = (folder.join("model.toml"), folder.join("no_fly.npy"));
    let mut file = Model::wildfire().file().clone();
    file.no_fly = Some(CellMap::File("no_fly.npy".into()));
    std::fs::write(&path, toml::to_string(&file).expect("TOML")).expect("a file");
    let check = |words: &str| {
        let error = Model::read(&path).expect_err(words).to_string();
        assert!(error.contains(words), "{error}");
    };
    check(&format!("no_fly: {}: No such file", place.display()));
    let mut other = Model::wildfire().file().clone();
    other.maps = Some(MapsEntry::File("land.npz".into()));
    std::fs::write(&path, toml::to_string(&other).expect("TOML")).expect("a file");
    let land = folder.join("land.npz");
    check(&format!("maps: {}: No such file", land.display()));
    std::fs::write(&path, toml::to_string(&file).expect("TOML")).expect("a file");
    let map = random_map(3, (4, 5));
    ndarray_npy::write_npy(&place, &map).expect("bool");
    let model = Model::read(&path).expect("a model");
    let air = model.airspace(shape(4, 5)).expect("the grid");
    assert_eq!(air.no_fly().map(|it| (**it).clone()), Some(map.clone()));
    let bytes = map.mapv(u8::from);
    ndarray_npy::write_npy(&place, &bytes).expect("uint8");
    assert_eq!(Model::read(&path), Ok(model));
    let words = "expected an array [H, W] of uint8 or bool";
    ndarray_npy::write_npy(&place, &bytes.mapv(f64::from)).expect("f64");
    check(words);
    // The size that a header claims is checked before memory is allocated.
    ndarray_npy::write_npy(&place, &Grid::from_elem((1, 1), 0_u8)).expect("a map");
    let whole = std::fs::read(&place).expect("the map");
    let (header, numbers) = whole.split_at(whole.len() - 1);
    let header = String::from_utf8_lossy(&header[10..]);
    for claimed in [
        "(4611686018427387904, 1)",
        "(1099511627776, 0)",
        "(2, 1)",
        "(1,)",
        "(1, 1, 1)",
    ] {
        let other = header.replace("(1, 1)", claimed);
        let length = (other.len() as u16).to_le_bytes();
        let bytes = [&whole[..8], &length, other.as_bytes(), numbers].concat();
        std::fs::write(&place, bytes).expect("a map");
        check(words);
    }
    std::fs::remove_dir_all(&folder).expect("removed");
}
