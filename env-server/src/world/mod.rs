//! One world with a robot in it; pure.

mod episode;
mod hidden;
mod history;
mod rules;
mod saved;
mod sensor;

pub use episode::Episode;
pub use hidden::World;
pub use history::PastStep;
pub use rules::{Rules, Start};
pub use saved::{InvalidWorld, SavedWorld};
