//! `evaluate`: compares a checkpoint, with its parameters fixed, with the known model.

use super::compare::run_comparison;
use super::shared::{lock_csv, write};
use super::worlds::WorldFlags;
use crate::benchmark::arena::Arena;
use crate::benchmark::compare::Comparison;
use crate::benchmark::evaluate::{Evaluation, Scores, evaluate, score_of_frequencies};
use crate::benchmark::report::{RunsFile, render_table, statistics::Estimate};
use crate::benchmark::team::Team;
use crate::flags::AgentFlags;
use anyhow::{Result, ensure};
use clap::Args;
use emberwatch_belief::estimation::scoring::Score;
use emberwatch_belief::merit::RECENT_STEPS;
use emberwatch_learning::beliefs::{BELIEFS, BeliefKind, KNOWN, KNOWN_SPATIAL};
use emberwatch_learning::config::AgentConfig;
use emberwatch_learning::learned::Learned;
use emberwatch_learning::learners;
use emberwatch_learning::policy::{self, Policy};
use emberwatch_network::DeviceKind;
use std::path::PathBuf;

/// The baseline for comparisons of rewards, which are paired by world.
const BASELINE: &str = "beam_exploit";

/// The policies that learned policies are compared with.
const POLICIES: [&str; 4] = [
    "random_walk",
    "coverage",
    "shooting_exploit",
    "beam_exploit",
];

/// The policies on whose paths predictions are scored.
const GUIDES: [&str; 2] = ["random_walk", "beam_exploit"];

/// Compare a checkpoint's predictions and policies with the known model's.
#[derive(Args)]
pub struct EvaluateCommand {
    /// Checkpoint of `train`; may be given once per learner
    #[arg(long, value_name = "FILE", required = true)]
    checkpoint: Vec<PathBuf>,
    /// Device for networks: cpu, cuda or metal
    #[arg(long, value_name = "DEVICE", default_value_t)]
    device: DeviceKind,
    /// Score only predictions, not policies
    #[arg(long)]
    predictions_only: bool,
    /// Write a CSV file with one row per policy and world
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    #[command(flatten)]
    worlds: WorldFlags,
    #[command(flatten)]
    settings: AgentFlags,
}

impl EvaluateCommand {
    pub fn run(&self) -> Result<()> {
        let config = self.settings.effective()?;
        let csv = lock_csv(self.csv.as_deref())?;
        let checkpoints = self.checkpoint.iter().map(PathBuf::as_path);
        let learned = learners::read(checkpoints, &self.device.open()?)?;
        let n_robots = self.worlds.task().map_or(1, |task| task.robots);
        ensure!(
            n_robots == 1,
            "--task: expected a task with one robot per world, got {n_robots}"
        );
        let mut worlds = self.worlds.open(false, Some(1), |_| Ok(()))?;
        let arena = &mut worlds.arena;
        let steps = self.worlds.steps(arena.info())?;
        let policies = examined(&learned);
        for guide in GUIDES {
            let evaluation = Evaluation {
                guide,
                seeds: self.worlds.seeds(),
                steps,
                config: &config,
                policies: &policies,
                learned: &learned,
            };
            let scores = evaluate(arena, &evaluation)?;
            let n_matrices = arena.model().n_rings();
            write(&predictions(guide, &policies, &scores, n_matrices))?;
        }
        if !self.predictions_only {
            self.policies(arena, config, learned, csv)?;
        }
        Ok(())
    }

    fn policies(
        &self,
        arena: &mut Arena,
        config: AgentConfig,
        learned: Learned,
        csv: Option<RunsFile>,
    ) -> Result<()> {
        let named = |name| Policy::named(name, arena.model());
        let mut policies = POLICIES
            .into_iter()
            .map(named)
            .collect::<Result<Vec<_>>>()?;
        policies.extend(policy::of_learned(&learned, arena.model()));
        let comparison = Comparison {
            policies,
            teams: vec![Team::Alone],
            seeds: self.worlds.seeds(),
            steps: self.worlds.steps(arena.info())?,
            recent_steps: RECENT_STEPS,
            config,
            learned,
            first_state_known: false,
        };
        let results = run_comparison(arena, &comparison)?;
        write(&render_table(&results.runs, BASELINE))?;
        csv.map_or(Ok(()), |csv| csv.replace(&results.runs))
    }
}

/// Returns one policy for each belief whose predictions are scored: known-model beliefs and learned beliefs.
fn examined(learned: &Learned) -> Vec<Policy> {
    let is_learned = |kind: &&BeliefKind| matches!(kind.learned(learned), Ok(Some(_)));
    let kinds = BELIEFS.iter().copied().filter(is_learned);
    let all = [&KNOWN, &KNOWN_SPATIAL].into_iter().chain(kinds);
    all.map(Policy::exploiting).collect()
}

/// Renders the log-likelihood per visited cell, ± one standard error over worlds. Differences are paired by world.
fn predictions(guide: &str, policies: &[Policy], scores: &[Scores], n_matrices: usize) -> String {
    let column = |of: &dyn Fn(&Scores) -> Score| -> Vec<f64> {
        scores.iter().map(|scores| of(scores).mean()).collect()
    };
    let difference = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a - b).collect();
    let frequencies = column(&|one| score_of_frequencies(scores, &one.counts, n_matrices));
    let scores = |index: usize| column(&|scores| scores.scores[index]);
    let known = scores(0);
    let mut rows = vec![("class frequencies".to_owned(), frequencies)];
    for (index, policy) in policies.iter().enumerate() {
        rows.push((policy.belief.label.to_owned(), scores(index)));
    }
    for (index, policy) in policies.iter().enumerate().skip(1) {
        let name = format!("{} - known_model", policy.belief.label);
        rows.push((name, difference(&scores(index), &known)));
    }
    let mut text = format!("log-likelihood per visited cell on the paths of {guide}:\n");
    for (name, values) in rows {
        text += &format!("  {name:28} {}\n", estimate(&values));
    }
    text
}

fn estimate(values: &[f64]) -> String {
    match Estimate::of(values) {
        Some(Estimate {
            mean,
            standard_error: Some(error),
            ..
        }) => format!("{mean:+.4} ± {error:.4}"),
        Some(Estimate { mean, .. }) => format!("{mean:+.4}"),
        None => "-".into(),
    }
}
