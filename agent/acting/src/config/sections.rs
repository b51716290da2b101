//! The sections of `config/agent.toml`, which explains each setting.

use anyhow::{Result, bail};
use emberwatch_network::{AdamSettings, AutoencoderSettings, DqnSettings};
use serde::{Deserialize, Serialize};

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LearningConfig {
    pub states: usize,
    pub kernel: [usize; 2],
    pub window: usize,
    pub streams: usize,
    pub block_windows: usize,
    pub replay_frames: usize,
    pub rate: f64,
    pub observation_rate: f64,
    pub steady_updates: u64,
    pub falling_updates: u64,
    pub final_rate: f64,
    pub updates_per_step: f64,
    pub explore_steps: u64,
    pub explore_share: f64,
}

/// Settings of `train --learner neural`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct NeuralConfig {
    pub steps: u64,
    pub episode_steps: u64,
    pub replay_frames: usize,
    pub batch: usize,
    pub updates_per_step: f64,
    pub rate: f64,
    pub final_rate: f64,
    pub explore_share: f64,
}

/// Settings for training the dynamic autoencoder (paper sections III.B and III.C).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct AutoencoderConfig {
    pub states: usize,
    pub encoding: usize,
    pub hidden: usize,
    pub window: usize,
    pub replay_frames: usize,
    pub full_frames: u64,
    pub step_size: StepSize,
}

/// Settings for training the DQN of Algorithm 1 (paper section III.E).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct NetworkDqnConfig {
    #[serde(flatten)]
    pub learning: DqnSettings,
    pub step_size: StepSize,
}

/// Settings of `train --learner decisions`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DecisionsConfig {
    /// The name of the belief that decisions are based on.
    pub estimator: String,
    pub filter_steps: u64,
    pub beam_width: usize,
    pub steps: u64,
    pub episode_steps: u64,
    #[serde(flatten)]
    pub learning: DqnSettings,
    pub longest_hold: u64,
    pub reward_scale: f32,
    pub updates_per_step: f64,
    pub rate: f32,
    pub final_rate: f32,
}

/// A vanishing step size: `rate (1 + n / steady)^-power` at iteration n.
///
/// If the power is above 1/2 and at most 1, the sum of the step sizes diverges, and the sum of their squares converges.
/// The autoencoder's power is larger than the DQN's, so that their quotient vanishes as well (paper eq. 20,
/// `eps_sys / eps_dqn -> 0`). With a power of 0, the step size is constant.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct StepSize {
    pub rate: f64,
    pub steady: u64,
    pub power: f64,
}

/// A setting's name, its value, and its minimum and maximum.
pub(super) type Range<'a> = (&'a str, f64, f64, f64);

pub(super) fn check(section: &str, settings: &[Range<'_>]) -> Result<()> {
    for &(name, got, least, most) in settings {
        if !(least..=most).contains(&got) {
            bail!("{section}{name}: expected {least} to {most}, got {got}");
        }
    }
    Ok(())
}

impl LearningConfig {
    pub(super) fn check(&self) -> Result<()> {
        let ranges = [
            states(self.states),
            ("window", self.window as f64, 1.0, 1024.0),
            ("streams", self.streams as f64, 1.0, 1024.0),
            ("block_windows", self.block_windows as f64, 1.0, 1024.0),
            ("replay_frames", self.replay_frames as f64, 1.0, 1.6e7),
            ("rate", self.rate, 0.0, 1.0),
            ("observation_rate", self.observation_rate, 0.0, 100.0),
            ("final_rate", self.final_rate, 0.0, 1.0),
            ("updates_per_step", self.updates_per_step, 0.0, 1e3),
            ("explore_share", self.explore_share, 0.0, 1.0),
        ];
        check("learning.", &ranges)
    }

    /// Returns the factor of the step size at an update: 1 at first, then falling linearly to `final_rate`.
    pub fn rate_at(&self, update: u64) -> f64 {
        let fallen = update.saturating_sub(self.steady_updates) as f64;
        let share = 1.0 - fallen / self.falling_updates.max(1) as f64;
        share.max(self.final_rate)
    }
}

impl NeuralConfig {
    pub(super) fn check(&self) -> Result<()> {
        let ranges = [
            ("steps", self.steps as f64, 1.0, 1e12),
            ("episode_steps", self.episode_steps as f64, 1.0, 1e9),
            ("replay_frames", self.replay_frames as f64, 1.0, 1e6),
            ("batch", self.batch as f64, 1.0, 1024.0),
            ("updates_per_step", self.updates_per_step, 0.0, 16.0),
            ("rate", self.rate, 0.0, 1.0),
            ("final_rate", self.final_rate, 0.0, 1.0),
            ("explore_share", self.explore_share, 0.0, 1.0),
        ];
        check("neural.", &ranges)
    }
}

impl AutoencoderConfig {
    pub(super) fn check(&self) -> Result<()> {
        let window = self.window as f64;
        let ranges = [
            states(self.states),
            ("encoding", self.encoding as f64, 1.0, 256.0),
            ("hidden", self.hidden as f64, 1.0, 256.0),
            ("window", window, 2.0, 1e4),
            ("replay_frames", self.replay_frames as f64, window, 1e5),
        ];
        check("autoencoder.", &ranges)?;
        check("autoencoder.step_size.", &self.step_size.ranges())
    }

    /// Returns the settings for the network, with the initial step size.
    pub fn settings(&self) -> AutoencoderSettings {
        AutoencoderSettings {
            encoding: self.encoding,
            hidden: self.hidden,
            window: self.window,
            replay: self.replay_frames,
            adam: AdamSettings::paper(self.step_size.rate as f32),
        }
    }
}

fn check_dqn(section: &str, dqn: &DqnSettings, most_kept: f64) -> Result<()> {
    let batch = dqn.batch as f64;
    let ranges = [
        ("batch", batch, 1.0, 65_536.0),
        ("n_step", dqn.n_step as f64, 1.0, 1e3),
        ("width", dqn.width as f64, 1.0, 1024.0),
        ("replay", dqn.replay as f64, batch, most_kept),
        ("gamma", dqn.gamma.into(), 0.0, 1.0),
        ("tau", dqn.tau.into(), 0.0, 1.0),
        ("epsilon", dqn.epsilon.into(), 0.0, 1.0),
        ("epsilon_end", dqn.epsilon_end.into(), 0.0, 1.0),
    ];
    check(section, &ranges)
}

impl NetworkDqnConfig {
    pub(super) fn check(&self) -> Result<()> {
        check_dqn("dqn.", &self.learning, 1e6)?;
        check("dqn.step_size.", &self.step_size.ranges())
    }

    /// Returns the settings for the network, with the initial step size.
    pub fn settings(&self) -> DqnSettings {
        self.learning.with_rate(self.step_size.rate as f32)
    }
}

impl DecisionsConfig {
    pub(super) fn check(&self) -> Result<()> {
        check_dqn("decisions.", &self.learning, 2e5)?;
        let ranges = [
            ("filter_steps", self.filter_steps as f64, 1.0, 1e12),
            ("beam_width", self.beam_width as f64, 1.0, 1e4),
            ("episode_steps", self.episode_steps as f64, 1.0, 1e9),
            ("longest_hold", self.longest_hold as f64, 1.0, 1e3),
            ("final_rate", self.final_rate.into(), 0.0, 1.0),
            ("reward_scale", self.reward_scale.into(), 0.0, 1e3),
            ("updates_per_step", self.updates_per_step, 0.0, 16.0),
            ("rate", self.rate.into(), 0.0, 1.0),
        ];
        check("decisions.", &ranges)
    }

    /// Returns the settings for the network, with the initial step size.
    pub fn settings(&self) -> DqnSettings {
        self.learning.with_rate(self.rate)
    }
}

impl StepSize {
    /// Returns the step size of an iteration, counted from 0.
    pub fn at(&self, iteration: u64) -> f64 {
        self.rate * (1.0 + iteration as f64 / self.steady.max(1) as f64).powf(-self.power)
    }

    fn ranges(&self) -> [Range<'static>; 2] {
        [
            ("rate", self.rate, 0.0, 1.0),
            ("power", self.power, 0.0, 1.0),
        ]
    }
}

/// Returns the permitted range of a number of states. 0 means as many states as observations.
fn states(states: usize) -> Range<'static> {
    let least = if states == 0 { 0.0 } else { 2.0 };
    ("states", states as f64, least, 64.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::AgentConfig;

    #[test]
    fn the_autoencoders_step_size_falls_faster_than_the_dqns() {
        let AgentConfig {
            autoencoder, dqn, ..
        } = AgentConfig::default();
        let quotient = |n: u64| autoencoder.step_size.at(n) / dqn.step_size.at(n);
        assert!((quotient(0) - 0.01).abs() < 1e-9);
        let quotients = [0, 5_000, 50_000, 500_000, 500_000_000].map(quotient);
        assert!(quotients.is_sorted_by(|a, b| a > b), "{quotients:?}");
        assert!(quotients[4] < 0.04 * quotients[0]);
        let paper = AgentConfig::paper();
        assert_eq!(paper.autoencoder.step_size.at(1_000_000), 1e-4);
        assert_eq!(paper.autoencoder.settings(), AutoencoderSettings::paper());
        assert_eq!(paper.dqn.settings(), DqnSettings::paper());
    }

    #[test]
    fn the_step_size_is_constant_falls_and_is_constant_again() {
        let config = LearningConfig {
            steady_updates: 10,
            falling_updates: 10,
            final_rate: 0.1,
            ..AgentConfig::default().learning
        };
        let at = [0, 10, 15, 19, 1000].map(|update| config.rate_at(update));
        assert_eq!(at[..3], [1.0, 1.0, 0.5]);
        assert!((at[3] - 0.1).abs() < 1e-12 && at[4] == 0.1, "{at:?}");
    }
}
