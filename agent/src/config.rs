//! The agent's settings: defaults or the paper's preset, then a TOML file, then flags.

use crate::estimator::Prior;
use crate::planner::beam::DEFAULT_WIDTH;
use crate::planner::{BeamSearch, Integration, Planner, RandomWalk, Shooting};
use crate::policy::{PlannerKind, Policy};
use clap::{Args, ValueEnum};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use thiserror::Error;

/// Settings of planners and estimators; `config/agent.toml` lists them with their defaults.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AgentConfig {
    /// States that beam search keeps, 1 to 10,000.
    pub beam_width: usize,
    /// Paths that shooting samples, 1 to 1,000,000.
    pub shooting_samples: usize,
    /// How shooting turns samples into positions: `clamp_each_move` or `clamp_sum`.
    pub shooting_integration: Integration,
    /// The known-model filter's first belief: `simulated`, `initial` or `uniform`.
    pub prior: PriorKind,
    /// Worlds simulated for the prior `simulated`, 1 to 10,000.
    pub prior_worlds: usize,
    /// Seed of planners and of the prior's worlds.
    pub seed: u64,
}

/// The known-model filter's first belief.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum PriorKind {
    /// How often each cell of simulated worlds is in each state after the server's burn-in
    Simulated,
    /// The model's initial distribution
    Initial,
    /// Every state equally likely
    Uniform,
}

/// Where settings start from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Preset {
    /// Whatever measures best
    Default,
    /// What the paper's authors ran
    Paper,
}

/// The settings as flags.
#[derive(Debug, Args)]
pub struct AgentFlags {
    /// Start from these settings
    #[arg(long, default_value = "default")]
    pub preset: Preset,
    /// Read settings from this TOML file
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// States that beam search keeps
    #[arg(long)]
    pub beam_width: Option<usize>,
    /// Paths that shooting samples
    #[arg(long)]
    pub shooting_samples: Option<usize>,
    /// The known-model filter's first belief
    #[arg(long)]
    pub prior: Option<PriorKind>,
    /// Seed of planners and of the prior's worlds [default: 0]
    #[arg(long)]
    pub agent_seed: Option<u64>,
}

/// Why settings were refused.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// A file that cannot be read or is not of the form.
    #[error("config file {path}: {problem}")]
    File {
        /// Its path.
        path: String,
        /// What is wrong.
        problem: String,
    },
    /// A setting out of its range.
    #[error("{setting}: expected {least} to {most}, got {got}")]
    Range {
        /// Which setting.
        setting: &'static str,
        /// Least value allowed.
        least: usize,
        /// Greatest value allowed.
        most: usize,
        /// What it is.
        got: usize,
    },
}

impl Default for AgentConfig {
    fn default() -> Self {
        Self {
            beam_width: DEFAULT_WIDTH,
            shooting_samples: 2048,
            shooting_integration: Integration::ClampEachMove,
            prior: PriorKind::Simulated,
            prior_worlds: 64,
            seed: 0,
        }
    }
}

impl AgentConfig {
    /// What the authors ran: moves clamped after the sum, a uniform first belief.
    pub fn paper() -> Self {
        Self {
            shooting_integration: Integration::ClampSum,
            prior: PriorKind::Uniform,
            ..Self::default()
        }
    }

    /// Checks every setting.
    ///
    /// # Errors
    /// [`ConfigError::Range`] names the first setting that is wrong.
    pub fn check(self) -> Result<Self, ConfigError> {
        in_range("beam_width", self.beam_width, 10_000)?;
        in_range("shooting_samples", self.shooting_samples, 1_000_000)?;
        in_range("prior_worlds", self.prior_worlds, 10_000)?;
        Ok(self)
    }

    /// The prior for a server with this burn-in.
    pub fn prior(&self, burn_in: u64) -> Prior {
        match self.prior {
            PriorKind::Simulated => Prior::Simulated {
                n_worlds: self.prior_worlds,
                burn_in,
            },
            PriorKind::Initial => Prior::Initial,
            PriorKind::Uniform => Prior::Uniform,
        }
    }

    /// The planner of a policy.
    pub fn planner(&self, policy: &Policy) -> Box<dyn Planner + Send> {
        match policy.planner {
            PlannerKind::RandomWalk => Box::new(RandomWalk),
            PlannerKind::Shooting => Box::new(Shooting::new(
                self.shooting_samples,
                self.shooting_integration,
            )),
            PlannerKind::Beam => Box::new(BeamSearch::new(self.beam_width)),
        }
    }
}

impl AgentFlags {
    /// The effective settings.
    ///
    /// # Errors
    /// [`ConfigError`].
    pub fn effective(&self) -> Result<AgentConfig, ConfigError> {
        let mut config = match (&self.config, self.preset) {
            (Some(path), Preset::Default) => read(path)?,
            (Some(path), Preset::Paper) => {
                let (path, problem) = (
                    path.display().to_string(),
                    "expected no file beside --preset paper".into(),
                );
                return Err(ConfigError::File { path, problem });
            }
            (None, Preset::Default) => AgentConfig::default(),
            (None, Preset::Paper) => AgentConfig::paper(),
        };
        config.beam_width = self.beam_width.unwrap_or(config.beam_width);
        config.shooting_samples = self.shooting_samples.unwrap_or(config.shooting_samples);
        config.prior = self.prior.unwrap_or(config.prior);
        config.seed = self.agent_seed.unwrap_or(config.seed);
        config.check()
    }
}

fn read(path: &PathBuf) -> Result<AgentConfig, ConfigError> {
    let wrong = |problem: String| ConfigError::File {
        path: path.display().to_string(),
        problem,
    };
    let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
    toml::from_str(&text).map_err(|error| wrong(error.to_string()))
}

fn in_range(setting: &'static str, got: usize, most: usize) -> Result<(), ConfigError> {
    if (1..=most).contains(&got) {
        return Ok(());
    }
    Err(ConfigError::Range {
        setting,
        least: 1,
        most,
        got,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_documented_file_holds_the_defaults() {
        let text = include_str!("../../config/agent.toml");
        assert_eq!(
            toml::from_str::<AgentConfig>(text).ok(),
            Some(AgentConfig::default())
        );
        let n_settings = toml::Table::try_from(AgentConfig::default())
            .expect("serialises")
            .len();
        assert_eq!(
            text.parse::<toml::Table>().expect("TOML").len(),
            n_settings,
            "a setting is not listed"
        );
    }

    #[test]
    fn wrong_settings_are_named() {
        let config = AgentConfig {
            beam_width: 0,
            ..AgentConfig::default()
        };
        let error = config.check().expect_err("no beam").to_string();
        assert_eq!(error, "beam_width: expected 1 to 10000, got 0");
    }
}
