//! What a comparison of policies looks like: a table, a CSV file and figures.
//!
//! Everything here turns finished [`PolicyRun`]s into text or a file; nothing here runs a policy.
//! Read [`statistics`] first, then [`table`] and [`figures`]. [`training`] turns metrics into curves.

pub mod events;
pub mod figures;
mod number;
mod policy_run;
mod rewards;
pub mod statistics;
pub mod table;
pub mod training;

pub use self::events::write_events;
pub use self::figures::{Snapshot, draw_ladder, draw_rewards, draw_snapshot, save};
pub use self::policy_run::{PolicyRun, write_csv};
pub use self::table::render_table;
