//! What learns a model while an agent acts: replay in, parameters out. Pure.

mod neighbours;
mod online;
mod saved;

pub use self::neighbours::Neighbours;
pub use self::online::{KIND, LearnedModel, Learner, Progress};
pub use self::saved::SavedLearner;
