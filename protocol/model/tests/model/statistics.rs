//! Statistics of wildfire worlds by the names of `tests/data/b_world_stats.json`, with mean and standard
//! error over independent runs.
//!
//! Definitions, with `X` the states at a step and `X'` one step later; all are averages over steps
//! 15,000 to 35,000 of one 64 x 64 run, ratios are ratios of counts over the whole run:
//! - `mean_fraction_s`, `within_run_sd_fraction_s`: fraction of cells in state s, mean and standard
//!   deviation over time
//! - `transitions_per_step_atob`, `cond_prob_atob`, `changes_per_step`: cells with `X = a`, `X' = b`
//! - `p_fire_D_given_s`: among cells in state s with a neighbour D, that neighbour is on fire
//! - `new_fire_fraction_with_D_on_fire_before`: among cells with `X != fire`, `X' = fire` and a
//!   neighbour D, that neighbour was on fire in `X`; likewise for latent

use emberwatch_model::{Dynamics, Grid, Model, Shape};
use std::collections::BTreeMap;

const SIDE: usize = 64;
const FIRST_STEP: u64 = 15_000;
const LAST_STEP: u64 = 35_000;

/// Every tenth step is counted: states are correlated over thousands of steps.
const EVERY: u64 = 10;

const LATENT: u8 = 1;
const FIRE: u8 = 2;
const DIRECTIONS: [(&str, isize, isize); 4] = [
    ("above", -1, 0),
    ("below", 1, 0),
    ("left", 0, -1),
    ("right", 0, 1),
];

/// Value of each statistic in one run.
pub type Statistics = BTreeMap<String, f64>;

/// A mean over runs.
#[derive(Debug, Clone, Copy)]
pub struct Estimate {
    pub mean: f64,
    pub se: f64,
}

impl Estimate {
    /// The difference to another estimate in combined standard errors.
    pub fn deviation(self, other: Self) -> f64 {
        (self.mean - other.mean) / self.se.hypot(other.se)
    }
}

/// The authors' simulator.
pub fn reference() -> BTreeMap<String, Estimate> {
    let json: serde_json::Value =
        serde_json::from_str(include_str!("../data/b_world_stats.json")).expect("JSON");
    let statistics = json["reference_15000_35000"]
        .as_object()
        .expect("an object");
    let number = |value: &serde_json::Value| value.as_f64().expect("a number");
    let entry = |(name, entry): (&String, &serde_json::Value)| {
        let (mean, se) = (number(&entry["mean"]), number(&entry["se"]));
        (name.clone(), Estimate { mean, se })
    };
    statistics.iter().map(entry).collect()
}

/// Our simulator, one run for each seed, each on its own thread.
pub fn simulate(seeds: std::ops::Range<u64>) -> BTreeMap<String, Estimate> {
    let runs: Vec<Statistics> = std::thread::scope(|scope| {
        let runs: Vec<_> = seeds.map(|seed| scope.spawn(move || run(seed))).collect();
        let joined = runs.into_iter().map(|run| run.join().expect("a run ends"));
        joined.collect()
    });
    let estimate = |name: &String| {
        let values: Vec<f64> = runs.iter().map(|run| run[name]).collect();
        let se = standard_deviation(&values) / (values.len() as f64).sqrt();
        (
            name.clone(),
            Estimate {
                mean: mean(&values),
                se,
            },
        )
    };
    runs[0].keys().map(estimate).collect()
}

fn run(seed: u64) -> Statistics {
    let shape = Shape::new(SIDE, SIDE).expect("a shape");
    let mut dynamics = Dynamics::new(&Model::wildfire(), shape).expect("wildfire runs anywhere");
    let mut states = dynamics.initial(seed);
    let mut counts = Counts::default();
    for n in 0..LAST_STEP {
        if n >= FIRST_STEP && n.is_multiple_of(EVERY) {
            let before = states.clone();
            dynamics.step(seed, n, &mut states);
            counts.count(&before, &states);
        } else {
            dynamics.step(seed, n, &mut states);
        }
    }
    counts.statistics()
}

/// How often something was the case, and how often it could have been.
#[derive(Debug, Default, Clone, Copy)]
struct Ratio {
    hits: u64,
    of: u64,
}

/// What one run has shown about one neighbour.
#[derive(Debug, Default, Clone, Copy)]
struct Neighbour {
    fire_given_fire: Ratio,
    fire_given_latent: Ratio,
    fire_before_new_fire: Ratio,
    latent_before_new_latent: Ratio,
}

#[derive(Debug, Default)]
struct Counts {
    /// Fraction of each state at each counted step.
    fractions: [Vec<f64>; 3],
    transitions: [[u64; 3]; 3],
    neighbours: [Neighbour; 4],
    fire_by_half: [Ratio; 4],
}

impl Ratio {
    fn add(&mut self, hit: bool) {
        self.hits += u64::from(hit);
        self.of += 1;
    }

    fn value(self) -> f64 {
        self.hits as f64 / self.of as f64
    }
}

impl Counts {
    fn count(&mut self, before: &Grid<u8>, after: &Grid<u8>) {
        let mut cells = [0; 3];
        for ((row, col), &state) in before.indexed_iter() {
            let next = after[[row, col]];
            cells[usize::from(state)] += 1;
            self.transitions[usize::from(state)][usize::from(next)] += 1;
            let [top, bottom, left, right] = &mut self.fire_by_half;
            (if row < SIDE / 2 { top } else { bottom }).add(state == FIRE);
            (if col < SIDE / 2 { left } else { right }).add(state == FIRE);
            for (seen, (_, down, across)) in self.neighbours.iter_mut().zip(DIRECTIONS) {
                let at = [
                    row.wrapping_add_signed(down),
                    col.wrapping_add_signed(across),
                ];
                if let Some(&neighbour) = before.get(at) {
                    seen.add(state, next, neighbour);
                }
            }
        }
        for (fractions, n_cells) in self.fractions.iter_mut().zip(cells) {
            fractions.push(f64::from(n_cells) / (SIDE * SIDE) as f64);
        }
    }

    fn statistics(&self) -> Statistics {
        let mut all = Statistics::new();
        for (state, fractions) in self.fractions.iter().enumerate() {
            all.insert(format!("mean_fraction_{state}"), mean(fractions));
            let name = format!("within_run_sd_fraction_{state}");
            all.insert(name, standard_deviation(fractions));
        }
        self.insert_transitions(&mut all);
        self.insert_neighbours(&mut all);
        let [top, bottom, left, right] = self.fire_by_half.map(Ratio::value);
        all.insert("fire_fraction_rows_0_31".into(), top);
        all.insert("fire_fraction_rows_32_63".into(), bottom);
        all.insert("fire_bottom_minus_top".into(), bottom - top);
        all.insert("fire_right_minus_left".into(), right - left);
        all
    }

    fn insert_transitions(&self, all: &mut Statistics) {
        let n_steps = self.fractions[0].len() as f64;
        let mut changes = 0.0;
        for (from, row) in self.transitions.iter().enumerate() {
            let total: u64 = row.iter().sum();
            for (to, &count) in row.iter().enumerate() {
                let per_step = count as f64 / n_steps;
                all.insert(format!("transitions_per_step_{from}to{to}"), per_step);
                all.insert(
                    format!("cond_prob_{from}to{to}"),
                    count as f64 / total as f64,
                );
                changes += if from == to { 0.0 } else { per_step };
            }
        }
        all.insert("changes_per_step".into(), changes);
    }

    fn insert_neighbours(&self, all: &mut Statistics) {
        for (seen, (name, ..)) in self.neighbours.iter().zip(DIRECTIONS) {
            for (what, ratio) in [
                (format!("p_fire_{name}_given_fire"), seen.fire_given_fire),
                (
                    format!("p_fire_{name}_given_latent"),
                    seen.fire_given_latent,
                ),
                (
                    format!("new_fire_fraction_with_{name}_on_fire_before"),
                    seen.fire_before_new_fire,
                ),
                (
                    format!("new_latent_fraction_with_{name}_latent_before"),
                    seen.latent_before_new_latent,
                ),
            ] {
                all.insert(what, ratio.value());
            }
        }
        let [above, below, ..] = self
            .neighbours
            .map(|seen| seen.fire_before_new_fire.value());
        all.insert("new_fire_above_minus_below".into(), above - below);
    }
}

impl Neighbour {
    /// Counts one cell with a neighbour on the grid.
    fn add(&mut self, state: u8, next: u8, neighbour: u8) {
        match state {
            FIRE => self.fire_given_fire.add(neighbour == FIRE),
            LATENT => self.fire_given_latent.add(neighbour == FIRE),
            _ => {}
        }
        match next {
            FIRE if state != FIRE => self.fire_before_new_fire.add(neighbour == FIRE),
            LATENT if state != LATENT => self.latent_before_new_latent.add(neighbour == LATENT),
            _ => {}
        }
    }
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

fn standard_deviation(values: &[f64]) -> f64 {
    let centre = mean(values);
    let squares: f64 = values.iter().map(|value| (value - centre).powi(2)).sum();
    (squares / (values.len() - 1) as f64).sqrt()
}
