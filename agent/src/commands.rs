//! The subcommands: they parse flags, call the library, and write files and tables.

mod compare;
mod leaderboard;
mod run;
mod shared;
mod suite;
mod train;
mod trainings;
mod worlds;

pub use compare::CompareCommand;
pub use leaderboard::LeaderboardCommand;
pub use run::RunCommand;
pub use suite::SuiteCommand;
pub use train::TrainCommand;

use crate::client::errors::refusal;
use emberwatch_protocol::message::Status;
use std::process::ExitCode;

const LEASE_LOST: u8 = 3;

/// Returns the exit code for an error. A lost lease has a separate code, so that callers can recognise it.
pub fn exit_code(error: &anyhow::Error) -> ExitCode {
    match refusal(error) {
        Some((Status::LeaseLost, ..)) => LEASE_LOST.into(),
        _ => ExitCode::FAILURE,
    }
}
