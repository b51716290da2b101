//! Checkpoints of learned filters.

use crate::models::SavedModel;
use crate::reward::RewardEstimate;
use serde::{Deserialize, Serialize};

/// A checkpoint of a learned filter, without its tensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedFilter {
    pub model: SavedModel,
    pub reward: RewardEstimate,
    pub n_updates: u64,
    /// Number of world steps, for all worlds together.
    pub world_steps: u64,
}
