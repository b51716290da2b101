//! The subcommands: flags in, library calls, files and tables out.

mod compare;
mod decisions;
mod evaluate;
mod prior;
mod train;
mod worlds;

pub use compare::CompareCommand;
pub use decisions::ServeDecisionsCommand;
pub use evaluate::EvaluateCommand;
pub use prior::PriorCommand;
pub use train::TrainCommand;

use agent::acting::decisions::DecisionsError;
use agent::acting::error::RunError;
use agent::acting::run::{Mission, run};
use agent::config::AgentFlags;
use agent::learning::learned::Learned;
use agent::learning::train::TrainError;
use agent::planning::policy;
use agent::server::client::wait_for_server;
use anyhow::{Context, Result, ensure};
use clap::Args;
use network::DeviceKind;
use protocol::Model;
use protocol::channels::Instance;
use protocol::connection::ConnectionError;
use protocol::message::Status;
use protocol::program::{read_text, stop_on_signals};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

/// Exit code of a run whose lease was lost.
const LEASE_LOST: u8 = 3;

/// Act on one world of a running server.
#[derive(Args)]
pub struct RunCommand {
    /// The server's instance name
    #[arg(long, default_value = "default")]
    instance: String,
    #[command(flatten)]
    wait: WaitFlag,
    /// The world to act on
    #[arg(long, default_value_t = 0)]
    world: u32,
    /// The policy
    #[arg(long, default_value = "beam_exploit")]
    policy: String,
    /// Steps to act for; 0: until stopped
    #[arg(long, default_value_t = 0)]
    steps: u64,
    /// Take the world from its holder
    #[arg(long)]
    takeover: bool,
    /// A built-in model or a model file, where the server does not reveal its model
    #[arg(long, value_name = "MODEL")]
    model: Option<String>,
    /// What `train` learned, for policies `learned_*`, `autoencoder_*` and `dqn_beam`
    #[arg(long, value_name = "FILE")]
    checkpoint: Option<PathBuf>,
    /// Where networks compute: cpu, cuda or metal
    #[arg(long, value_name = "DEVICE", default_value_t)]
    device: DeviceKind,
    #[command(flatten)]
    settings: AgentFlags,
}

impl RunCommand {
    /// Runs the mission.
    pub fn run(&self) -> Result<()> {
        let model = self.model.as_deref().map(model_named).transpose()?;
        let mission = Mission {
            instance: Instance::new(&self.instance)?,
            world: self.world,
            policy: self.policy.clone(),
            steps: self.steps,
            takeover: self.takeover,
            model,
            config: self.settings.effective()?,
            learned: Learned::read(self.checkpoint.as_deref(), &self.device.open()?)?,
        };
        let stop = stop_on_signals().context("handle signals")?;
        if !self.wait.for_server(&mission.instance, &stop)? {
            return Ok(());
        }
        let summary = run(&mission, &stop)?;
        let mean_reward = summary.reward / summary.steps.max(1) as f64;
        tracing::info!(steps = summary.steps, mean_reward, "done");
        Ok(())
    }
}

/// How long to wait for a server.
#[derive(Debug, Args)]
pub struct WaitFlag {
    /// Seconds to wait until the instance has a server; 0: not at all
    #[arg(long, value_name = "SECONDS", default_value = "10", value_parser = parse_seconds)]
    wait: Duration,
}

impl WaitFlag {
    /// Waits for the instance's server; returns whether to go on: not if `stop` was set meanwhile.
    fn for_server(&self, instance: &Instance, stop: &AtomicBool) -> Result<bool> {
        Ok(wait_for_server(instance, self.wait, stop)?)
    }
}

/// What the policies of the built-in wildfire are, for `--help`.
pub fn policies() -> String {
    let list = policy::list(&Model::wildfire());
    format!(
        "Policies, for the states of the wildfire; where no belief is named they plan on the known \
         model's filter's:\n{list}"
    )
}

fn parse_seconds(text: &str) -> Result<Duration, String> {
    let seconds: f64 = text.parse().map_err(|_| "expected seconds, such as 60")?;
    let limit = Duration::try_from_secs_f64(seconds);
    limit.map_err(|error| format!("expected seconds, such as 60: {error}"))
}

/// Where results go wrong for a reason that callers may want to tell apart, a code of its own.
pub fn exit_code(error: &anyhow::Error) -> ExitCode {
    let served = match error.downcast_ref::<DecisionsError>() {
        Some(DecisionsError::Run(error)) => Some(error),
        _ => None,
    };
    let connection = match served.or_else(|| error.downcast_ref::<RunError>()) {
        Some(RunError::Connection(error)) => Some(error),
        _ => match error.downcast_ref::<TrainError>() {
            Some(TrainError::Connection(error)) => Some(error),
            _ => None,
        },
    };
    match connection {
        Some(ConnectionError::Refused {
            status: Status::LeaseLost,
            ..
        }) => LEASE_LOST.into(),
        _ => ExitCode::FAILURE,
    }
}

/// A built-in model, or that of a file.
fn model_named(name: &str) -> Result<Model> {
    if let Some(model) = Model::built_in(name) {
        return Ok(model);
    }
    let path = Path::new(name);
    ensure!(
        path.exists(),
        "model file {name}: No such file: expected one, or {}",
        Model::built_in_names().collect::<Vec<_>>().join(", ")
    );
    read_model(path)
}

fn read_model(path: &Path) -> Result<Model> {
    let text = read_text(path).with_context(|| format!("model file {}", path.display()))?;
    Model::from_toml(&text).with_context(|| format!("model file {}", path.display()))
}

/// Makes the folder of a file to come.
fn make_folder_of(path: &Path) -> Result<()> {
    let parent = path.parent().filter(|parent| *parent != Path::new(""));
    parent.map_or(Ok(()), make_folder)
}

fn make_folder(path: &Path) -> Result<()> {
    std::fs::create_dir_all(path).with_context(|| format!("create {}", path.display()))
}

fn write(text: &str) -> Result<()> {
    let mut out = std::io::stdout();
    out.write_all(text.as_bytes())
        .and_then(|()| out.write_all(b"\n"))
        .context("write to standard output")
}
