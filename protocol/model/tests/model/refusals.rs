//! Checks that an error names the invalid entry of a model file, and that valid entries are kept as they were written.

use super::models::{checked, shape};
use emberwatch_model::{KernelEntry, Model, ModelError, StateEntry, ZoneEntry};

/// A model with every key: two zones and an edge, a sensor, no-fly cells, and own-state kernels.
const LAND: &str = r##"
name = "land"
kernel_size = [1, 1]
edge = "a"
zone_map = [[0, 1, 1]]
no_fly = [[0, 0, 1]]
zones = [{ name = "z0", color = "#000000" }, { name = "z1", color = "#808080" }]
observations = [{ name = "x", color = "#000000" }, { name = "y", color = "#ffffff" }]
sensor.radius = 3
states = [
    { name = "a", color = "#000000", initial = 0.75, bias = 0.0, observed_as = [1.0, 0.0] },
    { name = "b", color = "#ff0000", initial = 0.25, reward = 1.0, observed_as = [0.0, 1.0] },
]
kernel = [
    { zone = "z0", own = "a", from = "a", to = "a", weights = [[0.5]] },
    { zone = "z0", own = "b", from = "b", to = "b", weights = [[0.5]] },
    { zone = "z1", own = "a", from = "a", to = "b", weights = [[0.5]] },
    { zone = "z1", own = "b", from = "b", to = "a", scale = 1.0, weights = [[1.0]] },
]
"##;

/// Each row: a part of [`LAND`] => its replacement => a part of the resulting error.
const WRONG: &str = r##"
name = "land" => name = 3 => model file: 
states = [ => states = [], no = [ => model file: 
"b", color => "a", color => state name "a" appears twice
"a", color => "explore", color => state name: expected letters, digits, '-' and '_', and none of
"a", color => "a b", color => state name: expected letters, digits, '-' and '_', and none of
"a", color => "", color => state name: expected letters, digits, '-' and '_', and none of
#ff0000 => red => state "b": color: expected #rrggbb, got red
#ff0000 => #+1+2+3 => got #+1+2+3
bias = 0.0 => bias = -1.0 => state "a": bias: expected a finite number >= 0, got -1
bias = 0.0 => bias = nan => state "a": bias: expected a finite number >= 0, got NaN
bias = 0.0 => bias = 1e101 => bias: expected 0, or a magnitude of 1e-100 to 1e100, got 1e101
bias = 0.0 => bias = 1e-320 => bias: expected 0, or a magnitude of 1e-100 to 1e100, got
reward = 1.0 => reward = -1e101 => reward: expected 0, or a magnitude of 1e-100 to 1e100, got -1e101
reward = 1.0 => reward = -1e-320 => reward: expected 0, or a magnitude of 1e-100 to 1e100, got
reward = 1.0 => reward = inf => reward: expected a finite number, got inf
initial = 0.75 => initial = 0.5 => initial: expected a sum of 1, got 0.75
observed_as = [0.0, 1.0] => observed_as = [0.5, 0.4] => state "b": observed_as: expected a sum of 1, got 0.9
observed_as = [0.0, 1.0] => observed_as = [-0.5, 1.5] => state "b": observed_as: expected probabilities >= 0, got [-0.5, 1.5]
observed_as = [0.0, 1.0] => observed_as = [1.0] => state "b": observed_as: expected 2 probabilities, one per observation, got 1
edge = "a" => edge = "sea" => edge: expected the name of a state, one of ["a", "b"], got "sea"
kernel_size = [1, 1] => kernel_size = [3, 5] => expected 3 rows of 5 weights, got rows of [1]
kernel_size = [1, 1] => kernel_size = [1, 2] => kernel_size: expected two odd numbers up to 15, got [1, 2]
kernel_size = [1, 1] => kernel_size = [2, 1] => kernel_size: expected two odd numbers up to 15, got [2, 1]
kernel_size = [1, 1] => kernel_size = [17, 1] => kernel_size: expected two odd numbers up to 15, got [17, 1]
kernel_size = [1, 1] => kernel_size = [15, 99999999] => kernel_size: expected two odd numbers
kernel_size = [1, 1] => kernel_size = [9223372036854775807, 9223372036854775807] => kernel_size: expected two odd numbers
kernel_size = [1, 1] => kernel_size = [-1, 3] => model file: 
[[0.5]] => [[-0.1]] => kernel in zone "z0" of "a" from "a" to "a": expected finite weights >= 0, got -0.1
[[0.5]] => [[1e101]] => to "a": expected 0, or a magnitude of 1e-100 to 1e100, got 1e101
scale = 1.0, weights = [[1.0]] => scale = 1e-99, weights = [[1e-99]] => expected 0, or a magnitude of 1e-100 to 1e100, got
scale = 1.0 => scale = nan => expected finite weights >= 0, got NaN
scale = 1.0 => scale = -1.0 => expected finite weights >= 0, got -1
scale = 1.0 => scale = 0.0 => transition weights of cell (0, 0) can sum to zero
scale = 1.0, weights = [[1.0]] => weights = [[1e30]] => transition weights of cell (0, 0) can sum to 4.9999999999999995e-31 times the largest weight
from = "b", to = "a" => from = "b", to = "ash" => kernel entry names state "ash"
from = "b", to = "a" => from = "a", to = "a" => transition weights of cell (0, 0) can sum to zero
own = "b", from = "b", to = "a" => own = "ash", from = "b", to = "a" => kernel entry names state "ash"
own = "b", from = "b", to = "a" => from = "b", to = "a" => kernel: expected own in every entry, or in none, got 3 of 4
own = "b", from = "b", to = "a" => own = "a", from = "a", to = "b" => of "a" from "a" to "b": expected one entry for each pair
zone = "z1", own = "b" => own = "b" => to "a": zone: expected the name of one of `zones`, got none
zone = "z1", own = "b" => zone = "z9", own = "b" => to "a": zone: expected the name of one of `zones`, got "z9"
zones = [ => zones = [{ name = "z2", color = "#000000" },  => zone "z2": expected kernel entries with its name
"z1", color => "z0", color => zone name "z0" appears twice
#808080 => grey => zone "z1": color: expected #rrggbb, got grey
zone_map = [[0, 1, 1]] =>  => zone_map: expected the zone of each cell, got none
[[0, 1, 1]] => [[0, 1]] => zone_map: expected a map of the 1 x 3 grid, got 1 x 2
[[0, 1, 1]] => [[0, 1, 2]] => zone_map: expected zones below 2, the number of `zones`, got 2
[[0, 1, 1]] => [[0, 1, 1], [0]] => zone_map: expected rows of 3 numbers, got 1
[[0, 1, 1]] => [] => zone_map: expected a map of a grid, got
[[0, 1, 1]] => -1 => expected rows of numbers from 0 to 255, or the name of a .npy file
[[0, 1, 1]] => "zones.npy" => zone_map: expected rows of numbers
[[0, 0, 1]] => [[0, 0]] => no_fly: expected a map of the 1 x 3 grid, got 1 x 2
[[0, 0, 1]] => [[0, 0, 2]] => no_fly: expected 0 or 1 for each cell, got 2
[[0, 0, 1]] => [[1, 1, 1]] => no_fly: expected a cell where robots may be, got none
radius = 3 => radius = 9 => sensor: radius: expected 0 to 8 cells, got 9
radius = 3 => rings = [] => remove `rings` and `pays`: a sensor has one observation matrix
radius = 3 => pays = "visited" => remove `rings` and `pays`: a sensor has one observation matrix
"##;

#[test]
fn what_no_model_can_be_is_refused_by_name() {
    let mut wrong = Vec::new();
    for line in WRONG.lines().skip(1) {
        let mut parts = line.split(" => ");
        let [from, to, words] = [(); 3].map(|()| parts.next().expect(line));
        assert!(LAND.contains(from), "{line}");
        let model = Model::from_toml(&LAND.replacen(from, to, 1));
        let said = match model.and_then(|model| model.check_on(shape(1, 3))) {
            Ok(()) => "accepted".into(),
            Err(error) => error.to_string(),
        };
        if !said.contains(words) {
            wrong.push((line, said));
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn a_model_file_survives_toml() {
    let land = Model::from_toml(LAND).expect("a model");
    assert_eq!(land.check_on(shape(1, 3)), Ok(()));
    for model in [Model::wildfire(), land] {
        let text = toml::to_string(model.file()).expect("models serialise");
        assert_eq!(Model::from_toml(&text), Ok(model));
    }
}

#[test]
fn sums_of_weights_are_checked_where_the_grid_allows_them() {
    let mut file = Model::wildfire().file().clone();
    for entry in file.kernel.iter_mut().filter(|it| it.from == "latent") {
        entry.scale *= 1e-31;
    }
    let error = checked(file.clone()).check_on(shape(4, 4));
    let error = error.expect_err("a cell among latent ones");
    assert!(
        matches!(error, ModelError::FaintWeight { share, .. } if share > 0.0),
        "{error}"
    );
    file.states[0].bias = 1e-6;
    assert_eq!(checked(file).check_on(shape(4, 4)), Ok(()));

    let mut file = Model::wildfire().file().clone();
    file.kernel.iter_mut().for_each(|it| it.weights[1][1] = 0.0);
    let model = checked(file);
    assert_eq!(model.check_on(shape(5, 9)), Ok(()));
    let error = model
        .check_on(shape(1, 1))
        .expect_err("a cell without neighbours");
    assert!(error.to_string().contains("cell (0, 0)"), "{error}");
    assert_eq!(Model::wildfire().check_on(shape(1, 1)), Ok(()));
}

#[test]
fn models_of_any_size_are_refused_before_memory_is_asked_for() {
    let mut file = Model::wildfire().file().clone();
    let check = |file, words: &str| {
        let error = Model::new(file).expect_err(words).to_string();
        assert!(error.contains(words), "{error}");
    };
    let state = |index| StateEntry {
        name: format!("s{index}"),
        initial: 1.0 / 64.0,
        ..Model::wildfire().file().states[0].clone()
    };
    for n_states in [1, 65, 10_000] {
        file.states = (0..n_states).map(state).collect();
        check(
            file.clone(),
            &format!("expected 2 to 64 states, got {n_states}"),
        );
    }
    file.states = (0..64).map(state).collect();
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
    check(
        file,
        "kernel: expected at most 67108864 weights in all zones, got 15099494400",
    );
}

#[test]
fn nesting_as_deep_as_a_model_file_can_be_is_refused() {
    for (open, close) in [("[", "]"), ("{a = ", "}"), ("[{a = ", "}]")] {
        let deep = open.repeat(100_000) + "1" + &close.repeat(100_000);
        assert!(Model::from_toml(&format!("name = {deep}\n")).is_err());
        assert!(Model::from_toml(&format!("kernel_size = {deep}\n")).is_err());
    }
    let keys = "a.".repeat(100_000);
    assert!(Model::from_toml(&format!("{keys}b = 1\n")).is_err());
    assert!(Model::from_toml(&format!("[{keys}b]\n")).is_err());
}
