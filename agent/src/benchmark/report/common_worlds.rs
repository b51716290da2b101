//! Checks that runs can be compared: that they were measured on the same worlds, over the same steps.

use crate::benchmark::report::policy_run::PolicyRun;
use anyhow::{Result, ensure};
use std::fmt::{Display, Formatter};

/// A world in which a run was measured, and what was measured.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct World {
    pub seed: u64,
    pub steps: u64,
    /// The server's `worlds_fingerprint`.
    pub fingerprint: String,
}

impl World {
    pub fn of(run: &PolicyRun) -> Self {
        Self {
            seed: run.world_seed,
            steps: run.steps,
            fingerprint: run.worlds_fingerprint.clone(),
        }
    }
}

impl Display for World {
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        let (seed, steps, fingerprint) = (self.seed, self.steps, &self.fingerprint);
        write!(
            f,
            "world {seed} for {steps} steps, worlds_fingerprint {fingerprint:?}"
        )
    }
}

/// Checks that a policy has one run for each of the worlds, which are in ascending order.
pub fn check_worlds(policy: &str, runs: &[&PolicyRun], worlds: &[World]) -> Result<()> {
    let mut found: Vec<World> = runs.iter().map(|run| World::of(run)).collect();
    found.sort();
    for (expected, got) in worlds.iter().zip(&found) {
        ensure!(
            expected.seed == got.seed,
            "policy {policy:?}: expected a row for world {}, got one for world {}",
            expected.seed,
            got.seed
        );
        ensure!(
            expected == got && !got.fingerprint.is_empty(),
            "policy {policy:?}: expected {expected}, got {got}: run it on the same worlds (model, grid, sensor, \
             moves, robots, start, burn-in)"
        );
    }
    let (expected, got) = (worlds.len(), found.len());
    ensure!(
        expected == got,
        "policy {policy:?}: expected one row for each of {expected} worlds, got {got} rows"
    );
    Ok(())
}
