//! Settings of the paper's networks: the sections `[autoencoder]` and `[dqn]` of `config/agent.toml`.

use crate::config::error::ConfigError;
use crate::estimation::dqn_input::DqnInput;
use ::network::{AdamSettings, AutoencoderSettings, DqnSettings};
use serde::{Deserialize, Serialize};

/// The authors' step sizes.
const PAPER_RATE: f64 = 1e-4;
const PAPER_DQN_RATE: f64 = 0.01;

/// A step size that vanishes: `rate (1 + n / steady)^-power` at iteration n.
///
/// With powers of more than one half and at most one, sums of step sizes diverge and those of their
/// squares do not. The autoencoder's power is larger than the DQN's, so that the quotient of the two
/// vanishes too (paper eq. 20, `eps_sys / eps_dqn -> 0`). A power of 0 keeps the step size.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StepSize {
    pub rate: f64,
    /// Iterations after which it has fallen to `2^-power` of that.
    pub steady: u64,
    /// How fast it falls, 0 to 1.
    pub power: f64,
}

impl StepSize {
    pub fn constant(rate: f64) -> Self {
        Self {
            rate,
            steady: 5_000,
            power: 0.0,
        }
    }

    /// The step size of an iteration, counted from 0.
    pub fn at(&self, iteration: u64) -> f64 {
        self.rate * (1.0 + iteration as f64 / self.steady.max(1) as f64).powf(-self.power)
    }

    fn check(&self, [rate, power]: [&'static str; 2]) -> Result<(), ConfigError> {
        within(rate, self.rate, 1.0)?;
        within(power, self.power, 1.0)
    }
}

/// The dynamic autoencoder (paper sections III.B and III.C).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AutoencoderConfig {
    /// Number of states S, 2 to 64; 0: as many as there are observations.
    pub states: usize,
    /// Length of the encoder's output, 1 to 256.
    pub encoding: usize,
    /// Length of the hidden vector h, 1 to 256.
    pub hidden: usize,
    /// Frames of a trajectory that is learned from, 2 to 10,000.
    pub window: usize,
    /// Frames that the replay keeps, at least a window, at most 100,000.
    pub replay_frames: usize,
    /// First frames that show every cell, if the server gives such.
    pub full_frames: u64,
    /// Adam's decay of the mean of gradients, and of the mean of their squares.
    pub betas: [f32; 2],
    pub step_size: StepSize,
}

impl Default for AutoencoderConfig {
    fn default() -> Self {
        let step_size = StepSize {
            power: 0.9,
            ..StepSize::constant(PAPER_RATE)
        };
        Self {
            step_size,
            ..Self::paper()
        }
    }
}

impl AutoencoderConfig {
    /// What the authors ran for their table.
    pub fn paper() -> Self {
        let settings = AutoencoderSettings::paper();
        Self {
            states: 0,
            encoding: settings.encoding,
            hidden: settings.hidden,
            window: settings.window,
            replay_frames: settings.replay,
            full_frames: 1_000,
            betas: settings.adam.betas,
            step_size: StepSize::constant(PAPER_RATE),
        }
    }

    /// Checks every setting.
    pub fn check(&self) -> Result<(), ConfigError> {
        let least_states = if self.states == 0 { 0 } else { 2 };
        let sizes = [
            ("autoencoder.states", self.states, least_states, 64),
            ("autoencoder.encoding", self.encoding, 1, 256),
            ("autoencoder.hidden", self.hidden, 1, 256),
            ("autoencoder.window", self.window, 2, 10_000),
            (
                "autoencoder.replay_frames",
                self.replay_frames,
                self.window,
                100_000,
            ),
        ];
        for (setting, got, least, most) in sizes {
            between(setting, got, least, most)?;
        }
        for beta in self.betas {
            within("autoencoder.betas", f64::from(beta), 0.999_999)?;
        }
        let names = ["autoencoder.step_size.rate", "autoencoder.step_size.power"];
        self.step_size.check(names)
    }

    /// As the network takes them, with the first step size.
    pub fn settings(&self) -> AutoencoderSettings {
        AutoencoderSettings {
            encoding: self.encoding,
            hidden: self.hidden,
            window: self.window,
            replay: self.replay_frames,
            adam: AdamSettings {
                betas: self.betas,
                ..AdamSettings::paper(self.step_size.rate as f32)
            },
        }
    }
}

/// The DQN (paper section III.E).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DqnConfig {
    /// What it sees: `after_frame` or `summary`.
    pub input: DqnInput,
    /// Transitions that the replay keeps, at least a batch, at most 1,000,000.
    pub replay: usize,
    /// Transitions of an update, 1 to 65,536.
    pub batch: usize,
    /// Discount, 0 to 1.
    pub gamma: f32,
    /// Steps whose rewards a transition adds up, 1 to 1,000.
    pub n_step: usize,
    /// Share of the network in its target after each update, 0 to 1.
    pub tau: f32,
    /// Chance of a random action at the first step, 0 to 1.
    pub epsilon: f32,
    /// Chance of a random action in the end, 0 to 1.
    pub epsilon_end: f32,
    /// Steps from the one to the other, in a straight line.
    pub epsilon_steps: u64,
    /// Double DQN: the network picks the action whose value its target gives.
    pub double: bool,
    pub step_size: StepSize,
}

impl Default for DqnConfig {
    fn default() -> Self {
        let step_size = StepSize {
            power: 0.6,
            ..StepSize::constant(PAPER_DQN_RATE)
        };
        Self {
            step_size,
            ..Self::paper()
        }
    }
}

impl DqnConfig {
    pub fn paper() -> Self {
        let settings = DqnSettings::paper();
        Self {
            input: DqnInput::AfterFrame,
            replay: settings.replay,
            batch: settings.batch,
            gamma: settings.gamma,
            n_step: settings.n_step,
            tau: settings.tau,
            epsilon: settings.epsilon,
            epsilon_end: settings.epsilon_end,
            epsilon_steps: settings.epsilon_steps,
            double: settings.double,
            step_size: StepSize::constant(PAPER_DQN_RATE),
        }
    }

    /// Checks every setting.
    pub fn check(&self) -> Result<(), ConfigError> {
        between("dqn.batch", self.batch, 1, 65_536)?;
        between("dqn.n_step", self.n_step, 1, 1_000)?;
        between("dqn.replay", self.replay, self.batch, 1_000_000)?;
        for (setting, got) in [
            ("dqn.gamma", self.gamma),
            ("dqn.tau", self.tau),
            ("dqn.epsilon", self.epsilon),
            ("dqn.epsilon_end", self.epsilon_end),
        ] {
            within(setting, f64::from(got), 1.0)?;
        }
        let names = ["dqn.step_size.rate", "dqn.step_size.power"];
        self.step_size.check(names)
    }

    /// As the learner takes them, with the first step size.
    pub fn settings(&self) -> DqnSettings {
        let paper = DqnSettings::paper();
        DqnSettings {
            replay: self.replay,
            batch: self.batch,
            gamma: self.gamma,
            n_step: self.n_step,
            tau: self.tau,
            epsilon: self.epsilon,
            epsilon_end: self.epsilon_end,
            epsilon_steps: self.epsilon_steps,
            double: self.double,
            adam: AdamSettings {
                learning_rate: self.step_size.rate as f32,
                ..paper.adam
            },
        }
    }
}

fn within(setting: &'static str, got: f64, most: f64) -> Result<(), ConfigError> {
    match (0.0..=most).contains(&got) {
        true => Ok(()),
        false => Err(ConfigError::Number { setting, most, got }),
    }
}

fn between(
    setting: &'static str,
    got: usize,
    least: usize,
    most: usize,
) -> Result<(), ConfigError> {
    match (least..=most).contains(&got) {
        true => Ok(()),
        false => Err(ConfigError::Range {
            setting,
            least,
            most,
            got,
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_autoencoders_steps_vanish_against_the_dqns() {
        let (system, decision) = (AutoencoderConfig::default(), DqnConfig::default());
        let quotient = |n: u64| system.step_size.at(n) / decision.step_size.at(n);
        assert!((quotient(0) - 0.01).abs() < 1e-9);
        let quotients = [0, 5_000, 50_000, 500_000, 500_000_000].map(quotient);
        assert!(quotients.is_sorted_by(|a, b| a > b), "{quotients:?}");
        assert!(quotients[4] < 0.04 * quotients[0]);
        assert_eq!(AutoencoderConfig::paper().step_size.at(1_000_000), 1e-4);
    }

    #[test]
    fn settings_reach_the_networks() {
        let settings = AutoencoderConfig::paper().settings();
        assert_eq!(settings, AutoencoderSettings::paper());
        assert_eq!(DqnConfig::paper().settings(), DqnSettings::paper());
    }

    #[test]
    fn wrong_settings_are_named() {
        let small = AutoencoderConfig {
            replay_frames: 999,
            ..AutoencoderConfig::default()
        };
        assert_eq!(
            small.check().map_err(|error| error.to_string()),
            Err("autoencoder.replay_frames: expected 1000 to 100000, got 999".into())
        );
        let eager = DqnConfig {
            epsilon: 2.0,
            ..DqnConfig::default()
        };
        assert_eq!(
            eager.check().map_err(|error| error.to_string()),
            Err("dqn.epsilon: expected 0 to 1, got 2".into())
        );
    }
}
