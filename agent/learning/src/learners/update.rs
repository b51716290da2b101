//! What an update of a model reports.

/// An update, or that there was none.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelUpdate {
    /// Number of updates of the model so far.
    pub number: u64,
    /// The model's loss before it, if the model was updated.
    pub loss: Option<f64>,
    /// The model's step size, if it was updated.
    pub rate: Option<f64>,
    /// What [`super::LearnerKind::columns`] names.
    pub more: Vec<Option<f64>>,
}

impl ModelUpdate {
    /// No update, after so many; `n_more`: length of [`super::LearnerKind::columns`].
    pub fn nothing(number: u64, n_more: usize) -> Self {
        Self {
            number,
            loss: None,
            rate: None,
            more: vec![None; n_more],
        }
    }
}
