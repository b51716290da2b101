//! The agent's settings: defaults or the paper's preset, then a TOML file, then flags.

mod decisions;
mod error;
mod learning;
mod networks;

pub use decisions::DecisionsConfig;
pub use error::ConfigError;
pub use learning::LearningConfig;
pub use networks::{AutoencoderConfig, DqnConfig, StepSize};

use crate::estimation::Prior;
use crate::estimation::belief::EntropyKind;
use crate::planning::beam::DEFAULT_WIDTH;
use crate::planning::objective::BEAM_BONUS;
use crate::planning::policy::{PlannerKind, Policy};
use crate::planning::{
    BasisKind, BeamSearch, Integration, Objective, Planner, RandomWalk, Shooting, Target,
};
use clap::{Args, ValueEnum};
use protocol::program::read_text;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

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
    /// What planners maximise.
    pub objective: ObjectiveConfig,
    /// The known-model filter's first belief: `simulated`, `initial` or `uniform`.
    pub prior: PriorKind,
    /// Worlds simulated for the prior `simulated`, 1 to 10,000.
    pub prior_worlds: usize,
    /// Seed of planners, of the prior's worlds and of learners.
    pub seed: u64,
    /// What `train` learns.
    pub learner: LearnerKind,
    /// How the learned filter learns.
    pub learning: LearningConfig,
    /// How the autoencoder learns.
    pub autoencoder: AutoencoderConfig,
    /// How the DQN learns.
    pub dqn: DqnConfig,
    /// How the DQN over actions of beam search learns.
    pub decisions: DecisionsConfig,
}

/// What `train` learns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum LearnerKind {
    /// A Bayes filter of the model's own form, with unknown parameters
    Filter,
    /// The paper's Algorithm 1: a dynamic autoencoder, and a DQN that chooses objectives
    Autoencoder,
    /// A DQN that chooses among actions of beam search on the known model's belief
    Decisions,
}

/// What planners maximise besides the target that a policy's name says (paper eqs. 13 to 15).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ObjectiveConfig {
    /// Shooting's bonus for each distinct cell, 0 to 1000.
    pub shooting_bonus: f32,
    /// Beam search's bonus for each distinct cell, 0 to 1000.
    pub beam_bonus: f32,
    /// Entropy as the `mean` (the authors' code) or the `sum` (the paper) of its terms.
    pub entropy: EntropyKind,
    /// Whether a cell's value counts at every visit (the paper as printed).
    pub revisits: bool,
    /// Paths are planned on the `predictor` `u_{k+1}` (the authors' code) or the `estimate` `p_k` (the
    /// paper).
    pub belief: BasisKind,
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
    /// Seed of planners, of the prior's worlds and of learners [default: 0]
    #[arg(long)]
    pub agent_seed: Option<u64>,
}

impl Default for AgentConfig {
    fn default() -> Self {
        Self {
            beam_width: DEFAULT_WIDTH,
            shooting_samples: 2048,
            shooting_integration: Integration::ClampEachMove,
            objective: ObjectiveConfig::default(),
            prior: PriorKind::Simulated,
            prior_worlds: 64,
            seed: 0,
            learner: LearnerKind::Filter,
            learning: LearningConfig::default(),
            autoencoder: AutoencoderConfig::default(),
            dqn: DqnConfig::default(),
            decisions: DecisionsConfig::default(),
        }
    }
}

impl Default for ObjectiveConfig {
    fn default() -> Self {
        Self {
            shooting_bonus: 1.0,
            beam_bonus: BEAM_BONUS,
            entropy: EntropyKind::Mean,
            revisits: false,
            belief: BasisKind::Predictor,
        }
    }
}

impl AgentConfig {
    /// What the authors ran: moves clamped after the sum, a uniform first belief, the autoencoder and the
    /// DQN with steps of constant size.
    pub fn paper() -> Self {
        Self {
            shooting_integration: Integration::ClampSum,
            prior: PriorKind::Uniform,
            learner: LearnerKind::Autoencoder,
            autoencoder: AutoencoderConfig::paper(),
            dqn: DqnConfig::paper(),
            ..Self::default()
        }
    }

    /// Checks every setting.
    pub fn check(self) -> Result<Self, ConfigError> {
        in_range("beam_width", self.beam_width, 10_000)?;
        in_range("shooting_samples", self.shooting_samples, 1_000_000)?;
        in_range("prior_worlds", self.prior_worlds, 10_000)?;
        let ObjectiveConfig {
            shooting_bonus,
            beam_bonus,
            ..
        } = self.objective;
        for (setting, got) in [
            ("shooting_bonus", shooting_bonus),
            ("beam_bonus", beam_bonus),
        ] {
            if !(0.0..=1000.0).contains(&got) {
                return Err(ConfigError::Bonus { setting, got });
            }
        }
        self.learning.check()?;
        self.autoencoder.check()?;
        self.dqn.check()?;
        self.decisions.check()?;
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

    /// What a policy maximises under these settings. A policy without a bonus, such as
    /// `shooting_exploit_only`, and coverage, which is nothing but the bonus, keep theirs.
    pub fn objective(&self, policy: &Policy) -> Objective {
        let own = policy.objective;
        let settings = &self.objective;
        let keeps = own.coverage_bonus == 0.0 || own.target == Target::Coverage;
        let coverage_bonus = match policy.planner {
            _ if keeps => own.coverage_bonus,
            PlannerKind::Beam => settings.beam_bonus,
            PlannerKind::Shooting | PlannerKind::RandomWalk => settings.shooting_bonus,
        };
        Objective {
            target: own.target,
            coverage_bonus,
            entropy: settings.entropy,
            revisits: settings.revisits,
        }
    }

    /// Seed of a planner: its world's, told apart by the agent's own.
    pub fn planner_seed(&self, world_seed: u64) -> u64 {
        world_seed ^ self.seed.rotate_left(32)
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

fn read(path: &Path) -> Result<AgentConfig, ConfigError> {
    let wrong = |problem: String| ConfigError::File {
        path: path.display().to_string(),
        problem,
    };
    let text = read_text(path).map_err(|error| wrong(error.to_string()))?;
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
    fn settings_of_the_objective_reach_the_policies() {
        let model = protocol::Model::wildfire();
        let policy = |name| Policy::named(name, &model).expect("a known name");
        let mut config = AgentConfig::default();
        for policy in Policy::ladder(&model) {
            assert_eq!(
                config.objective(&policy).coverage_bonus,
                policy.objective.coverage_bonus
            );
        }
        config.objective.shooting_bonus = 3.0;
        config.objective.revisits = true;
        assert_eq!(
            config.objective(&policy("shooting_explore")).coverage_bonus,
            3.0
        );
        assert!(config.objective(&policy("beam_exploit")).revisits);
        assert_eq!(
            config
                .objective(&policy("shooting_exploit_only"))
                .coverage_bonus,
            0.0
        );
        assert_eq!(config.objective(&policy("coverage")).coverage_bonus, 1.0);
        config.objective.beam_bonus = f32::NAN;
        let error = config.check().expect_err("no number").to_string();
        assert_eq!(error, "objective.beam_bonus: expected 0 to 1000, got NaN");
    }

    #[test]
    fn wrong_settings_are_named() {
        let config = AgentConfig {
            beam_width: 0,
            ..AgentConfig::default()
        };
        let error = config.check().expect_err("no beam").to_string();
        assert_eq!(error, "beam_width: expected 1 to 10000, got 0");
        for (text, words) in [
            (
                "[objective]\nbelief = \"prior\"",
                "unknown variant `prior`, expected `predictor` or `estimate`",
            ),
            (
                "[dqn]\ninput = \"h\"",
                "unknown variant `h`, expected `after_frame` or `summary`",
            ),
        ] {
            let error = toml::from_str::<AgentConfig>(text).expect_err("no such name");
            assert!(error.to_string().contains(words), "{error}");
        }
    }
}
