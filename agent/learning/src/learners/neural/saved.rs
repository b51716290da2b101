//! Checkpoints of neural beliefs.

use crate::models::SavedNeuralModel;
use crate::reward::RewardEstimate;
use serde::{Deserialize, Serialize};

/// A checkpoint of a neural belief, without its tensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedNeural {
    pub model: SavedNeuralModel,
    pub reward: RewardEstimate,
    pub n_updates: u64,
    /// Number of world steps, for all worlds together.
    pub world_steps: u64,
}
