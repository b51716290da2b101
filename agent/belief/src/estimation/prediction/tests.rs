//! Compares predictions by hazards with their formula and with the exact filter.

mod exact;

use super::*;
use emberwatch_model::grid::Probabilities;
use emberwatch_model::hazards::scaled;
use emberwatch_model::randomness::split_mix;
use emberwatch_model::{Cell, Grid, MapsEntry, Shape};
use exact::divergences;
use ndarray::{Array3, ArrayD, Axis, s};

fn shape(height: usize, width: usize) -> Shape {
    Shape::new(height, width).expect("test shape")
}

/// Returns a pseudo-random number in `0..1`.
fn random(seed: u64, at: usize) -> f64 {
    (split_mix(seed, at as u64) >> 11) as f64 / (1_u64 << 53) as f64
}

fn belief(n_states: usize, shape: Shape) -> Belief {
    let (height, width) = shape.dim();
    let numbers = Probabilities::from_shape_fn((n_states, height, width), |(state, row, col)| {
        random(3, (state * 100 + row) * 100 + col) as f32 + 0.01
    });
    let sums = numbers.sum_axis(Axis(0));
    Belief::from_probabilities(numbers / sums).expect("a belief")
}

/// Returns a model of three states from the lines that describe its transitions. A sensor shows the state with
/// probability .9.
fn model(transitions: &str) -> Model {
    let mut text = "name = \"fire\"\n".to_owned();
    for (name, initial, seen) in [
        ("green", 0.9, [0.9, 0.05, 0.05]),
        ("fire", 0.1, [0.05, 0.9, 0.05]),
        ("ash", 0.0, [0.05, 0.05, 0.9]),
    ] {
        let both = format!("name = \"{name}\"\ncolor = \"#000000\"\n");
        text += &format!("[[observations]]\n{both}[[states]]\n{both}");
        text += &format!("initial = {initial:?}\nobserved_as = {seen:?}\n");
    }
    Model::from_toml(&(text + transitions)).expect("a model")
}

/// A cell ignites with probability `1 - .6^f` if `f` of its four neighbours burn, and burns out with probability .1.
const FIRE: &str = r#"
[[transitions]]
from = "green"
to = "fire"
near.fire = [[0.0, 0.4, 0.0], [0.4, 0.0, 0.4], [0.0, 0.4, 0.0]]

[[transitions]]
from = "fire"
to = "ash"
base = 0.1
"#;

/// A model in which states have several transitions, and neighbours in any state influence any cell.
const TANGLE: &str = r#"
[[transitions]]
from = "green"
to = "fire"
base = 0.01
near.fire = [[0.1, 0.3, 0.0], [0.2, 0.0, 0.1], [0.0, 0.4, 0.7]]
near.green = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.2], [0.0, 0.0, 0.0]]

[[transitions]]
from = "green"
to = "ash"
base = 0.02

[[transitions]]
from = "green"
to = "fire"
near.ash = [[0.05, 0.05, 0.05, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0], [0.1, 0.0, 0.0, 0.0, 0.2]]

[[transitions]]
from = "fire"
to = "green"
near.ash = [[0.1], [0.0], [0.3]]

[[transitions]]
from = "ash"
to = "green"
base = 0.25
"#;

/// Surrounds a belief with a border of cells that are certainly in state 1.
fn framed(inner: &Belief) -> Belief {
    let (height, width) = inner.shape().dim();
    let mut framed = Array3::zeros((inner.n_states(), height + 4, width + 4));
    framed.index_axis_mut(Axis(0), 1).fill(1.0);
    let mut cells = framed.slice_mut(s![.., 2..height + 2, 2..width + 2]);
    cells.assign(&inner.view());
    Belief::from_probabilities(framed).expect("a belief")
}

/// Returns the prediction without cavities, from the formula of the module's page, in double precision.
fn formula(model: &Model, belief: &Belief) -> Array3<f64> {
    let hazards = model.hazards().expect("hazards");
    let p = belief.view().mapv(f64::from);
    let (n_states, height, width) = p.dim();
    let mut next = Array3::zeros(p.dim());
    for (row, col) in ndarray::indices((height, width)) {
        let cell = Cell { row, col };
        for own in 0..n_states {
            let (mut base, mut last) = (0.0, 1.0);
            let mut near = std::collections::BTreeMap::new();
            for transition in hazards.transitions(own) {
                let factors = &transition.factors;
                base += scaled(transition.base, factors.of_base(cell));
                for it in &transition.near {
                    let hazard = scaled(it.hazard, factors.of_neighbour(it.offset, cell));
                    let of_place = near.entry(it.offset).or_insert_with(|| vec![0.0; n_states]);
                    of_place[it.state] += hazard;
                }
                let factor = |(offset, hazards): (&[isize; 2], &Vec<f64>)| {
                    let [down, right] = *offset;
                    let at = [
                        row.wrapping_add_signed(down),
                        col.wrapping_add_signed(right),
                    ];
                    let beyond = |state: usize| f64::from(u8::from(model.edge() == Some(state)));
                    let sum = hazards.iter().enumerate().map(|(state, hazard)| {
                        let belief = p.get([state, at[0], at[1]]).copied();
                        belief.unwrap_or_else(|| beyond(state)) * -(-hazard).exp_m1()
                    });
                    1.0 - sum.sum::<f64>()
                };
                let none = (-base).exp() * near.iter().map(factor).product::<f64>();
                next[[transition.to, row, col]] += p[[own, row, col]] * (last - none);
                last = none;
            }
            next[[own, row, col]] += p[[own, row, col]] * last;
        }
    }
    next
}

fn with_edge(model: &Model) -> Model {
    let mut file = model.file().clone();
    file.edge = Some("fire".into());
    Model::new(file).expect("a model")
}

/// Gives factors to the transitions of a model whose tables have 3 x 3 cells.
fn with_maps(model: &Model, shape: Shape) -> Model {
    let mut file = model.file().clone();
    let (height, width) = shape.dim();
    let factor = |at: usize| (3.0 * random(5, at)) as f32;
    let mut at = 0..;
    let mut map =
        |shape: &[usize]| ArrayD::from_shape_fn(shape, |_| factor(at.next().expect("endless")));
    let maps = [
        ("fuel".to_owned(), map(&[height, width])),
        ("wind".to_owned(), map(&[3, 3, height, width])),
    ];
    file.maps = Some(MapsEntry::packed(&maps.into()));
    for entry in &mut file.transitions {
        entry.times = vec!["fuel".into(), "wind".into()];
    }
    Model::new(file).expect("a model")
}

/// Checks a prediction to the formula, with a tolerance relative to the probability and an absolute one.
fn check_formula(model: &Model, mut belief: Belief, tolerance: [f64; 2]) {
    let expected = formula(model, &belief);
    let mut prediction = Prediction::known(model, &belief, false).expect("fits");
    prediction.predict(&mut belief);
    for (got, expected) in belief.as_slice().iter().zip(&expected) {
        let off = (f64::from(*got) - expected).abs();
        let is_close = off <= tolerance[0] * expected + tolerance[1];
        assert!(is_close, "{got} for {expected}");
    }
}

#[test]
fn predictions_are_those_of_the_formula() {
    for shape in [shape(9, 37), shape(1, 1), shape(2, 64)] {
        let [fire, tangle] = [FIRE, TANGLE].map(model);
        let land = with_maps(&fire, shape);
        for model in [with_edge(&tangle), tangle, with_edge(&land), land, fire] {
            check_formula(&model, belief(3, shape), [0.0, 1e-6]);
        }
        // Rare events are not rounded to 0 or to a multiple of 6e-8.
        let rare = model(&FIRE.replace("0.4", "1e-7"));
        let states = Grid::from_shape_fn(shape.dim(), |(row, col)| {
            (3.0 * random(7, row * 100 + col)) as u8
        });
        let certain = Belief::from_states(&states, 3).expect("states");
        check_formula(&rare, certain, [1e-5, 0.0]);
    }
}

#[test]
fn an_edge_state_equals_a_border_of_cells_in_that_state() {
    for (text, cavities) in [(FIRE, false), (FIRE, true), (TANGLE, false), (TANGLE, true)] {
        let model = model(text);
        let mut got = belief(3, shape(5, 7));
        let mut expected = framed(&got);
        let new = |model: &Model, belief: &Belief| {
            Prediction::known(model, belief, cavities).expect("fits")
        };
        let mut prediction = new(&with_edge(&model), &got);
        let mut of_frame = new(&model, &expected);
        for step in 0..4 {
            prediction.predict(&mut got);
            of_frame.predict(&mut expected);
            let inner = expected.view().slice(s![.., 2..7, 2..9]).to_owned();
            let off = (got.probabilities() - &inner).mapv(f32::abs);
            assert!(off.iter().all(|off| *off < 2e-6), "{cavities}, step {step}");
            let reset = framed(&got);
            of_frame.correct(expected.as_slice(), reset.as_slice());
            expected = reset;
        }
    }
}

#[test]
fn cavities_are_closer_to_the_exact_filter() {
    // Bounds are 10 % above the measured values.
    for (dim, one_in, n_worlds, bounds) in [
        ((2, 3), 0, 1, [0.097, 0.065]),
        ((2, 3), 5, 40, [0.104, 0.067]),
        ((2, 3), 2, 40, [0.0147, 0.0117]),
        ((3, 3), 0, 1, [0.119, 0.080]),
    ] {
        let off = divergences(&model(FIRE), shape(dim.0, dim.1), one_in, n_worlds);
        assert!(off[0] > off[1], "{dim:?} {off:?}");
        let within = off.iter().zip(bounds).all(|(off, bound)| *off < bound);
        assert!(within, "{dim:?} one in {one_in}: {off:?}");
    }
}

#[test]
fn the_paper_s_rule_has_no_cavities() {
    let belief = belief(3, shape(6, 7));
    let mut prediction = Prediction::known(&Model::wildfire(), &belief, true).expect("fits");
    assert!(!prediction.has_cavities() && prediction.to_bytes().is_empty());
    assert!(prediction.restore(&[]) && !prediction.restore(&[0; 4]));
}

#[test]
fn unseen_cells_and_cavities_keep_summing_to_one() {
    for model in [
        model(TANGLE),
        Model::built_in("wildfire-burnout").expect("built in"),
    ] {
        let mut belief = belief(3, shape(3, 35));
        let mut prediction = Prediction::known(&model, &belief, true).expect("fits");
        for _ in 0..5_000 {
            prediction.predict(&mut belief);
        }
        assert!(prediction.has_cavities());
        let bytes = [belief.to_bytes(), prediction.to_bytes()].concat();
        let mut beliefs = bytes.chunks(4 * 3 * 3 * 35);
        assert!(beliefs.all(|bytes| Belief::from_bytes(bytes, (3, 3, 35)).is_some()));
    }
}

#[test]
fn only_valid_cavities_are_restored() {
    let model = with_edge(&model(FIRE));
    let mut first_belief = belief(3, shape(3, 35));
    let new = || Prediction::known(&model, &Belief::uniform(3, shape(3, 35)), true).expect("fits");
    let (mut first, mut second) = (new(), new());
    first.predict(&mut first_belief);
    let (bytes, unchanged) = (first.to_bytes(), second.to_bytes());
    // Four cavities per cell, each with three `f32`.
    assert_eq!(bytes.len(), 4 * 4 * 3 * 3 * 35);
    let mut negative = bytes.clone();
    *negative.last_mut().expect("a number") |= 0x80;
    for (name, refused) in [
        ("nothing", Vec::new()),
        ("a value too few", bytes[4..].to_vec()),
        ("a byte too many", [&bytes[..], &[0]].concat()),
        ("zeros", vec![0; bytes.len()]),
        ("a negative number", negative),
    ] {
        assert!(!second.restore(&refused), "{name}");
        assert_eq!(second.to_bytes(), unchanged, "{name}");
    }
    assert!(second.restore(&bytes));
    let mut second_belief = first_belief.clone();
    first.predict(&mut first_belief);
    second.predict(&mut second_belief);
    assert_eq!(second_belief, first_belief);
    assert_eq!(second.to_bytes(), first.to_bytes());
}
