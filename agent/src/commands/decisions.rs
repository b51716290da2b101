//! `serve-decisions`: a learner outside decides, this program estimates, plans and steps.

use super::shared::{WaitFlag, model_named};
use anyhow::{Context, Result, ensure};
use clap::Args;
use emberwatch_agent::acting::decider::Assignment;
use emberwatch_agent::acting::decisions::serve_decisions;
use emberwatch_agent::config::AgentFlags;
use emberwatch_agent::learning::learned::Learned;
use emberwatch_agent::policy::EstimatorKind;
use emberwatch_network::Device;
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::program::{WatchedProcess, stop_on_signals};
use std::path::PathBuf;
use std::sync::atomic::Ordering::Relaxed;

/// Take decisions for worlds from a learner outside.
#[derive(Args)]
pub struct ServeDecisionsCommand {
    /// The server's instance name
    #[arg(long, default_value = "default")]
    instance: String,
    #[command(flatten)]
    wait: WaitFlag,
    /// The first world to act on
    #[arg(long, default_value_t = 0)]
    world: u32,
    /// Number of worlds to act on at once
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1024))]
    worlds: u32,
    /// Take the worlds from their holders
    #[arg(long)]
    takeover: bool,
    /// What keeps the beliefs [default: the checkpoint's; without one the known model's]
    #[arg(long, value_name = "NAME")]
    estimator: Option<EstimatorKind>,
    /// What `train` learned, for learned estimators; may be given for each
    #[arg(long, value_name = "FILE")]
    checkpoint: Vec<PathBuf>,
    /// `wildfire` or the path of a model file, where the server does not reveal its model
    #[arg(long)]
    model: Option<String>,
    /// End when this process ends
    #[arg(long, value_name = "PID")]
    exit_with: Option<i32>,
    #[command(flatten)]
    settings: AgentFlags,
}

impl ServeDecisionsCommand {
    pub fn run(&self) -> Result<()> {
        let model = self.model.as_deref().map(model_named).transpose()?;
        let checkpoints = self.checkpoint.iter().map(PathBuf::as_path);
        let learned = Learned::read(checkpoints, &Device::Cpu)?;
        let task = Assignment {
            instance: Instance::new(&self.instance)?,
            worlds: self.world..self.world.saturating_add(self.worlds),
            takeover: self.takeover,
            estimator: self.estimator(&learned)?,
            config: self.settings.effective()?,
            learned,
        };
        let exit_with = self.exit_with.map(WatchedProcess::watch).transpose()?;
        let stop = stop_on_signals().context("handle signals")?;
        let is_over =
            || stop.load(Relaxed) || exit_with.as_ref().is_some_and(WatchedProcess::has_ended);
        if !self.wait.for_server(&task.instance, is_over)? {
            return Ok(());
        }
        serve_decisions(&task, model.as_ref(), exit_with, &stop)?;
        tracing::info!("done");
        Ok(())
    }

    fn estimator(&self, learned: &Learned) -> Result<EstimatorKind> {
        let kind = match (self.estimator, &learned.decisions) {
            (Some(kind), _) => kind,
            (None, Some(decisions)) => decisions.estimator,
            (None, None) if learned.filter.is_some() => EstimatorKind::LEARNED,
            (None, None) if learned.own_filter.is_some() => EstimatorKind::learned(true),
            (None, None) if learned.neural.is_some() => EstimatorKind::Neural,
            (None, None) => EstimatorKind::KNOWN,
        };
        ensure!(
            !kind.is_learned() || learned.belief(kind).is_some(),
            "estimator {}: expected a checkpoint of such a belief",
            kind.label()
        );
        Ok(kind)
    }
}
