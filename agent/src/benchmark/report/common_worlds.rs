//! Checks that runs can be compared: that they were measured on the same worlds, over the same steps.

use crate::benchmark::report::policy_run::PolicyRun;
use anyhow::{Result, bail, ensure};

/// Seed, number of steps and `worlds_fingerprint` of a run.
pub type World = (u64, u64, String);

/// Returns the world of each run, in ascending order.
pub fn worlds<'a>(runs: impl IntoIterator<Item = &'a PolicyRun>) -> Vec<World> {
    let of = |run: &PolicyRun| (run.world_seed, run.steps, run.worlds_fingerprint.clone());
    let mut worlds: Vec<World> = runs.into_iter().map(of).collect();
    worlds.sort();
    worlds
}

/// Checks that a policy has one run for each of the worlds, which are in ascending order.
pub fn check_worlds<'a>(
    policy: &str,
    runs: impl IntoIterator<Item = &'a PolicyRun>,
    expected: &[World],
) -> Result<()> {
    let got = worlds(runs);
    let named = |(seed, steps, fingerprint): &World| {
        format!("world {seed} for {steps} steps, worlds_fingerprint {fingerprint:?}")
    };
    let differs = |(a, b): &(&World, &World)| a != b || b.2.is_empty();
    if let Some((expected, got)) = expected.iter().zip(&got).find(differs) {
        let (expected, got) = (named(expected), named(got));
        bail!(
            "policy {policy:?}: expected {expected}, got {got}: run it on the same worlds (model, grid, sensor, \
             moves, robots, start, burn-in)"
        );
    }
    let (expected, got) = (expected.len(), got.len());
    ensure!(
        expected == got,
        "policy {policy:?}: expected one row for each of {expected} worlds, got {got} rows"
    );
    Ok(())
}
