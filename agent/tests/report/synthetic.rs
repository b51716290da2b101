//! Results and worlds made up for the tests.

use agent::Belief;
use agent::benchmark::report::{PolicyRun, Snapshot};
use protocol::model::{ModelFile, ObservationEntry, StateEntry};
use protocol::{Cell, Frame, Grid, Model, Probabilities, Shape, UNOBSERVED};

/// The ladder of the project's design notes: policy, estimator and about the mean measured there.
pub const LADDER: [(&str, &str, f64); 12] = [
    ("random_walk", "none", 2.9),
    ("coverage", "none", 4.7),
    ("shooting_explore", "known_model", 8.0),
    ("shooting_latent", "known_model", 11.5),
    ("shooting_exploit", "known_model", 21.7),
    ("shooting_p_only", "known_model", 23.3),
    ("learned", "learned_filter", 30.1),
    ("beam", "known_model", 38.7),
    ("oracle_shooting", "truth", 28.1),
    ("oracle_beam", "truth", 45.7),
    ("clairvoyant_beam", "next_truth", 47.9),
    (
        "beam_with_a_very_long_name_that_no_label_has_room_for",
        "known_model",
        39.5,
    ),
];

/// A number in `-1..1` that depends on nothing but its arguments.
pub fn noise(seed: u64, index: u64) -> f64 {
    let bits = protocol::randomness::split_mix(seed, index) >> 11;
    bits as f64 / (1_u64 << 52) as f64 - 1.0
}

/// A run whose only interesting number is its mean reward.
pub fn run(policy: &str, estimator: &str, world_seed: u64, mean_reward: f64) -> PolicyRun {
    PolicyRun {
        policy: policy.into(),
        estimator: estimator.into(),
        world_seed,
        steps: 4,
        mean_reward,
        mean_distinct_cells: 60.0,
        hit_rate: 0.25,
        mean_fire_cells: 100.0 * world_seed as f64,
        mean_plan_millis: 1.5,
        brier: (estimator == "known_model").then_some(0.125),
        moves: 64,
        robots: 1,
        team: "alone".into(),
        mean_repeated: 0.0,
        steps_to_detection: None,
        burning_cells_at_detection: None,
        recent_steps: None,
        burning_seen_share: None,
        front_distance: None,
        grid_seen_share: None,
        is_added: false,
        rewards: Vec::new(),
    }
}

/// Every policy of the ladder on some worlds.
pub fn ladder(n_worlds: u64, n_steps: usize) -> Vec<PolicyRun> {
    let of_policy = |(index, &(policy, estimator, mean)): (usize, &(&str, &str, f64))| {
        let worlds = (0..n_worlds).map(move |world| {
            let mean = mean * (1.0 + 0.25 * noise(1, world) + 0.05 * noise(index as u64, world));
            let swing = |step: usize| 1.0 + 0.3 * (step as f64 / 120.0 + index as f64).sin();
            let reward = |step| (mean * (swing(step) + 0.4 * noise(world, step as u64))) as f32;
            PolicyRun {
                steps: n_steps as u64,
                rewards: (0..n_steps).map(reward).collect(),
                ..run(policy, estimator, 100 + world, mean)
            }
        });
        worlds.collect::<Vec<_>>()
    };
    LADDER.iter().enumerate().flat_map(of_policy).collect()
}

/// Beam search of 1, 2 and 4 robots, alone and jointly: on world w alone R (w + 1), jointly a half more from R = 2 on.
pub fn teams(n_worlds: u64) -> Vec<PolicyRun> {
    let mut runs = Vec::new();
    for robots in [1_u32, 2, 4] {
        for team in ["alone", "joint"] {
            let gain = if robots > 1 && team == "joint" {
                1.5
            } else {
                1.0
            };
            runs.extend((0..n_worlds).map(|world| PolicyRun {
                robots,
                team: team.into(),
                mean_repeated: if team == "alone" { 0.25 } else { 0.125 },
                rewards: vec![1.0; 4],
                ..run(
                    "beam",
                    "known_model",
                    world,
                    gain * f64::from(robots) * (world + 1) as f64,
                )
            }));
        }
    }
    runs
}

/// A model of `n` states, the observations named like them.
pub fn model(n: usize) -> Model {
    let wildfire = Model::wildfire().file().clone();
    let colors = [
        "#3b6ea5", "#e3b23c", "#c8371b", "#4d4d4d", "#7a9a3a", "#e2e2e2",
    ];
    let names = [
        "dry",
        "wet",
        "black_ice",
        "packed_snow",
        "slush",
        "salted_ploughed_and_gritted",
    ];
    let state = |index: usize| StateEntry {
        name: names[index].into(),
        color: colors[index].into(),
        initial: 1.0 / n as f64,
        reward: index as f64,
        bias: 0.1,
        observed_as: (0..n)
            .map(|seen| f64::from(u8::from(seen == index)))
            .collect(),
    };
    let observation = |index: usize| ObservationEntry {
        name: format!("looks {}", names[index]),
        color: colors[index].into(),
    };
    let file = ModelFile {
        name: "road ice".into(),
        states: (0..n).map(state).collect(),
        observations: (0..n).map(observation).collect(),
        kernel: Vec::new(),
        ..wildfire
    };
    Model::new(file).expect("test model")
}

pub struct Scene {
    pub model: Model,
    pub snapshot: Snapshot,
    pub observation: Grid<u8>,
}

/// A blob of the last state within the one before it, and a path that wanders over both.
pub fn scene(model: Model, height: usize, width: usize) -> Scene {
    let shape = Shape::new(height, width).expect("test shape");
    let last = model.n_states() - 1;
    let state = |(row, col): (usize, usize)| {
        let (y, x) = (row as f64 / height as f64, col as f64 / width as f64);
        let radius = (y - 0.45).hypot(x - 0.35) + 0.04 * noise(3, (row * width + col) as u64);
        let ring = (radius / 0.5 * (last + 1) as f64) as usize;
        last.saturating_sub(ring) as u8
    };
    let truth = Grid::from_shape_fn(shape.dim(), state);
    let observation = Grid::from_shape_fn(shape.dim(), |(row, col)| {
        let index = (row * width + col) as u64;
        let flips = noise(5, index) > 0.8;
        if flips {
            (index % (last as u64 + 1)) as u8
        } else {
            truth[[row, col]]
        }
    });
    let path_cells = path(shape, 64);
    let mut seen = vec![UNOBSERVED; shape.n_cells()];
    for &Cell { row, col } in &path_cells[1..] {
        seen[row * width + col] = observation[[row, col]];
    }
    let frame = Frame::from_bytes(shape, model.n_observations(), &seen).expect("test frame");
    let belief = belief(&truth, last + 1);
    let snapshot = Snapshot {
        seed: 100,
        step: 1234,
        truth,
        frame,
        path_cells,
        belief: Some(Belief::from_probabilities(belief).expect("test belief")),
        learned_target: None,
    };
    Scene {
        model,
        snapshot,
        observation,
    }
}

fn path(shape: Shape, n_moves: u64) -> Vec<Cell> {
    let mut cells = vec![shape.centre()];
    for step in 0..n_moves {
        // Two low bits of a smooth turn: long legs, some corners.
        let turn = (noise(11, step / 5) * 4.0) as i64 as u64;
        let next = protocol::Move::from_low_bits(turn).apply(cells[cells.len() - 1], shape);
        cells.push(next);
    }
    cells
}

fn belief(truth: &Grid<u8>, n_states: usize) -> Probabilities {
    let (height, width) = truth.dim();
    let mut belief =
        Probabilities::from_shape_fn((n_states, height, width), |(state, row, col)| {
            let fits = usize::from(truth[[row, col]]) == state;
            let blur = noise(7, (row / 2 * width + col / 2) as u64).abs() as f32;
            if fits { 1.0 } else { 0.05 + 0.6 * blur }
        });
    for row in 0..height {
        for col in 0..width {
            let sum: f32 = (0..n_states).map(|state| belief[[state, row, col]]).sum();
            (0..n_states).for_each(|state| belief[[state, row, col]] /= sum);
        }
    }
    belief
}
