//! The progress of Algorithm 1, which can be saved to a checkpoint and loaded again.

use crate::beliefs::autoencoder::{AutoencoderModel, Follower};
use crate::checkpoint::{Contents, check, check_belief, check_counts, check_numbers, wrong};
use crate::config::AgentConfig;
use crate::learners::base::{Place, Worlds, place};
use crate::policy::network_choices;
use crate::reward::RewardEstimate;
use crate::rollout::Rollout;
use anyhow::Result;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::planning::BasisKind;
use emberwatch_model::MAX_VALUES;
use emberwatch_model::{Airspace, Frame, Shape};
use emberwatch_network::{
    Autoencoder, Device, Dqn, DqnShape, FrameReplay, NetworkError, NetworkShape, SavedDqn, Track,
};
use serde::{Deserialize, Serialize};

/// The learned networks and the state of learning. Estimators contain copies of the autoencoder.
#[derive(Debug)]
pub struct Progress {
    pub autoencoder: Autoencoder,
    pub dqn: Dqn,
    /// The belief that paths are planned on while the DQN learns.
    pub basis: BasisKind,
    /// The frames for training.
    pub replay: FrameReplay,
    pub position: Position,
}

/// The state of Algorithm 1 in its world.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Position {
    pub follower: Follower,
    /// The saved estimate, if paths are planned on it.
    pub estimate: Option<Belief>,
    /// The latest steps, whose transitions are not yet in the DQN's replay buffer.
    pub track: Track,
    pub reward: RewardEstimate,
    pub iterations: u64,
    /// World, step and cell of the last frame that the hidden vector depends on, if any.
    pub place: Option<Place>,
}

/// A checkpoint of Algorithm 1, without its tensors.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct SavedNetwork {
    pub shape: Shape,
    /// Number of observation values.
    pub n_observations: usize,
    /// The number of the autoencoder's Adam steps, and the number of its updates.
    pub counters: [u64; 2],
    pub dqn: SavedDqn,
    /// The frames of the replay buffer, oldest first.
    pub frames: Vec<Vec<u8>>,
    /// Index of the first frame of each track except the oldest.
    pub tracks: Vec<u64>,
    pub position: Position,
}

impl Progress {
    /// Creates the progress before the first frame. The autoencoder computes on `device`.
    pub fn first(
        worlds: &Worlds,
        config: &AgentConfig,
        device: &Device,
    ) -> Result<Self, NetworkError> {
        let shape = network_shape(worlds.shape(), worlds.n_observations, config);
        let (settings, n_states) = (config.autoencoder.settings(), shape.n_states);
        let autoencoder = Autoencoder::new(settings, shape, config.seed, device)?;
        let n_actions = network_choices(n_states).len();
        let actions = DqnShape::of_actions(settings.hidden, n_actions);
        let dqn = Dqn::new(config.dqn.settings(), actions, config.seed);
        let position = Position {
            follower: Follower::new(&autoencoder)?,
            estimate: None,
            track: dqn.track(),
            reward: RewardEstimate::new(n_states),
            iterations: 0,
            place: None,
        };
        Ok(Self {
            autoencoder,
            dqn,
            basis: config.objective.belief,
            replay: FrameReplay::new(settings.replay),
            position,
        })
    }

    /// Returns the state with the highest estimated reward, or the last state before any reward.
    pub fn target(&self) -> usize {
        let reward = &self.position.reward;
        reward.target().unwrap_or(reward.rewards.len() - 1)
    }

    /// Returns the contents of a checkpoint without its settings. `rollout` provides the network's current recurrent
    /// state and the robot's position.
    pub fn to_contents(&self, rollout: &Rollout) -> Result<Contents, NetworkError> {
        let shape = self.autoencoder.shape();
        let frames = self.replay.frames();
        let state = SavedNetwork {
            shape: shape.grid,
            n_observations: shape.n_observations,
            counters: self.autoencoder.counters(),
            dqn: self.dqn.saved(),
            frames: frames.map(|frame| frame.as_bytes().to_vec()).collect(),
            tracks: self.replay.tracks().collect(),
            position: Position {
                follower: follower(rollout),
                estimate: rollout.agent.estimate().cloned(),
                place: Some(place(rollout.observation())),
                ..self.position.clone()
            },
        };
        let mut tensors = self.autoencoder.named_tensors()?;
        tensors.extend(self.dqn.named_tensors());
        Ok(Contents::new(tensors, &state))
    }

    /// Loads a checkpoint with the settings stored in it. The autoencoder computes on `device`.
    pub fn read(contents: &Contents, device: &Device) -> Result<Self> {
        let config = contents.settings()?;
        let saved: SavedNetwork = contents.state()?;
        let (shape, n_observations) = (saved.shape, saved.n_observations);
        let (fits, expected) = (1..=MAX_VALUES, format!("1 to {MAX_VALUES}"));
        let fits = fits.contains(&n_observations);
        check(fits, "n_observations", expected, n_observations)?;
        let sizes = network_shape(shape, n_observations, &config);
        check_size(contents, &sizes)?;
        let prediction = saved.position.follower.prediction();
        check_belief("prediction", prediction, sizes.n_states, shape)?;
        let worlds = Worlds {
            airspace: Airspace::open(shape),
            n_observations,
            n_moves: 0,
            numbers: 0..1,
        };
        let mut progress = Self::first(&worlds, &config, device)?;
        progress.load(contents)?;
        Ok(progress)
    }

    /// Extracts the model that policies use.
    pub fn into_model(self) -> AutoencoderModel {
        AutoencoderModel {
            target: self.target(),
            autoencoder: self.autoencoder,
            dqn: self.dqn,
            basis: self.basis,
        }
    }

    /// Loads a checkpoint whose networks have the same sizes.
    pub fn load(&mut self, contents: &Contents) -> Result<()> {
        let saved: SavedNetwork = contents.state()?;
        let (mut position, n_updates) = (saved.position, saved.dqn.n_updates);
        check_counts(&[
            ("adam_steps", saved.counters[0]),
            ("updates", saved.counters[1]),
            ("dqn.n_updates", n_updates),
            ("iterations", position.iterations),
        ])?;
        contents.check_squares()?;
        let find = |name: &str, shape: &[usize]| contents.tensor(name, shape);
        self.autoencoder.load(find, saved.counters)?;
        self.dqn.load(find, &saved.dqn)?;
        self.load_replay(&saved.frames, &saved.tracks)?;
        let NetworkShape {
            grid,
            n_states,
            hidden,
            ..
        } = *self.autoencoder.shape();
        check_numbers("hidden", position.follower.hidden(), hidden)?;
        let prediction = position.follower.prediction();
        check_belief("prediction", prediction, n_states, grid)?;
        let mut estimate = position.estimate.iter();
        estimate.try_for_each(|estimate| check_belief("estimate", estimate, n_states, grid))?;
        position.reward.check(n_states)?;
        position.track = self.dqn.resume_track(position.track)?;
        self.position = position;
        Ok(())
    }

    fn load_replay(&mut self, frames: &[Vec<u8>], tracks: &[u64]) -> Result<()> {
        let shape = self.autoencoder.shape();
        let mut tracks = tracks.iter().peekable();
        for (index, bytes) in (0..).zip(frames) {
            if tracks.next_if_eq(&&index).is_some() {
                self.replay.begin();
            }
            let frame = Frame::from_bytes(shape.grid, shape.n_observations, bytes);
            let misfit = |error| wrong("frames", "frames of these worlds", error);
            self.replay.push(frame.map_err(misfit)?);
        }
        Ok(())
    }
}

/// Returns the recurrent state of an agent's network after a prediction.
pub(super) fn follower(rollout: &Rollout) -> Follower {
    let (agent, hidden) = (&rollout.agent, rollout.agent.estimator().hidden());
    let hidden = hidden.expect("invariant: its estimator is an autoencoder");
    Follower::at(hidden.to_vec(), agent.belief().clone())
}

fn network_shape(grid: Shape, n_observations: usize, config: &AgentConfig) -> NetworkShape {
    let settings = config.autoencoder.settings();
    NetworkShape {
        grid,
        n_states: match config.autoencoder.states {
            0 => n_observations,
            states => states,
        },
        n_observations,
        encoding: settings.encoding,
        hidden: settings.hidden,
    }
}

/// Checks that the file contains enough values for the sizes that it declares. Without this check, a small file could
/// exhaust memory.
fn check_size(contents: &Contents, shape: &NetworkShape) -> Result<()> {
    let expected = shape.n_numbers();
    let tensors = contents.tensors.values();
    let got: usize = tensors.map(|tensor| tensor.numbers.len()).sum();
    let words = format!(
        "at least {expected} numbers for a network on a {} grid",
        shape.grid
    );
    check(got >= expected, "tensors", words, got)
}
