//! Settings of what learns the model: the section `[learning]` of `config/agent.toml`.

use crate::config::error::ConfigError;
use serde::{Deserialize, Serialize};

/// How the learned filter learns.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LearningConfig {
    /// Number of states S, 2 to 64; 0: as many as there are observations.
    pub states: usize,
    /// Rows and columns of the kernel, odd.
    pub kernel: [usize; 2],
    /// Frames of a truncated window, 1 to 1,024.
    pub window: usize,
    /// Windows of an update, 1 to 1,024.
    pub streams: usize,
    /// Windows of a block of the replay, 1 to 1,024.
    pub block_windows: usize,
    /// Frames that the replay keeps, of all worlds together.
    pub replay_frames: usize,
    /// Adam's step size for the kernel.
    pub rate: f64,
    /// Step size of observation matrix and first belief, as a share of the kernel's.
    pub observation_rate: f64,
    /// Adam's decay of the mean of gradients.
    pub beta1: f64,
    /// Adam's decay of the mean of their squares.
    pub beta2: f64,
    /// Updates before the step size begins to fall.
    pub steady_updates: u64,
    /// Updates over which it falls linearly.
    pub falling_updates: u64,
    pub final_rate: f64,
    pub updates_per_step: f64,
    /// Weight of the prior that the state that pays most is seen almost surely, in cells per cell.
    pub anchor: f64,
    /// World steps, of all worlds together, flown at random before planning on the learned belief.
    pub explore_steps: u64,
    /// Share of the worlds that go on walking at random.
    pub explore_share: f64,
}

impl Default for LearningConfig {
    fn default() -> Self {
        Self {
            states: 0,
            kernel: [3, 3],
            window: 16,
            streams: 16,
            block_windows: 4,
            replay_frames: 16_384,
            rate: 0.05,
            observation_rate: 0.2,
            beta1: 0.9,
            beta2: 0.99,
            steady_updates: 2_000,
            falling_updates: 3_000,
            final_rate: 0.05,
            updates_per_step: 0.5,
            anchor: 0.001,
            explore_steps: 4_000,
            explore_share: 0.25,
        }
    }
}

impl LearningConfig {
    /// Checks every setting.
    pub fn check(&self) -> Result<(), ConfigError> {
        let sizes = [
            ("learning.window", self.window, 1, 1024),
            ("learning.streams", self.streams, 1, 1024),
            ("learning.block_windows", self.block_windows, 1, 1024),
            ("learning.replay_frames", self.replay_frames, 1, 1 << 24),
            ("learning.states", self.states, 0, 64),
        ];
        for (setting, got, least, most) in sizes {
            if !(least..=most).contains(&got) || (setting == "learning.states" && got == 1) {
                return Err(ConfigError::Range {
                    setting,
                    least,
                    most,
                    got,
                });
            }
        }
        let numbers = [
            ("learning.rate", self.rate, 1.0),
            ("learning.observation_rate", self.observation_rate, 100.0),
            ("learning.beta1", self.beta1, 0.999_999),
            ("learning.beta2", self.beta2, 0.999_999),
            ("learning.final_rate", self.final_rate, 1.0),
            ("learning.updates_per_step", self.updates_per_step, 1000.0),
            ("learning.anchor", self.anchor, 1000.0),
            ("learning.explore_share", self.explore_share, 1.0),
        ];
        for (setting, got, most) in numbers {
            if !(0.0..=most).contains(&got) {
                return Err(ConfigError::Number { setting, most, got });
            }
        }
        Ok(())
    }

    /// Share of the step size at an update: 1, then falling linearly to `final_rate`.
    pub fn rate_at(&self, update: u64) -> f64 {
        let fallen = update.saturating_sub(self.steady_updates) as f64;
        let share = 1.0 - fallen / self.falling_updates.max(1) as f64;
        share.max(self.final_rate)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_step_size_stays_falls_and_stays() {
        let config = LearningConfig {
            steady_updates: 10,
            falling_updates: 10,
            final_rate: 0.1,
            ..LearningConfig::default()
        };
        let at = [0, 10, 15, 19, 1000].map(|update| config.rate_at(update));
        assert_eq!(at[..3], [1.0, 1.0, 0.5]);
        assert!((at[3] - 0.1).abs() < 1e-12 && at[4] == 0.1, "{at:?}");
    }

    #[test]
    fn wrong_settings_are_named() {
        let check = |change: fn(&mut LearningConfig), words: &str| {
            let mut config = LearningConfig::default();
            change(&mut config);
            let error = config.check().expect_err(words).to_string();
            assert_eq!(error, words);
        };
        check(
            |c| c.streams = 0,
            "learning.streams: expected 1 to 1024, got 0",
        );
        check(
            |c| c.rate = f64::NAN,
            "learning.rate: expected 0 to 1, got NaN",
        );
        check(
            |c| c.beta1 = 1.0,
            "learning.beta1: expected 0 to 0.999999, got 1",
        );
        assert!(LearningConfig::default().check().is_ok());
    }
}
