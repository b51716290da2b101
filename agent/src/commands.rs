//! The subcommands: flags in, library calls, files and tables out.

mod compare;
mod evaluate;
mod leaderboard;
mod prior;
mod run;
mod shared;
mod suite;
mod train;
mod trainings;
mod worlds;

pub use compare::CompareCommand;
pub use evaluate::EvaluateCommand;
pub use leaderboard::LeaderboardCommand;
pub use prior::PriorCommand;
pub use run::RunCommand;
pub use suite::SuiteCommand;
pub use train::TrainCommand;

use crate::client::errors::refusal;
use emberwatch_protocol::message::Status;
use std::process::ExitCode;

/// Exit code of a run whose lease was lost.
const LEASE_LOST: u8 = 3;

/// Where results go wrong for a reason that callers may want to tell apart, a code of its own.
pub fn exit_code(error: &anyhow::Error) -> ExitCode {
    match refusal(error) {
        Some((Status::LeaseLost, ..)) => LEASE_LOST.into(),
        _ => ExitCode::FAILURE,
    }
}
