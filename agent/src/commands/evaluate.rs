//! `evaluate`: what a checkpoint is worth beside the known model, with its parameters fixed.

use super::compare::run_comparison;
use super::worlds::WorldFlags;
use super::write;
use agent::arena::Arena;
use agent::compare::Comparison;
use agent::config::{AgentConfig, AgentFlags};
use agent::evaluate::{Examination, Marks, examine, score_of_frequencies};
use agent::learner::Learned;
use agent::policy::Policy;
use agent::report::{render_table, statistics::Estimate, write_csv};
use agent::scoring::Score;
use agent::train::read_learned;
use anyhow::Result;
use clap::Args;
use std::path::PathBuf;

/// What rewards are paired against.
const BASELINE: &str = "beam_exploit";

/// What is compared.
const POLICIES: [&str; 4] = [
    "shooting_exploit",
    "beam_exploit",
    "learned_shooting",
    "learned_beam",
];

/// Who chooses the paths on which predictions are scored.
const GUIDES: [&str; 2] = ["random_walk", "beam_exploit"];

/// Score a checkpoint beside the known model.
#[derive(Args)]
pub struct EvaluateCommand {
    /// What `train` learned
    #[arg(long, value_name = "FILE")]
    checkpoint: PathBuf,
    /// Only score predictions, not policies
    #[arg(long)]
    predictions_only: bool,
    /// Write one line per policy and world to this file
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    #[command(flatten)]
    worlds: WorldFlags,
    #[command(flatten)]
    settings: AgentFlags,
}

impl EvaluateCommand {
    /// Scores predictions, then policies.
    pub fn run(&self) -> Result<()> {
        let config = self.settings.effective()?;
        let learned = read_learned(&self.checkpoint)?;
        let mut worlds = self.worlds.open(false, |_| Ok(()))?;
        let arena = &mut worlds.arena;
        for guide in GUIDES {
            let examination = Examination {
                guide,
                seeds: self.worlds.seeds.clone(),
                steps: self.worlds.steps,
                config: &config,
                learned: &learned,
            };
            write(&predictions(guide, &examine(arena, &examination)?))?;
        }
        if !self.predictions_only {
            self.policies(arena, config, learned)?;
        }
        Ok(())
    }

    fn policies(&self, arena: &mut Arena, config: AgentConfig, learned: Learned) -> Result<()> {
        let named = |name| Policy::named(name, arena.model());
        let comparison = Comparison {
            policies: POLICIES.into_iter().map(named).collect::<Result<_, _>>()?,
            seeds: self.worlds.seeds.clone(),
            steps: self.worlds.steps,
            config,
            learned: Some(learned),
        };
        let results = run_comparison(arena, &comparison)?;
        write(&render_table(&results.runs, BASELINE))?;
        if let Some(path) = &self.csv {
            write_csv(path, &results.runs)?;
        }
        Ok(())
    }
}

/// Log-likelihood per visited cell, ± one standard error over worlds.
fn predictions(guide: &str, marks: &[Marks]) -> String {
    let column = |of: &dyn Fn(&Marks) -> Score| -> Vec<f64> {
        marks.iter().map(|marks| of(marks).mean()).collect()
    };
    let known = column(&|marks| marks.known);
    let learned = column(&|marks| marks.learned);
    let frequencies = column(&|one| score_of_frequencies(marks, &one.counts));
    let difference: Vec<f64> = learned.iter().zip(&known).map(|(a, b)| a - b).collect();
    let rows = [
        ("class frequencies", frequencies),
        ("known-model filter", known),
        ("learned filter", learned),
        ("learned - known", difference),
    ];
    let mut text = format!("log-likelihood per visited cell on the paths of {guide}:\n");
    for (name, values) in rows {
        text += &format!("  {name:20}{}\n", estimate(&values));
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
