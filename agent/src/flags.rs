//! Flags for the agent's settings. Each flag overrides the preset or the configuration file.

use anyhow::{Context, Result, bail};
use clap::builder::PossibleValuesParser;
use clap::{Args, ValueEnum};
use emberwatch_acting::config::AgentConfig;
use emberwatch_learning::learners;
use emberwatch_learning::learners::decisions::belief_of;
use emberwatch_protocol::program::read_text;
use std::path::{Path, PathBuf};

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Preset {
    /// The settings with the best measured results
    Default,
    /// The settings of the paper's authors
    Paper,
}

/// Flags for the agent's settings.
#[derive(Debug, Args)]
#[command(next_help_heading = "Settings of the agent")]
pub struct AgentFlags {
    /// Start from these settings
    #[arg(long, default_value = "default")]
    pub preset: Preset,
    /// Read settings from this TOML file
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Number of states that beam search keeps after each move
    #[arg(long)]
    pub beam_width: Option<usize>,
    /// Number of random paths that the shooting planner samples
    #[arg(long)]
    pub shooting_samples: Option<usize>,
    /// First belief of the known-model filter: simulated (frequencies of each cell's states in simulated worlds after
    /// the server's burn-in), initial (the model's initial distribution) or uniform
    #[arg(long, value_parser = PossibleValuesParser::new(["simulated", "initial", "uniform"]))]
    pub prior: Option<String>,
    /// Seed of planners, of learners, and of the worlds that the first belief is simulated from [default: 0]
    #[arg(long)]
    pub agent_seed: Option<u64>,
}

impl AgentFlags {
    pub fn effective(&self) -> Result<AgentConfig> {
        let mut config = match (&self.config, self.preset) {
            (Some(path), Preset::Default) => read(path)?,
            (Some(path), Preset::Paper) => bail!(
                "--config {} cannot be combined with --preset paper: remove one of them",
                path.display()
            ),
            (None, Preset::Default) => AgentConfig::default(),
            (None, Preset::Paper) => AgentConfig::paper(),
        };
        config.beam_width = self.beam_width.unwrap_or(config.beam_width);
        config.shooting_samples = self.shooting_samples.unwrap_or(config.shooting_samples);
        if let Some(prior) = &self.prior {
            config.prior = serde_json::from_value(prior.as_str().into())?;
        }
        config.seed = self.agent_seed.unwrap_or(config.seed);
        config.check()?;
        learners::named(&config.learner).map_err(anyhow::Error::msg)?;
        belief_of(&config.decisions.estimator)?;
        Ok(config)
    }
}

fn read(path: &Path) -> Result<AgentConfig> {
    let text = read_text(path).map_err(anyhow::Error::from);
    let config = text.and_then(|text| AgentConfig::from_toml(&text));
    config.with_context(|| format!("config file {}", path.display()))
}
