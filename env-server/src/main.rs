//! The program `emberwatch-server`.

mod commands;

use anyhow::{Context, Result};
use clap::{Parser, Subcommand};
use emberwatch_protocol::program::{Flags, parse_flags, print, start_logging, stop_on_signals};
use emberwatch_server::server::{announce_settings, serve};
use emberwatch_sim::config::ServerConfig;
use std::path::PathBuf;
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
    /// Read settings from this TOML file, which flags override
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    #[command(flatten)]
    settings: Flags<ServerConfig>,
    /// Check the settings, print the effective ones as TOML, and exit
    #[arg(long)]
    check: bool,
    /// Exit when the process with this id ends
    #[arg(long, value_name = "PID")]
    exit_with: Option<i32>,
}

#[derive(Subcommand)]
enum Command {
    /// Print the state of a running server
    Status(commands::StatusCommand),
    /// Stop a running server
    Stop(commands::StopCommand),
    /// Write worlds of a running server to a file
    Snapshot(commands::SnapshotCommand),
    /// Replace worlds of a running server with worlds from a file
    Restore(commands::RestoreCommand),
    /// Replace a world of a running server with a copy of another world
    Fork(commands::ForkCommand),
    /// Record the frames that an instance publishes to a file
    Record(commands::RecordCommand),
}

fn main() -> ExitCode {
    let cli: Cli = parse_flags();
    let _log = start_logging();
    match run(&cli) {
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
        None => {
            let config = cli.config.as_deref().map(ServerConfig::read);
            let config = config.transpose()?.unwrap_or_default();
            let checked = config.with(cli.settings.given())?.check()?;
            if cli.check {
                if checked.recorded.is_none() {
                    tracing::info!("{}", checked.about_model());
                }
                announce_settings(&checked);
                return Ok(print(&toml::to_string(&checked.config)?)?);
            }
            let stop = stop_on_signals().context("handle signals")?;
            serve(checked, &stop, cli.exit_with)
        }
    }
}
