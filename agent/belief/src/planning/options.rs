//! The options of a high-level decision (paper section III.E). Each option plans a whole path, and a vector of features
//! describes this path.
//!
//! To add an option, add an entry to [`OPTIONS`].

use crate::planning::beam::BeamSearch;
use crate::planning::objective::{BEAM_BONUS, CellValues};
use crate::planning::planner::{Plan, Planner, PlanningProblem};
use crate::planning::value_layers::{Layer, ValueLayers, distance};
use emberwatch_model::{Cell, Grid};

/// An option: a named objective for paths.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathOption {
    /// The name in tables and files.
    pub name: &'static str,
    /// A short description.
    pub about: &'static str,
    /// Weights of the terms of a cell's value: a constant bonus, the probability of the paying state, the entropy and
    /// the novelty.
    worth: [f32; 4],
    /// Number of consecutive paths in the plan, at least 1. The robot flies only the first.
    n_paths: usize,
    goal: Option<Layer>,
}

const EXPLOIT: PathOption = PathOption {
    name: "exploit",
    about: "the probability of the paying state, and a small bonus for each distinct cell",
    worth: [BEAM_BONUS, 1.0, 0.0, 0.0],
    n_paths: 1,
    goal: None,
};

const BEST_REGION: PathOption = towards(
    "best_region",
    "the region with the largest surplus, discounted by distance",
    Layer::Surplus,
);

/// All options. A decision is an index into this list.
pub const OPTIONS: [PathOption; 8] = [
    EXPLOIT,
    exploit_and(
        "exploit_entropy_0.1",
        "exploit, plus 0.1 times each cell's entropy",
        0.1,
    ),
    exploit_and(
        "exploit_entropy_0.3",
        "exploit, plus 0.3 times each cell's entropy",
        0.3,
    ),
    explore("entropy", "the belief's entropy", [0.0, 0.0, 1.0, 0.0]),
    explore(
        "coverage",
        "cells that have not been seen for a long time",
        [0.0, 0.0, 0.0, 1.0],
    ),
    PathOption {
        name: "exploit_ahead_3",
        about: "exploit over three paths; the robot flies the first",
        n_paths: 3,
        ..EXPLOIT
    },
    BEST_REGION,
    towards(
        "unseen_region",
        "the least seen region, discounted by distance",
        Layer::Novelty,
    ),
];

/// Number of features of an option: see [`feature_names`].
pub const N_FEATURES: usize = 18 + OPTIONS.len();

/// Increase of the cells' values for each row or column closer to the goal. It outweighs the values of cells off the
/// direct path.
const SLOPE: f32 = 0.3;

const GOAL_RADIUS: usize = 2;

/// Discount of a region's sum for each path that the robot needs to reach the region.
pub const KEPT_PER_PATH: f32 = 0.8;

/// Divisors that scale the sums over regions, in the order of [`Layer::ALL`].
const REGION_SCALES: [f32; 4] = [25.0, 12.0, 169.0, 169.0];

const MEAN_SCALE: f32 = 0.1;

const MOST_STEPS: u64 = 200;

const fn exploit_and(name: &'static str, about: &'static str, entropy: f32) -> PathOption {
    PathOption {
        name,
        about,
        worth: [BEAM_BONUS, 1.0, entropy, 0.0],
        ..EXPLOIT
    }
}

const fn explore(name: &'static str, about: &'static str, worth: [f32; 4]) -> PathOption {
    PathOption {
        name,
        about,
        worth,
        ..EXPLOIT
    }
}

const fn towards(name: &'static str, about: &'static str, goal: Layer) -> PathOption {
    PathOption {
        name,
        about,
        goal: Some(goal),
        ..EXPLOIT
    }
}

/// The plan of an option, and the features that describe it.
#[derive(Debug, Clone, PartialEq)]
pub struct Proposal {
    pub plan: Plan,
    pub features: [f32; N_FEATURES],
}

/// A planner that computes the paths of options by beam search.
#[derive(Debug)]
pub struct OptionPlanner(BeamSearch);

impl OptionPlanner {
    /// Creates a planner with a beam of `width` states.
    ///
    /// # Panics
    /// If `width` is 0.
    pub fn new(width: usize) -> Self {
        Self(BeamSearch::new(width))
    }

    /// Plans all options for a robot, in the order of [`OPTIONS`].
    pub fn propose(&mut self, layers: &ValueLayers, robot: Cell) -> Vec<Proposal> {
        let facts = layers.facts(robot);
        let proposals = OPTIONS.iter().enumerate().map(|(index, option)| {
            let goal = option.goal_on(layers, robot);
            let plan = self.plan_to(option, layers, robot, goal);
            let features = features(index, layers, robot, (&plan, goal), &facts);
            Proposal { plan, features }
        });
        proposals.collect()
    }

    /// Plans one option for a robot.
    pub fn plan(&mut self, option: &PathOption, layers: &ValueLayers, robot: Cell) -> Plan {
        let goal = option.goal_on(layers, robot);
        self.plan_to(option, layers, robot, goal)
    }

    fn plan_to(
        &mut self,
        option: &PathOption,
        layers: &ValueLayers,
        robot: Cell,
        goal: Option<Cell>,
    ) -> Plan {
        let mut plan = self.0.plan(&PlanningProblem {
            start: robot,
            n_moves: layers.n_moves * option.n_paths,
            values: &option.values(layers, goal),
            seed: 0,
            step: 0,
        });
        plan.moves.truncate(layers.n_moves);
        plan
    }
}

impl PathOption {
    fn goal_on(&self, layers: &ValueLayers, robot: Cell) -> Option<Cell> {
        let best = |layer| layers.best_region(layer, robot, KEPT_PER_PATH);
        self.goal.map(best)
    }

    fn values(&self, layers: &ValueLayers, goal: Option<Cell>) -> CellValues {
        let [bonus, probability, entropy, novelty] = self.worth;
        let mut value: Grid<f32> = Grid::zeros(layers.shape().dim());
        let mut in_sight: Option<Grid<f32>> = None;
        for (weight, layer) in [
            (probability, Layer::Probability),
            (entropy, Layer::Entropy),
            (novelty, Layer::Novelty),
        ] {
            if weight == 0.0 {
                continue;
            }
            if layers.counts_in_sight(layer) {
                let in_sight = in_sight.get_or_insert_with(|| Grid::zeros(value.dim()));
                in_sight.scaled_add(weight, layers.layer(layer));
            } else {
                value.scaled_add(weight, layers.layer(layer));
            }
        }
        if let Some(goal) = goal {
            let (height, width) = value.dim();
            for ((row, col), value) in value.indexed_iter_mut() {
                let away = |at: usize, goal: usize| at.abs_diff(goal).saturating_sub(GOAL_RADIUS);
                let away = away(row, goal.row) + away(col, goal.col);
                *value += SLOPE * (height + width - away) as f32;
            }
        }
        CellValues::new(value, bonus).within(layers.airspace(), in_sight)
    }
}

impl ValueLayers {
    fn facts(&self, robot: Cell) -> [f32; 6] {
        let surplus = |centre| self.around(Layer::Surplus, centre) / REGION_SCALES[1];
        let best = self.centres().map(surplus).fold(0.0, f32::max);
        let mean = self.total(Layer::Probability) / self.shape().n_cells() as f32;
        [
            best,
            surplus(robot),
            mean / MEAN_SCALE,
            self.recent.last_reward,
            self.recent.mean_reward,
            self.recent.n_paths.min(MOST_STEPS) as f32 / MOST_STEPS as f32,
        ]
    }
}

fn features(
    index: usize,
    layers: &ValueLayers,
    robot: Cell,
    (plan, goal): (&Plan, Option<Cell>),
    facts: &[f32; 6],
) -> [f32; N_FEATURES] {
    let flight = layers.airspace().fly(robot, &plan.moves);
    let seen = layers.airspace().see(&flight.visited);
    let on_path = [Layer::Probability, Layer::Entropy, Layer::Novelty].map(|layer| {
        let cells = layers.layer(layer).as_slice();
        let cells = cells.expect("invariant: grids are row-major");
        let sum: f32 = if layers.counts_in_sight(layer) {
            seen.iter().map(|&cell| cells[cell]).sum()
        } else {
            flight.visited.iter().map(|&cell| cells[cell]).sum()
        };
        sum / layers.n_moves as f32
    });
    let goal = goal.unwrap_or(flight.end);
    let region =
        |at| Layer::ALL.map(|layer| layers.around(layer, at) / REGION_SCALES[layer as usize]);
    let (height, width) = layers.shape().dim();
    let distance = robot.row.abs_diff(goal.row) as f32 / height as f32
        + robot.col.abs_diff(goal.col) as f32 / width as f32;
    let mut features = [0.0; N_FEATURES];
    let numbers = on_path
        .into_iter()
        .chain(region(flight.end))
        .chain(region(goal));
    let numbers = numbers.chain([distance]).chain(facts.iter().copied());
    features
        .iter_mut()
        .zip(numbers)
        .for_each(|(feature, number)| *feature = number);
    features[N_FEATURES - OPTIONS.len() + index] = 1.0;
    features
}

/// Returns the name of each feature:
///
/// - sums of probability, entropy and novelty over the path's distinct cells (over the seen cells, for layers that count
///   in sight), per move
/// - scaled sums of all layers over the region at the path's end, and over the region at the goal
/// - distance to the goal, as a fraction of the grid's sides
/// - scaled surplus of the best region and of the robot's region, and the scaled mean probability of the grid
/// - last reward per move, its running mean, and number of paths flown
/// - one-hot code of the option
pub fn feature_names() -> Vec<String> {
    let layers = ["probability", "surplus", "entropy", "novelty"];
    let path = ["probability", "entropy", "novelty"].map(|layer| format!("path_{layer}"));
    let regions = ["end", "goal"].into_iter();
    let regions = regions.flat_map(|at| layers.map(|layer| format!("{at}_{layer}")));
    let facts = [
        "goal_distance",
        "best_surplus",
        "own_surplus",
        "mean_probability",
        "last_reward",
        "mean_reward",
        "n_paths",
    ];
    let options = OPTIONS.iter().map(|option| format!("is_{}", option.name));
    let names = path.into_iter().chain(regions);
    names
        .chain(facts.map(String::from))
        .chain(options)
        .collect()
}

/// Flies to the best region if its discounted surplus exceeds the surplus around the robot, otherwise `exploit`.
pub fn choose_by_rule(layers: &ValueLayers, robot: Cell) -> &'static PathOption {
    let goal = layers.best_region(Layer::Surplus, robot, KEPT_PER_PATH);
    let n_paths = distance(robot, goal) as f32 / layers.n_moves as f32;
    let away = layers.around(Layer::Surplus, goal) * KEPT_PER_PATH.powf(n_paths);
    let here = layers.around(Layer::Surplus, robot);
    if away > here { &BEST_REGION } else { &EXPLOIT }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::belief::Belief;
    use crate::planning::memory::Memory;
    use emberwatch_model::path::fly;
    use emberwatch_model::randomness::split_mix;
    use emberwatch_model::{Airspace, Frame, Move, Probabilities, Shape};

    fn layers(height: usize, width: usize, n_moves: usize) -> ValueLayers {
        let shape = Shape::new(height, width).expect("test shape");
        let numbers = Probabilities::from_shape_fn((2, height, width), |(state, row, col)| {
            let random = split_mix(5, (row * width + col) as u64) % 1000;
            let fire = (random as f32 / 1000.0).powi(3);
            [1.0 - fire, fire][state]
        });
        let belief = Belief::from_probabilities(numbers).expect("valid");
        let mut memory = Memory::new(shape);
        let mut frame = Frame::empty(shape);
        let every_third = (0..shape.n_cells()).step_by(3);
        every_third.for_each(|cell| frame.observe(cell, 0));
        memory.see(&frame);
        memory.earn(3.0, n_moves);
        ValueLayers::new(&belief, &Airspace::open(shape), 1, &memory, n_moves)
    }

    #[test]
    fn each_option_flies_the_best_of_all_paths() {
        let mut planner = OptionPlanner::new(2000);
        for (height, width) in [(1, 4), (5, 3), (30, 40)] {
            let layers = layers(height, width, 3);
            let (row, col) = (height / 2, 1);
            let robot = Cell { row, col };
            for option in &OPTIONS {
                let goal = option.goal_on(&layers, robot);
                let values = option.values(&layers, goal);
                let plan = planner.plan(option, &layers, robot);
                assert_eq!(plan.moves.len(), 3);
                let n_moves = 3 * option.n_paths.min(2);
                let scores = (0..4_u64.pow(n_moves as u32)).map(|code| {
                    let moves = (0..n_moves).map(|at| Move::from_low_bits(code >> (2 * at)));
                    values.score(robot, &moves.collect::<Vec<_>>())
                });
                let best = scores.fold(f32::NEG_INFINITY, f32::max);
                let is_best = (plan.score - best).abs() < 1e-3 * best.abs().max(1.0);
                let is_longer = option.n_paths > 2 && plan.score > best;
                assert!(is_best || is_longer, "{}", option.name);
            }
        }
    }

    #[test]
    fn options_with_a_goal_fly_towards_it() {
        let mut planner = OptionPlanner::new(30);
        let (layers, robot) = (layers(40, 40, 6), Cell { row: 20, col: 20 });
        for option in OPTIONS.iter().filter(|option| option.goal.is_some()) {
            let goal = option.goal_on(&layers, robot).expect("a goal");
            let plan = planner.plan(option, &layers, robot);
            let end = fly(layers.shape(), robot, &plan.moves).end;
            let left = distance(robot, goal).saturating_sub(6 + 2 * GOAL_RADIUS);
            let is_near = distance(end, goal) <= left + 2 * GOAL_RADIUS;
            assert!(is_near, "{}: {end} {goal}", option.name);
            assert!(distance(robot, goal) > 3);
        }
    }

    #[test]
    fn every_feature_has_a_name_and_describes_its_path() {
        let names = feature_names();
        let distinct: std::collections::BTreeSet<&String> = names.iter().collect();
        assert_eq!((names.len(), distinct.len()), (N_FEATURES, N_FEATURES));
        assert_eq!(N_FEATURES, 26);
        let (layers, robot) = (layers(20, 30, 5), Cell { row: 3, col: 4 });
        let proposals = OptionPlanner::new(30).propose(&layers, robot);
        for (index, proposal) in proposals.iter().enumerate() {
            let feature = |name: &str| {
                let at = names.iter().position(|known| known == name);
                proposal.features[at.expect(name)]
            };
            let flight = fly(layers.shape(), robot, &proposal.plan.moves);
            let novelty = flight.visited.iter().filter(|cell| *cell % 3 != 0).count();
            assert!((feature("path_novelty") - novelty as f32 / 5.0).abs() < 1e-3);
            let end = layers.around(Layer::Entropy, flight.end) / 169.0;
            assert_eq!(feature("end_entropy"), end);
            let option = &OPTIONS[index];
            let goal = option.goal_on(&layers, robot).unwrap_or(flight.end);
            let away = robot.row.abs_diff(goal.row) as f32 / 20.0;
            let away = away + robot.col.abs_diff(goal.col) as f32 / 30.0;
            assert!((feature("goal_distance") - away).abs() < 1e-6);
            assert_eq!(feature("last_reward"), 0.6);
            assert!(feature("best_surplus") >= feature("own_surplus"));
            let chosen: Vec<f32> = proposal.features[18..].to_vec();
            assert_eq!(chosen.iter().sum::<f32>(), 1.0);
            assert_eq!(feature(&format!("is_{}", option.name)), 1.0);
        }
    }

    #[test]
    fn the_rule_leaves_only_for_a_better_region() {
        let shape = Shape::new(40, 40).expect("test shape");
        let choice = |row: usize| {
            let mut states = Grid::zeros((40, 40));
            states[[row, 5]] = 1;
            let belief = Belief::from_states(&states, 2).expect("valid states");
            let layers =
                ValueLayers::new(&belief, &Airspace::open(shape), 1, &Memory::new(shape), 6);
            choose_by_rule(&layers, Cell { row: 3, col: 5 }).name
        };
        assert_eq!([choice(4), choice(35)], ["exploit", "best_region"]);
    }
}
