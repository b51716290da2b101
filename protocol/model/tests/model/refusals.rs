//! Checks that an error names the invalid entry of a model file, and that valid entries are kept as they were written.

use super::models::{checked, shape};
use emberwatch_model::{MapsEntry, Model, ModelError, ModelFile, StateEntry};
use ndarray::ArrayD;

/// A model with every key of the paper's rule: an edge, a sensor and no-fly cells.
const RATIO: &str = r##"
name = "land"
kernel_size = [1, 1]
edge = "a"
no_fly = [[0, 0, 1]]
observations = [{ name = "x", color = "#000000" }, { name = "y", color = "#ffffff" }]
sensor.radius = 3
states = [
    { name = "a", color = "#000000", initial = 0.75, bias = 0.0, observed_as = [1.0, 0.0] },
    { name = "b", color = "#ff0000", initial = 0.25, reward = 1.0, observed_as = [0.0, 1.0] },
]
kernel = [
    { from = "a", to = "a", weights = [[0.5]] },
    { from = "b", to = "a", scale = 1.0, weights = [[1.0]] },
]
"##;

/// A model of hazards with two maps, which [`hazards`] adds.
const HAZARDS: &str = r##"
name = "land"
observations = [{ name = "x", color = "#000000" }, { name = "y", color = "#ffffff" }]
states = [
    { name = "a", color = "#000000", initial = 0.75, observed_as = [1.0, 0.0] },
    { name = "b", color = "#ff0000", initial = 0.25, reward = 1.0, observed_as = [0.0, 1.0] },
]

[[transitions]]
from = "a"
to = "b"
base = 0.25
near.b = [[0.5, 0.0, 1e-9]]
times = ["fuel", "wind"]

[[transitions]]
from = "b"
to = "a"
base = 1.0
"##;

fn hazards(text: &str) -> Result<Model, ModelError> {
    let map = |shape: &[usize]| ArrayD::from_elem(shape, 0.5_f32);
    let maps = [("fuel", map(&[1, 3])), ("wind", map(&[1, 3, 1, 3]))];
    let maps = maps.map(|(name, map)| (name.to_owned(), map));
    let mut file: ModelFile = toml::from_str(text)?;
    file.maps = Some(file.maps.unwrap_or_else(|| MapsEntry::packed(&maps.into())));
    Model::new(file)
}

/// Each row: a part of [`RATIO`] => its replacement => a part of the resulting error.
const WRONG: &str = r##"
name = "land" => name = 3 => model file: 
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
kernel_size = [1, 1] => kernel_size = [9223372036854775807, 9223372036854775807] => kernel_size: expected two odd numbers
[[0.5]] => [[1e101]] => to "a": expected 0, or a magnitude of 1e-100 to 1e100, got 1e101
scale = 1.0, weights = [[1.0]] => scale = 1e-99, weights = [[1e-99]] => expected 0, or a magnitude of 1e-100 to 1e100, got
scale = 1.0 => scale = nan => expected finite weights >= 0, got NaN
scale = 1.0 => scale = -1.0 => expected finite weights >= 0, got -1
scale = 1.0 => scale = 0.0 => transition weights of cell (0, 0) can sum to zero
scale = 1.0, weights = [[1.0]] => weights = [[1e30]] => transition weights of cell (0, 0) can sum to 4.9999999999999995e-31 times the largest weight
from = "b", to = "a" => from = "b", to = "ash" => kernel from "b" to "ash": expected the name of a state, one of ["a", "b"], got "ash"
from = "b", to = "a", scale => from = "a", to = "b", scale => transition weights of cell (0, 0) can sum to zero
[[0, 0, 1]] => [[0, 0]] => no_fly: expected a map of the 1 x 3 grid, got 1 x 2
[[0, 0, 1]] => [[0, 0, 2]] => no_fly: expected 0 or 1 for each cell, got 2
[[0, 0, 1]] => [[1, 1, 1]] => no_fly: expected a cell where robots may be, got none
radius = 3 => radius = 9 => sensor: radius: expected 0 to 8 cells, got 9
radius = 3 => rings = [] => remove `rings` and `pays`: a sensor has one observation matrix
radius = 3 => pays = "visited" => remove `rings` and `pays`: a sensor has one observation matrix
kernel = [ => kernel = [{ own = "a", from = "a", to = "b", weights = [[0.5]] },  => near.burning = [[
kernel = [ => zone_map = [[0, 0, 0]], kernel = [ => model file: 
edge = "a" => zones = [] => kernels by own state and zones are now transitions
edge = "a" => maps = "a.npz" => maps: expected none, because no transition uses them, got maps
kernel_size = [1, 1] =>  => kernel_size: expected the size of `weights`, got none
from = "b", to = "a" => from = "a", to = "a" => from "a" to "a": expected one entry for each pair of states, got two
[[0, 0, 1]] => -1 => expected rows of numbers from 0 to 255, or the name of a .npy file
[[0, 0, 1]] => "closed.npy" => no_fly: expected rows of numbers
"##;

/// Each row: a part of [`HAZARDS`] => its replacement => a part of the resulting error.
const WRONG_HAZARDS: &str = r##"
name = "land" => name = "land", kernel_size = [1, 1] => model file: 
[[transitions]] => kernel_size = [1, 3]\n[[transitions]] => kernel_size: expected none, because `near` has the size, got [1, 3]
initial = 0.75 => initial = 0.75, bias = 1.0 => state "a": bias: expected none, because transitions have `base`, got 1
to = "b" => to = "ash" => transition from "a" to "ash": expected the name of a state, one of ["a", "b"], got "ash"
to = "b" => to = "a" => transition from "a" to "a": expected another state, got "a"
near.b => near.ash => transition from "a" to "b": near.ash: expected the name of a state, one of ["a", "b"], got "ash"
base = 0.25 => base = 1.5 => transition from "a" to "b": base: expected a probability: 0, or 1e-9 to 1, got 1.5
base = 0.25 => base = 1e-10 => base: expected a probability: 0, or 1e-9 to 1, got 0.0000000001
base = 0.25 => base = nan => base: expected a probability: 0, or 1e-9 to 1, got NaN
[[0.5, 0.0, 1e-9]] => [[0.5, 0.0, 2.0]] => near.b: expected a probability: 0, or 1e-9 to 1, got 2
[[0.5, 0.0, 1e-9]] => [[0.5, 0.1, 0.5]] => near.b: expected 0 at the centre, because no cell is its own neighbour
[[0.5, 0.0, 1e-9]] => [[0.5, 0.0]] => near.b: expected two odd numbers up to 15, got [1, 2]
[[0.5, 0.0, 1e-9]] => [] => near.b: expected two odd numbers up to 15, got [0, 0]
[[0.5, 0.0, 1e-9]] => [[0.5], [0.0], []] => near.b: expected rows of 1 probabilities, got 0
[[0.5, 0.0, 1e-9]] => [[0.5], [0.0], [0.5]] => to "b": expected tables `near` of 1 x 3 cells, as in map "wind", got another size
"fuel", => "fule", => transition from "a" to "b": times: expected one of the maps ["fuel", "wind"], got "fule"
"fuel",  =>  => maps: "fuel": expected a transition that names it in `times`, got none
name = "land" => name = "land"\nmaps = "a.npz" => maps: expected an archive in the model
name = "land" => name = "land"\nmaps = { npz = "!" } => maps: expected an .npz archive in base64
name = "land" => name = "land"\nmaps = 3 => expected the name of an .npz file
"##;

#[test]
fn what_no_model_can_be_is_refused_by_name() {
    type Parse = fn(&str) -> Result<Model, ModelError>;
    let mut wrong = Vec::new();
    for (text, parse, lines) in [
        (RATIO, Model::from_toml as Parse, WRONG),
        (HAZARDS, hazards, WRONG_HAZARDS),
    ] {
        for line in lines.lines().skip(1) {
            let mut parts = line.split(" => ");
            let [from, to, words] = [(); 3].map(|()| parts.next().expect(line));
            assert!(text.contains(from), "{line}");
            let model = parse(&text.replacen(from, &to.replace("\\n", "\n"), 1));
            let said = match model.and_then(|model| model.check_on(shape(1, 3))) {
                Ok(()) => "accepted".into(),
                Err(error) => error.to_string(),
            };
            if !said.contains(words) {
                wrong.push((line, said));
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn a_model_file_survives_toml() {
    let ratio = Model::from_toml(RATIO).expect("a model");
    let land = hazards(HAZARDS).expect("a model");
    for model in [&ratio, &land] {
        assert_eq!(model.check_on(shape(1, 3)), Ok(()));
    }
    let error = land.check_on(shape(3, 1)).expect_err("another grid");
    let words = "maps: expected a map of the 3 x 1 grid, got 1 x 3";
    assert!(error.to_string().contains(words), "{error}");
    for model in [Model::wildfire(), ratio, land] {
        let text = toml::to_string(model.file()).expect("models serialise");
        assert_eq!(Model::from_toml(&text), Ok(model));
    }
}

#[test]
fn sums_of_weights_are_checked_where_the_grid_allows_them() {
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
    let state = |index| StateEntry {
        name: format!("s{index}"),
        initial: 1.0 / 64.0,
        ..Model::wildfire().file().states[0].clone()
    };
    for n_states in [1, 65, 10_000] {
        file.states = (0..n_states).map(state).collect();
        let words = format!("expected 2 to 64 states, got {n_states}");
        let error = Model::new(file.clone()).expect_err(&words).to_string();
        assert!(error.contains(&words), "{error}");
    }
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
