//! Synthetic results for the tests.

use emberwatch_agent::benchmark::report::PolicyRun;

/// Policy, estimator and mean reward.
const LADDER: [(&str, &str, f64); 5] = [
    ("random_walk", "none", 2.9),
    ("coverage", "none", 4.7),
    ("beam", "known", 38.7),
    ("oracle_beam", "truth", 45.7),
    ("a_very_long_name_that_no_label_has_room_for", "known", 39.5),
];

/// Returns a number in `-1..1` that depends only on the arguments.
pub fn noise(seed: u64, index: u64) -> f64 {
    let bits = emberwatch_protocol::randomness::split_mix(seed, index) >> 11;
    bits as f64 / (1_u64 << 52) as f64 - 1.0
}

/// Returns a run in which only the given values vary.
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
        brier: (estimator == "known").then_some(0.125),
        moves: 64,
        robots: 1,
        team: "alone".into(),
        worlds_fingerprint: "884869f24f9fd933".into(),
        ..PolicyRun::default()
    }
}

/// Returns runs of every policy of the ladder on `n_worlds` worlds.
pub fn ladder(n_worlds: u64, n_steps: usize) -> Vec<PolicyRun> {
    let mut runs = Vec::new();
    for (policy, estimator, mean) in LADDER {
        runs.extend((0..n_worlds).map(|world| {
            let mean = mean * (1.0 + 0.25 * noise(1, world));
            let reward = |step| (mean * (1.0 + 0.4 * noise(world, step))) as f32;
            PolicyRun {
                steps: n_steps as u64,
                rewards: (0..n_steps as u64).map(reward).collect(),
                ..run(policy, estimator, 100 + world, mean)
            }
        }));
    }
    runs
}

/// Returns runs of beam search with R = 1, 2 and 4 robots, alone and jointly. On world w, robots alone earn R (w + 1);
/// from R = 2 on, robots that plan jointly earn half as much again.
pub fn teams(n_worlds: u64) -> Vec<PolicyRun> {
    let mut runs = Vec::new();
    for robots in [1_u32, 2, 4] {
        for team in ["alone", "joint"] {
            let is_joint = team == "joint";
            let gain = f64::from(robots) * if is_joint && robots > 1 { 1.5 } else { 1.0 };
            runs.extend((0..n_worlds).map(|world| PolicyRun {
                robots,
                team: team.into(),
                mean_repeated: if is_joint { 0.125 } else { 0.25 },
                rewards: vec![1.0; 4],
                ..run("beam", "known", world, gain * (world + 1) as f64)
            }));
        }
    }
    runs
}
