//! Reports of a comparison of policies: a table, a CSV file and figures.
//!
//! Everything here turns finished [`PolicyRun`]s into text or a file; nothing here runs a policy.
//! Read `statistics` first, then `table` and [`figures`]. [`training`] turns metrics into curves.

mod columns;
pub mod common_worlds;
pub mod figures;
pub mod leaderboard;
pub mod leaderboard_chart;
mod merit;
mod number;
mod policy_run;
mod rewards;
pub mod runs_file;
pub(crate) mod statistics;
pub mod suite;
pub(crate) mod table;
mod teams;
pub mod training;

pub use self::figures::{draw_ladder, draw_rewards, draw_teams, save};
pub use self::policy_run::{PolicyRun, groups};
pub use self::table::render_table;
