//! One world with its robots, without I/O and without a clock.

mod episode;
mod flown;
mod hidden;
mod history;
mod outcome;
mod recorded;
mod reward;
mod robot;
mod rules;
mod saved;
mod sensor;
mod starts;

pub use episode::Episode;
pub use flown::Flown;
pub use hidden::{Source, World};
pub use history::{MIN_HISTORY_BYTES, PastRobot, PastStep, bytes_of_history};
pub use outcome::{RobotOutcome, WorldOutcome};
pub use recorded::Recorded;
pub use robot::{Robot, bytes_of_robot};
pub use rules::{Rules, most_seen};
pub use saved::{InvalidWorld, SavedRobot, SavedWorld};
pub use starts::{ClosedIn, Reach};
