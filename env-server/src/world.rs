//! One world with its robots; pure.

mod episode;
mod flown;
mod hidden;
mod history;
mod recorded;
mod reward;
mod robot;
mod rules;
mod saved;
mod sensor;

pub use episode::Episode;
pub use flown::Flown;
pub use hidden::{Source, World};
pub use history::{PastRobot, PastStep};
pub use recorded::Recorded;
pub use robot::Robot;
pub use rules::{Rules, check_start};
pub use saved::{InvalidWorld, SavedRobot, SavedWorld};
