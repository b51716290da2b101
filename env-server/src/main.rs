//! `emberwatch-server`: reads settings, starts logging, serves.

mod commands;

use anyhow::{Context, Result};
use clap::{Parser, Subcommand};
use env_server::config::ServerFlags;
use env_server::server::serve;
use protocol::program::{start_logging, stop_on_signals};
use std::process::ExitCode;

/// Simulates worlds and serves them to agents over shared memory.
#[derive(Parser)]
#[command(
    name = "emberwatch-server",
    version,
    args_conflicts_with_subcommands = true
)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    flags: ServerFlags,
    /// Check the settings, print the effective ones as TOML, and end
    #[arg(long)]
    check: bool,
    /// End when this process ends
    #[arg(long, value_name = "PID")]
    exit_with: Option<i32>,
}

#[derive(Subcommand)]
enum Command {
    /// Ask a running server what is going on
    Status(commands::StatusCommand),
    /// Stop a running server
    Stop(commands::StopCommand),
    /// Write worlds of a running server to a file
    Snapshot(commands::SnapshotCommand),
    /// Put the worlds of a file in the place of a running server's
    Restore(commands::RestoreCommand),
    /// Put a copy of one world of a running server in the place of another
    Fork(commands::ForkCommand),
    /// Observe an instance and write what is published to a file
    Record(commands::RecordCommand),
    /// Publish a recording as its server did
    Replay(commands::ReplayCommand),
}

fn main() -> ExitCode {
    start_logging();
    match run(&Cli::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            tracing::error!("{error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(cli: &Cli) -> Result<()> {
    match &cli.command {
        Some(Command::Status(command)) => command.run(),
        Some(Command::Stop(command)) => command.run(),
        Some(Command::Snapshot(command)) => command.run(),
        Some(Command::Restore(command)) => command.run(),
        Some(Command::Fork(command)) => command.run(),
        Some(Command::Record(command)) => command.run(),
        Some(Command::Replay(command)) => command.run(),
        None => {
            let checked = cli.flags.effective()?.check()?;
            if cli.check {
                return commands::print(&toml::to_string(&checked.config)?);
            }
            Ok(serve(
                checked,
                &stop_on_signals().context("handle signals")?,
                cli.exit_with,
            )?)
        }
    }
}
