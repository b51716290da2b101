//! Settings of what learns to choose among actions: the section `[decisions]` of `config/agent.toml`.

use crate::config::error::ConfigError;
use ::network::{AdamSettings, DqnSettings};
use serde::{Deserialize, Serialize};

/// How the DQN of `train --learner decisions` learns.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DecisionsConfig {
    /// Transitions that the replay keeps, 1 to 200,000, at least a batch.
    pub replay: usize,
    /// Transitions of an update, 1 to 65,536.
    pub batch: usize,
    /// Discount per step, 0 to 1.
    pub gamma: f32,
    /// Steps whose rewards a transition adds up, 1 to 64.
    pub n_step: usize,
    /// Factor on rewards, 0 to 1000.
    pub reward_scale: f32,
    /// Updates per world step, 0 to 16.
    pub updates_per_step: f64,
    /// Share of the network in its target after each update, 0 to 1.
    pub tau: f32,
    /// Chance of a random action at the first step, 0 to 1.
    pub epsilon: f32,
    /// Chance of a random action in the end, 0 to 1.
    pub epsilon_end: f32,
    /// World steps from the one to the other, in a straight line.
    pub epsilon_steps: u64,
    /// Double DQN: the network picks the action whose value its target gives.
    pub double: bool,
    /// Adam's step size, 0 to 1.
    pub rate: f32,
}

impl Default for DecisionsConfig {
    fn default() -> Self {
        Self {
            replay: 50_000,
            batch: 64,
            gamma: 0.95,
            n_step: 4,
            reward_scale: 0.1,
            updates_per_step: 0.25,
            tau: 0.005,
            epsilon: 1.0,
            epsilon_end: 0.1,
            epsilon_steps: 40_000,
            double: true,
            rate: 5e-4,
        }
    }
}

impl DecisionsConfig {
    /// Checks every setting.
    pub fn check(&self) -> Result<(), ConfigError> {
        let ranges = [
            ("decisions.batch", self.batch, 1, 65_536),
            ("decisions.replay", self.replay, self.batch, 200_000),
            ("decisions.n_step", self.n_step, 1, 64),
        ];
        for (setting, got, least, most) in ranges {
            if !(least..=most).contains(&got) {
                return Err(ConfigError::Range {
                    setting,
                    least,
                    most,
                    got,
                });
            }
        }
        let numbers = [
            ("decisions.gamma", f64::from(self.gamma), 1.0),
            ("decisions.reward_scale", f64::from(self.reward_scale), 1e3),
            ("decisions.updates_per_step", self.updates_per_step, 16.0),
            ("decisions.tau", f64::from(self.tau), 1.0),
            ("decisions.epsilon", f64::from(self.epsilon), 1.0),
            ("decisions.epsilon_end", f64::from(self.epsilon_end), 1.0),
            ("decisions.rate", f64::from(self.rate), 1.0),
        ];
        let wrong = |(_, got, most): &&(&str, f64, f64)| !(0.0..=*most).contains(got);
        match numbers.iter().find(wrong) {
            None => Ok(()),
            Some(&(setting, got, most)) => Err(ConfigError::Number { setting, most, got }),
        }
    }

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
                learning_rate: self.rate,
                ..paper.adam
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrong_settings_are_named() {
        let check = |change: fn(&mut DecisionsConfig), words: &str| {
            let mut config = DecisionsConfig::default();
            change(&mut config);
            let error = config.check().expect_err(words).to_string();
            assert_eq!(error, words);
        };
        check(
            |c| c.n_step = 0,
            "decisions.n_step: expected 1 to 64, got 0",
        );
        check(
            |c| c.replay = 8,
            "decisions.replay: expected 64 to 200000, got 8",
        );
        check(
            |c| c.gamma = 1.5,
            "decisions.gamma: expected 0 to 1, got 1.5",
        );
        check(
            |c| c.rate = f32::NAN,
            "decisions.rate: expected 0 to 1, got NaN",
        );
    }
}
