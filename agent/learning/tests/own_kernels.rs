//! Learns kernels that depend on the cell's own state, from frames of a model with such kernels.

use crate::learned_filter::dimensions;
use emberwatch_belief::Belief;
use emberwatch_belief::estimation::parameters::{Parameters, Tables};
use emberwatch_belief::estimation::{BayesFilter, Estimator};
use emberwatch_learning::beliefs::learned::LearnedModel;
use emberwatch_learning::config::AgentConfig;
use emberwatch_learning::learners::filter::fit::FilterFit;
use emberwatch_model::path::fly;
use emberwatch_model::randomness::split_mix;
use emberwatch_model::{Cell, Dynamics, Frame, Grid, Model, Move, Shape};

const N_WORLDS: u32 = 4;
const N_STEPS: u64 = 500;
const N_MOVES: u64 = 64;

fn shape() -> Shape {
    Shape::new(24, 24).expect("test shape")
}

/// A simulated world, and the belief of a filter that follows a robot through it.
struct World {
    seed: u64,
    dynamics: Dynamics,
    states: Grid<u8>,
    robot: Cell,
    filter: BayesFilter,
}

impl World {
    fn new(model: &Model, learner: &FilterFit, seed: u64) -> Self {
        let mut dynamics = Dynamics::new(model, shape()).expect("a valid model");
        let mut states = dynamics.initial(seed);
        (0..500).for_each(|n| dynamics.step(seed, n, &mut states));
        let tables = learner.learned().tables;
        Self {
            seed,
            dynamics,
            states,
            robot: shape().centre(),
            filter: BayesFilter::learned(&tables, tables.prior(shape())),
        }
    }

    /// Flies a random path through the next states. Returns the frame and the visited cells.
    fn fly(&mut self, model: &Model, step: u64) -> (Frame, Vec<usize>) {
        self.dynamics.step(self.seed, 500 + step, &mut self.states);
        let random = |n: u64| split_mix(self.seed ^ (step << 32), n);
        let moves: Vec<Move> = (0..N_MOVES)
            .map(|n| Move::from_low_bits(random(n) >> 62))
            .collect();
        let flight = fly(shape(), self.robot, &moves);
        self.robot = flight.end;
        let mut frame = Frame::empty(shape());
        for &cell in &flight.visited {
            let Cell { row, col } = shape().cell(cell);
            let seen_as = model.likelihood().row(usize::from(self.states[[row, col]]));
            let mut share = (random(N_MOVES + cell as u64) >> 11) as f64 / (1_u64 << 53) as f64;
            let value = seen_as.iter().position(|p| {
                share -= p;
                share < 0.0
            });
            frame.observe(cell, value.unwrap_or(0) as u8);
        }
        (frame, flight.visited)
    }
}

/// Fits a filter to the frames of random paths.
fn learn(model: &Model, sees_own_state: bool) -> LearnedModel {
    let mut config = AgentConfig::default();
    config.learning.steady_updates = 600;
    config.learning.falling_updates = 400;
    let mut learner = FilterFit::new(dimensions(sees_own_state), shape(), &config);
    let worlds = 0..N_WORLDS;
    let mut worlds: Vec<World> = worlds
        .map(|world| World::new(model, &learner, 1000 + u64::from(world)))
        .collect();
    (0..N_WORLDS).for_each(|world| learner.begin(world));
    for step in 0..N_STEPS {
        let learned = learner.learned();
        for (number, world) in (0..N_WORLDS).zip(&mut worlds) {
            let (frame, visited) = world.fly(model, step);
            learner.see(number, &frame, Some(world.filter.belief()), &learned);
            world.filter.correct(&frame).expect("possible");
            let states = world.states.as_slice().expect("row-major");
            let burning = visited.iter().filter(|&&cell| states[cell] == 1).count();
            learner.earn(world.filter.belief(), &visited, burning as f64);
            world.filter.predict();
        }
        learner.learn().expect("finite");
        let tables = learner.learned().tables;
        for world in &mut worlds {
            world.filter = BayesFilter::learned(&tables, world.filter.belief().clone());
        }
    }
    learner.learned()
}

/// Returns the error of predictions from known states, against the true model's. A cell's error is the largest
/// difference in probability over its next states; the mean is over the cells in each state, then over the states.
fn distance(model: &Model, tables: &Tables) -> f64 {
    let mut dynamics = Dynamics::new(model, shape()).expect("a valid model");
    let (mut sums, mut counts) = ([0.0; 3], [0.0; 3]);
    for seed in 0..8 {
        let mut states = dynamics.initial(seed);
        (0..500).for_each(|n| dynamics.step(seed, n, &mut states));
        let belief = Belief::from_states(&states, 3).expect("states of the model");
        let mut truth = BayesFilter::known(model, belief.clone(), false).expect("a valid model");
        let mut learned = BayesFilter::learned(tables, belief);
        truth.predict();
        learned.predict();
        for (cell, &state) in states.iter().enumerate() {
            let [a, b] = [&truth, &learned].map(|filter| filter.belief().states(cell));
            let differences = a.iter().zip(&b).map(|(a, b)| (a - b).abs());
            sums[usize::from(state)] += differences.fold(0.0, f64::max);
            counts[usize::from(state)] += 1.0;
        }
    }
    sums.iter().zip(counts).map(|(sum, n)| sum / n).sum::<f64>() / 3.0
}

#[test]
#[ignore = "learns for a minute"]
fn learned_own_kernels_predict_better_than_one_kernel() {
    let model = Model::built_in("wildfire-burnout").expect("a built-in model");
    let first = Parameters::first(dimensions(true), 0);
    let before = distance(&model, &first.tables());
    let own = learn(&model, true);
    let after = distance(&model, &own.tables);
    let one = distance(&model, &learn(&model, false).tables);
    assert_eq!(own.target, 1, "burning pays");
    assert!(after < 0.2 * before, "{before} {after}");
    assert!(after < 0.8 * one, "{after} {one}");
}
