//! What a step of training reports: the step of the worlds, and each update of the model.

use emberwatch_belief::estimation::scoring::Score;

#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Tick {
    /// World steps so far, of all worlds together.
    pub world_steps: u64,
    pub n_worlds: u64,
    /// Sum of their rewards.
    pub reward: f64,
    /// How well their frames were predicted before anything was learned from them.
    pub score: Score,
}

#[derive(Debug, Clone, PartialEq)]
pub struct ModelUpdate {
    /// Number of updates of the model so far.
    pub number: u64,
    /// The model's loss before it, if the model was updated.
    pub loss: Option<f64>,
    /// The model's step size, if it was updated.
    pub rate: Option<f64>,
    /// What [`crate::learners::Learner::columns`] names.
    pub more: Vec<Option<f64>>,
}

impl ModelUpdate {
    /// No update, after so many; `n_more`: length of [`crate::learners::Learner::columns`].
    pub fn nothing(number: u64, n_more: usize) -> Self {
        Self {
            number,
            loss: None,
            rate: None,
            more: vec![None; n_more],
        }
    }
}
