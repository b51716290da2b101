//! `emberwatch-server`: reads settings, starts logging, serves.

mod commands;

use anyhow::{Context, Result};
use clap::{Args, Parser, Subcommand};
use env_server::config::ServerFlags;
use env_server::server::serve;
use protocol::Connection;
use protocol::channels::Instance;
use protocol::control::{Reply, Request, ServerStatus};
use protocol::program::{start_logging, stop_on_signals};
use std::process::ExitCode;
use std::time::Duration;

/// How long `status` and `stop` wait for the server.
const TIMEOUT: Duration = Duration::from_secs(5);

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
    Status(Target),
    /// Stop a running server
    Stop(Target),
    /// Write worlds of a running server to a file
    Snapshot(commands::SnapshotCommand),
    /// Put the worlds of a file in the place of a running server's
    Restore(commands::RestoreCommand),
    /// Put a copy of one world of a running server in the place of another
    Fork(commands::ForkCommand),
}

#[derive(Args)]
struct Target {
    /// The server's instance name
    #[arg(long, default_value = "default")]
    instance: String,
    /// Print JSON
    #[arg(long)]
    json: bool,
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
        Some(Command::Status(target)) => show_status(target),
        Some(Command::Stop(target)) => ask(target, &Request::Shutdown {}).map(|_| ()),
        Some(Command::Snapshot(command)) => command.run(),
        Some(Command::Restore(command)) => command.run(),
        Some(Command::Fork(command)) => command.run(),
        None => {
            let checked = cli.flags.effective()?.check()?;
            if cli.check {
                return print(&toml::to_string(&checked.config)?);
            }
            Ok(serve(
                checked,
                &stop_on_signals().context("handle signals")?,
                cli.exit_with,
            )?)
        }
    }
}

fn show_status(target: &Target) -> Result<()> {
    match ask(target, &Request::Status {})? {
        Reply::Status(status) if target.json => {
            print(&(serde_json::to_string_pretty(&status)? + "\n"))
        }
        Reply::Status(status) => print(&describe(&target.instance, &status)),
        other => anyhow::bail!("expected a status, got {other:?}"),
    }
}

fn ask(target: &Target, request: &Request) -> Result<Reply> {
    let instance = Instance::new(&target.instance)?;
    let mut connection = Connection::open(&instance, "emberwatch-server", TIMEOUT)?;
    Ok(connection.control(request, TIMEOUT)?)
}

fn describe(instance: &str, status: &ServerStatus) -> String {
    let uptime = Duration::from_millis(status.uptime_millis).as_secs();
    let mut text = format!(
        "instance {instance}: pid {}, up {uptime} s, {} steps, {:.0} steps/s, {} refused requests, {} clients, {} observers\n",
        status.pid,
        status.n_steps,
        status.steps_per_second,
        status.n_refused,
        status.n_clients,
        status.n_observers
    );
    text += "world  step        seed                  episode  robot         holder\n";
    for world in &status.worlds {
        let holder = match (world.resetting, world.holder_pid) {
            (true, _) => "(resetting)".into(),
            (false, Some(pid)) => format!("pid {pid}"),
            (false, None) => "-".into(),
        };
        let info = &world.info;
        let robot = format!("({}, {})", info.robot[0], info.robot[1]);
        text += &format!(
            "{:<6} {:<11} {:<21} {:<8} {robot:<13} {holder}\n",
            info.world, info.step, info.seed, info.episode
        );
    }
    text
}

fn print(text: &str) -> Result<()> {
    use std::io::Write;
    std::io::stdout()
        .write_all(text.as_bytes())
        .context("write to standard output")
}
