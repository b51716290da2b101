//! What Algorithm 1 has learned, which can be saved to a checkpoint and loaded again.

use crate::checkpoint::{Contents, check, check_counts};
use crate::reward::RewardEstimate;
use anyhow::Result;
use emberwatch_acting::beliefs::WorldForm;
use emberwatch_acting::beliefs::autoencoder::AutoencoderModel;
use emberwatch_acting::config::AgentConfig;
use emberwatch_acting::policy::network_choices;
use emberwatch_model::{MAX_VALUES, Shape};
use emberwatch_network::{Autoencoder, Device, Dqn, DqnShape, NetworkError, NetworkShape};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The learned networks and estimates. Estimators contain copies of the autoencoder.
pub struct Progress {
    pub autoencoder: Autoencoder,
    pub dqn: Dqn,
    pub reward: RewardEstimate,
    pub iterations: u64,
}

/// A checkpoint of Algorithm 1, without its tensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedNetwork {
    pub shape: Shape,
    /// Number of observation values.
    pub n_observations: usize,
    /// The number of the autoencoder's Adam steps, and the number of its updates.
    pub counters: [u64; 2],
    /// Number of the DQN's updates.
    pub n_dqn_updates: u64,
    pub reward: RewardEstimate,
    pub iterations: u64,
}

impl Progress {
    /// Creates the progress before the first frame. The autoencoder computes on `device`.
    pub fn first(
        form: &WorldForm,
        config: &AgentConfig,
        device: &Device,
    ) -> Result<Self, NetworkError> {
        let shape = network_shape(form, config);
        let (settings, n_states) = (config.autoencoder.settings(), shape.n_states);
        let n_actions = network_choices(n_states).len();
        let actions = DqnShape::of_actions(settings.hidden, n_actions);
        Ok(Self {
            autoencoder: Autoencoder::new(settings, shape, config.seed, device)?,
            dqn: Dqn::new(config.dqn.settings(), actions, config.seed),
            reward: RewardEstimate::new(n_states),
            iterations: 0,
        })
    }

    /// Returns the state with the highest estimated reward, or the last state before any reward.
    pub fn target(&self) -> usize {
        self.reward
            .target()
            .unwrap_or(self.reward.rewards.len() - 1)
    }

    /// Returns the contents of a checkpoint without its settings.
    pub fn contents(&self) -> Result<Contents, NetworkError> {
        let shape = self.autoencoder.shape();
        let state = SavedNetwork {
            shape: shape.grid,
            n_observations: shape.n_observations,
            counters: self.autoencoder.counters(),
            n_dqn_updates: self.dqn.n_updates(),
            reward: self.reward.clone(),
            iterations: self.iterations,
        };
        let mut tensors = self.autoencoder.named_tensors()?;
        tensors.extend(self.dqn.named_tensors());
        Ok(Contents::new(tensors, &state))
    }

    /// Loads a checkpoint with the settings stored in it. The autoencoder computes on `device`.
    pub fn read(contents: &Contents, device: &Device) -> Result<Self> {
        let config = contents.settings()?;
        let saved: SavedNetwork = contents.state()?;
        let form = WorldForm {
            shape: saved.shape,
            n_observations: saved.n_observations,
        };
        let (fits, expected) = (1..=MAX_VALUES, format!("1 to {MAX_VALUES}"));
        let fits = fits.contains(&form.n_observations);
        check(fits, "n_observations", expected, form.n_observations)?;
        // A small file must not exhaust memory.
        for (name, shape) in network_shape(&form, &config).grid_tensors() {
            contents.tensor(name, &shape)?;
        }
        let mut progress = Self::first(&form, &config, device)?;
        progress.load(contents)?;
        Ok(progress)
    }

    /// Extracts the model that policies use.
    pub fn into_model(self) -> AutoencoderModel {
        AutoencoderModel {
            target: self.target(),
            autoencoder: self.autoencoder,
            dqn: Arc::new(self.dqn),
        }
    }

    /// Loads a checkpoint whose networks have the same sizes.
    pub fn load(&mut self, contents: &Contents) -> Result<()> {
        let saved: SavedNetwork = contents.state()?;
        check_counts(&[
            ("adam_steps", saved.counters[0]),
            ("updates", saved.counters[1]),
            ("n_dqn_updates", saved.n_dqn_updates),
            ("iterations", saved.iterations),
        ])?;
        contents.check_squares()?;
        saved.reward.check(self.autoencoder.shape().n_states)?;
        let find = |name: &str, shape: &[usize]| contents.tensor(name, shape);
        self.autoencoder.load(find, saved.counters)?;
        self.dqn.load(find, saved.n_dqn_updates)?;
        (self.reward, self.iterations) = (saved.reward, saved.iterations);
        Ok(())
    }
}

fn network_shape(form: &WorldForm, config: &AgentConfig) -> NetworkShape {
    let settings = config.autoencoder.settings();
    NetworkShape {
        grid: form.shape,
        n_states: match config.autoencoder.states {
            0 => form.n_observations,
            states => states,
        },
        n_observations: form.n_observations,
        encoding: settings.encoding,
        hidden: settings.hidden,
    }
}
