//! The agent's settings: the defaults or the paper's preset, overridden by a TOML file.

mod sections;

pub use sections::{
    AutoencoderConfig, DecisionsConfig, LearningConfig, NetworkDqnConfig, NeuralConfig, StepSize,
};

use self::sections::check;
use anyhow::{Result, anyhow, bail, ensure};
use emberwatch_belief::estimation::Prior;
use emberwatch_belief::planning::Integration;
use emberwatch_model::text::parse_problem;
use serde::{Deserialize, Serialize};
use toml::{Table, Value};

const DEFAULTS: &str = include_str!("../agent.toml");

/// The authors' settings that differ from the defaults: moves summed without regard to the grid, with each partial sum
/// clamped, a uniform first belief, and constant step sizes for the autoencoder and the DQN.
const PAPER: &str = r#"
shooting_integration = "clamp_sum"
prior = "uniform"
learner = "autoencoder"
autoencoder.step_size.power = 0.0
dqn.step_size.power = 0.0
"#;

/// Settings of earlier versions that are constant now, with their values in TOML. Checkpoints may contain them.
const CONSTANTS: [(&str, &str); 8] = [
    ("objective.shooting_bonus", "1.0"),
    ("objective.beam_bonus", "0.02"),
    ("objective.entropy", "\"mean\""),
    ("objective.belief", "\"predictor\""),
    ("learning.beta1", "0.9"),
    ("learning.beta2", "0.99"),
    ("learning.anchor", "0.001"),
    ("autoencoder.betas", "[0.5, 0.9]"),
];

/// Settings of planners and estimators. `config/agent.toml` explains each of them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AgentConfig {
    pub beam_width: usize,
    pub shooting_samples: usize,
    pub shooting_integration: Integration,
    pub prior: PriorKind,
    pub prior_worlds: usize,
    pub seed: u64,
    /// The name of the learner that `train` uses.
    pub learner: String,
    pub full_frames: bool,
    pub learning: LearningConfig,
    pub neural: NeuralConfig,
    pub autoencoder: AutoencoderConfig,
    pub dqn: NetworkDqnConfig,
    pub decisions: DecisionsConfig,
}

/// The first belief of the known-model filter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PriorKind {
    /// Frequencies of each cell's states in simulated worlds after the server's burn-in.
    Simulated,
    /// The model's initial distribution.
    Initial,
    /// Every state equally likely.
    Uniform,
}

impl Default for AgentConfig {
    fn default() -> Self {
        Self::from_toml("").expect("invariant: the defaults are valid settings")
    }
}

impl AgentConfig {
    /// Returns the settings of the paper's authors.
    pub fn paper() -> Self {
        Self::from_toml(PAPER).expect("invariant: the preset has valid settings")
    }

    /// Parses settings from TOML. Settings that the text omits keep their defaults.
    ///
    /// # Errors
    /// If a setting is unknown or out of range. The error names the first such setting.
    pub fn from_toml(text: &str) -> Result<Self> {
        let mut settings: Table = DEFAULTS.parse()?;
        let given: Table = text
            .parse()
            .map_err(|error| anyhow!(parse_problem(error)))?;
        replace(&mut settings, given, "")?;
        let config: Self = settings.try_into()?;
        config.check()?;
        Ok(config)
    }

    /// Checks every setting.
    ///
    /// # Errors
    /// If a setting is out of range. The error names the first such setting.
    pub fn check(&self) -> Result<()> {
        let ranges = [
            ("beam_width", self.beam_width as f64, 1.0, 1e4),
            ("shooting_samples", self.shooting_samples as f64, 1.0, 1e6),
            ("prior_worlds", self.prior_worlds as f64, 1.0, 1e4),
        ];
        check("", &ranges)?;
        self.learning.check()?;
        self.neural.check()?;
        self.autoencoder.check()?;
        self.dqn.check()?;
        self.decisions.check()
    }

    /// Returns the prior for a server with the given burn-in, in steps.
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

    /// Combines the seeds of a world and of the agent into the seed of a planner.
    pub fn planner_seed(&self, world_seed: u64) -> u64 {
        world_seed ^ self.seed.rotate_left(32)
    }
}

fn replace(settings: &mut Table, by: Table, section: &str) -> Result<()> {
    for (name, value) in by {
        match (settings.get_mut(&name), value) {
            (None, Value::Table(by)) => {
                replace(&mut Table::new(), by, &format!("{section}{name}."))?;
            }
            (None, value) => check_constant(&format!("{section}{name}"), &value.to_string())?,
            (Some(Value::Table(settings)), Value::Table(by)) => {
                replace(settings, by, &format!("{section}{name}."))?;
            }
            (Some(setting), value) => *setting = value,
        }
    }
    Ok(())
}

fn check_constant(name: &str, got: &str) -> Result<()> {
    match CONSTANTS.iter().find(|constant| constant.0 == name) {
        Some((_, expected)) => ensure!(
            got == *expected
                || got
                    .parse::<f64>()
                    .ok()
                    .is_some_and(|it| expected.parse() == Ok(it)),
            "{name}: expected {expected}, which is constant, got {got}"
        ),
        None => bail!("{name}: expected a known setting"),
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    #[test]
    fn settings_override_defaults_and_unknown_settings_fail() {
        let config = AgentConfig::from_toml("seed = 3\n[dqn]\nstep_size.rate = 1").expect("valid");
        assert_eq!((config.seed, config.dqn.step_size.rate), (3, 1.0));
        assert_eq!(config.dqn.step_size.power, 0.6);
        let written = toml::to_string(&config).expect("TOML");
        assert_eq!(AgentConfig::from_toml(&written).expect("valid"), config);
        let error = AgentConfig::from_toml("[dqn]\ngama = 1").expect_err("no such setting");
        assert_eq!(error.to_string(), "dqn.gama: expected a known setting");
    }

    #[test]
    fn planner_seeds_depend_on_the_world_and_on_the_agent() {
        let seeds = [(0, 1), (0, 2), (7, 1), (7, 2), (1, 7)].map(|(seed, world)| {
            let config = AgentConfig {
                seed,
                ..AgentConfig::default()
            };
            config.planner_seed(world)
        });
        assert_eq!(HashSet::from(seeds).len(), seeds.len());
    }

    #[test]
    fn errors_name_invalid_settings() {
        for (settings, expected) in [
            ("beam_width = 0", "1 to 10000, got 0"),
            ("learning.streams = 0", "1 to 1024, got 0"),
            ("learning.states = 1", "2 to 64, got 1"),
            ("learning.rate = nan", "0 to 1, got NaN"),
            ("neural.batch = 0", "1 to 1024, got 0"),
            ("autoencoder.replay_frames = 999", "1000 to 100000, got 999"),
            ("autoencoder.step_size.rate = 2.0", "0 to 1, got 2"),
            ("dqn.epsilon = 2.0", "0 to 1, got 2"),
            ("decisions.n_step = 0", "1 to 1000, got 0"),
            ("decisions.replay = 8", "256 to 200000, got 8"),
            ("decisions.beam_width = 0", "1 to 10000, got 0"),
            ("decisions.gamma = 1.5", "0 to 1, got 1.5"),
        ] {
            let error = AgentConfig::from_toml(settings).expect_err(settings);
            let name = settings.split(" = ").next().unwrap_or_default();
            assert_eq!(error.to_string(), format!("{name}: expected {expected}"));
        }
        let old = "objective.belief = 'predictor'\nautoencoder.betas = [0.5, 0.9]\nobjective.beam_bonus = 0.02";
        AgentConfig::from_toml(old).expect("constants");
        let error = AgentConfig::from_toml("objective.belief = 'estimate'").expect_err("constant");
        let words = "objective.belief: expected \"predictor\", which is constant, got \"estimate\"";
        assert_eq!(error.to_string(), words);
    }
}
