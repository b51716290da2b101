//! Statistics of wildfire worlds: mean and standard error over independent runs. Names are as in
//! `tests/data/b_world_stats.json`.
//!
//! In these definitions, `X` are the states at a step, and `X'` the states one step later. All statistics are averages
//! over steps 15,000 to 35,000 of one 64 x 64 run. Ratios are ratios of counts over the whole run.
//! - `mean_fraction_s`, `within_run_sd_fraction_s`: fraction of cells in state s, mean and standard
//!   deviation over time
//! - `transitions_per_step_atob`, `cond_prob_atob`, `changes_per_step`: the number of cells per step with `X = a` and
//!   `X' = b`, their share of the cells with `X = a`, and the number of cells per step that change
//! - `p_fire_D_given_s`: among cells in state s with a neighbour in direction D, the fraction whose neighbour there is
//!   on fire
//! - `new_fire_fraction_with_D_on_fire_before`: among cells with `X != fire`, `X' = fire` and a neighbour in direction
//!   D, the fraction whose neighbour there was on fire in `X`; likewise for latent

use emberwatch_model::{Dynamics, Grid, Model, Shape};
use std::collections::BTreeMap;

const SIDE: usize = 64;
const FIRST_STEP: u64 = 15_000;
const LAST_STEP: u64 = 35_000;

/// Only every tenth step is counted, because states are correlated over thousands of steps.
const EVERY: u64 = 10;

const LATENT: usize = 1;
const FIRE: usize = 2;
const DIRECTIONS: [(&str, isize, isize); 4] = [
    ("above", -1, 0),
    ("below", 1, 0),
    ("left", 0, -1),
    ("right", 0, 1),
];

/// The value of each statistic in one run.
type Statistics = BTreeMap<String, f64>;

/// A mean over runs.
#[derive(Debug, Clone, Copy)]
pub struct Estimate {
    pub mean: f64,
    pub se: f64,
}

impl Estimate {
    /// Returns the difference from another estimate, in combined standard errors.
    pub fn deviation(self, other: Self) -> f64 {
        (self.mean - other.mean) / self.se.hypot(other.se)
    }
}

/// Returns the statistics of the authors' simulator.
pub fn reference() -> BTreeMap<String, Estimate> {
    let json: serde_json::Value =
        serde_json::from_str(include_str!("../data/b_world_stats.json")).expect("JSON");
    let statistics = json["reference_15000_35000"].as_object();
    let entry = |(name, entry): (&String, &serde_json::Value)| {
        let [mean, se] = ["mean", "se"].map(|key| entry[key].as_f64().expect("a number"));
        (name.clone(), Estimate { mean, se })
    };
    statistics.expect("an object").iter().map(entry).collect()
}

/// Simulates one run for each seed, each on a separate thread.
pub fn simulate(seeds: std::ops::Range<u64>) -> BTreeMap<String, Estimate> {
    let runs: Vec<Statistics> = std::thread::scope(|scope| {
        let runs: Vec<_> = seeds.map(|seed| scope.spawn(move || run(seed))).collect();
        let joined = runs.into_iter().map(|run| run.join().expect("a run ends"));
        joined.collect()
    });
    let estimate = |name: &String| {
        let values: Vec<f64> = runs.iter().map(|run| run[name]).collect();
        let (mean, deviation) = moments(&values);
        let se = deviation / (values.len() as f64).sqrt();
        (name.clone(), Estimate { mean, se })
    };
    runs[0].keys().map(estimate).collect()
}

fn run(seed: u64) -> Statistics {
    let shape = Shape::new(SIDE, SIDE).expect("a shape");
    let mut dynamics = Dynamics::new(&Model::wildfire(), shape).expect("wildfire runs anywhere");
    let mut states = dynamics.initial(seed);
    let mut counts = Counts::default();
    for n in 0..LAST_STEP {
        let is_counted = n >= FIRST_STEP && n.is_multiple_of(EVERY);
        let before = is_counted.then(|| states.clone());
        dynamics.step(seed, n, &mut states);
        if let Some(before) = before {
            counts.count(&before, &states);
        }
    }
    counts.statistics()
}

#[derive(Default)]
struct Counts {
    /// Fraction of each state at each counted step.
    fractions: [Vec<f64>; 3],
    /// Number of cells in state `from` that turn into `to`: `[from][to]`.
    transitions: [[f64; 3]; 3],
    /// Number of cells with a neighbour in some direction and state: `[direction][neighbour][from][to]`.
    neighbours: [[[[f64; 3]; 3]; 3]; 4],
    /// Number of fires by quarter of the grid: `[lower half][right half]`.
    fires: [[f64; 2]; 2],
}

impl Counts {
    fn count(&mut self, before: &Grid<u8>, after: &Grid<u8>) {
        let mut cells = [0.0; 3];
        for ((row, col), &state) in before.indexed_iter() {
            let [from, to] = [state, after[[row, col]]].map(usize::from);
            cells[from] += 1.0 / (SIDE * SIDE) as f64;
            self.transitions[from][to] += 1.0;
            self.fires[row / (SIDE / 2)][col / (SIDE / 2)] += f64::from(from == FIRE);
            for (seen, (_, down, across)) in self.neighbours.iter_mut().zip(DIRECTIONS) {
                let (i, j) = (
                    row.wrapping_add_signed(down),
                    col.wrapping_add_signed(across),
                );
                if let Some(&neighbour) = before.get([i, j]) {
                    seen[usize::from(neighbour)][from][to] += 1.0;
                }
            }
        }
        for (fractions, fraction) in self.fractions.iter_mut().zip(cells) {
            fractions.push(fraction);
        }
    }

    fn statistics(&self) -> Statistics {
        let mut all = Statistics::new();
        let n_steps = self.fractions[0].len() as f64;
        let mut changes = 0.0;
        for from in 0..3 {
            let (mean, deviation) = moments(&self.fractions[from]);
            all.insert(format!("mean_fraction_{from}"), mean);
            all.insert(format!("within_run_sd_fraction_{from}"), deviation);
            let total: f64 = self.transitions[from].iter().sum();
            for (to, count) in self.transitions[from].into_iter().enumerate() {
                all.insert(
                    format!("transitions_per_step_{from}to{to}"),
                    count / n_steps,
                );
                all.insert(format!("cond_prob_{from}to{to}"), count / total);
                changes += if from == to { 0.0 } else { count / n_steps };
            }
        }
        all.insert("changes_per_step".into(), changes);
        self.insert_neighbours(&mut all);
        let [top, bottom] = self.fires.map(|[left, right]| left + right);
        let half = n_steps * (SIDE * SIDE / 2) as f64;
        let right_minus_left: f64 = self.fires.iter().map(|[left, right]| right - left).sum();
        all.insert("fire_fraction_rows_0_31".into(), top / half);
        all.insert("fire_fraction_rows_32_63".into(), bottom / half);
        all.insert("fire_bottom_minus_top".into(), (bottom - top) / half);
        all.insert("fire_right_minus_left".into(), right_minus_left / half);
        all
    }

    fn insert_neighbours(&self, all: &mut Statistics) {
        for (seen, (name, ..)) in self.neighbours.iter().zip(DIRECTIONS) {
            // Among the cells that `is_counted` selects by their states before and after the step, the share whose
            // neighbour is in a given state.
            let share = |neighbour: usize, is_counted: &dyn Fn(usize, usize) -> bool| {
                let mut counts = [0.0; 3];
                for (neighbour, from, to) in ndarray::indices((3, 3, 3)) {
                    counts[neighbour] +=
                        f64::from(is_counted(from, to)) * seen[neighbour][from][to];
                }
                counts[neighbour] / counts.iter().sum::<f64>()
            };
            let given = |state| share(FIRE, &|from, _| from == state);
            let new = |state| share(state, &|from, to| from != state && to == state);
            all.insert(format!("p_fire_{name}_given_fire"), given(FIRE));
            all.insert(format!("p_fire_{name}_given_latent"), given(LATENT));
            all.insert(
                format!("new_fire_fraction_with_{name}_on_fire_before"),
                new(FIRE),
            );
            all.insert(
                format!("new_latent_fraction_with_{name}_latent_before"),
                new(LATENT),
            );
        }
        let [above, below] = ["above", "below"]
            .map(|name| all[&format!("new_fire_fraction_with_{name}_on_fire_before")]);
        all.insert("new_fire_above_minus_below".into(), above - below);
    }
}

/// Returns the mean and the standard deviation.
fn moments(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    (mean, (squares / (n - 1.0)).sqrt())
}
