//! The command line: subcommands, logging, threads, exit codes.

use crate::commands;
use crate::process::set_up_process;
use clap::{Parser, Subcommand};
use emberwatch_acting::policy;
use emberwatch_protocol::limits::threads::NoThreads;
use emberwatch_protocol::program::{parse_flags, start_logging};
use rayon::ThreadPoolBuilder;
use std::process::ExitCode;

/// Estimates hidden states, plans paths and acts on an Emberwatch server.
#[derive(Parser)]
#[command(name = "emberwatch-agent", version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Act on one world of a running server
    #[command(after_long_help = policy::help())]
    Run(commands::RunCommand),
    /// Compare policies on the same worlds, with a table, CSV and figures
    #[command(after_long_help = policy::help())]
    Compare(commands::CompareCommand),
    /// Run policies on the test worlds of tasks, with one score per policy
    #[command(after_long_help = policy::help())]
    Suite(commands::SuiteCommand),
    /// Add an entry to the leaderboard and rebuild its page
    Leaderboard(commands::LeaderboardCommand),
    /// Learn a model while acting, with checkpoints and metrics
    Train(commands::TrainCommand),
}

/// Parses the arguments, runs the subcommand, and returns the exit code.
pub fn main() -> ExitCode {
    set_up_process();
    let command = parse_flags::<Cli>().command;
    let _log = start_logging();
    if let Err(error) = start_threads() {
        tracing::error!("{error}");
        return ExitCode::FAILURE;
    }
    let result = match &command {
        Command::Run(command) => command.run(),
        Command::Compare(command) => command.run(),
        Command::Suite(command) => command.run(),
        Command::Leaderboard(command) => command.run(),
        Command::Train(command) => command.run(),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            tracing::error!("{error:#}");
            commands::exit_code(&error)
        }
    }
}

/// Starts rayon's global threads now, so that a failure is returned as an error. At first use, a failure would panic.
fn start_threads() -> Result<(), NoThreads> {
    let n_threads = std::thread::available_parallelism().map_or(1, usize::from);
    let started = ThreadPoolBuilder::new().build_global();
    started.map_err(|error| NoThreads::new(n_threads, &error))
}
