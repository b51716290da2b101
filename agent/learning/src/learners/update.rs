//! Reports of model updates.

/// The report of an update, or of a step without an update.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelUpdate {
    /// Number of the model's updates so far.
    pub number: u64,
    /// The model's loss before the update, if the model was updated.
    pub loss: Option<f64>,
    /// The model's step size, if it was updated.
    pub rate: Option<f64>,
    /// The values named by [`super::LearnerKind::columns`].
    pub more: Vec<Option<f64>>,
}

impl ModelUpdate {
    /// Creates the report of a step without an update, with `n_more` empty columns.
    pub fn nothing(number: u64, n_more: usize) -> Self {
        Self {
            number,
            loss: None,
            rate: None,
            more: vec![None; n_more],
        }
    }
}
