//! `serve-decisions`: a learner outside decides, this program estimates, plans and steps.

use super::shared::{WaitFlag, model_named};
use agent::acting::decider::Assignment;
use agent::acting::decisions::serve_decisions;
use agent::config::AgentFlags;
use agent::policy::{EstimatorKind, PlannerKind};
use anyhow::{Context, Result};
use clap::{Args, ValueEnum};
use protocol::channels::Instance;
use protocol::program::{WatchedProcess, stop_on_signals};
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
    /// What keeps the beliefs
    #[arg(long, default_value = "known_model")]
    estimator: EstimatorName,
    /// What plans a path for the objective decided
    #[arg(long, default_value = "beam")]
    planner: PlannerName,
    /// `wildfire` or the path of a model file, where the server does not reveal its model
    #[arg(long)]
    model: Option<String>,
    /// End when this process ends
    #[arg(long, value_name = "PID")]
    exit_with: Option<i32>,
    #[command(flatten)]
    settings: AgentFlags,
}

/// The estimators that know the model.
#[derive(Clone, Copy, ValueEnum)]
#[value(rename_all = "snake_case")]
enum EstimatorName {
    /// The paper's Bayes filter: cells are independent
    KnownModel,
    /// One whose corrections reach neighbouring cells, by correlations that it learns
    SpatialFilter,
}

#[derive(Clone, Copy, ValueEnum)]
enum PlannerName {
    /// Beam search
    Beam,
    /// The best of many random paths
    Shooting,
}

impl ServeDecisionsCommand {
    pub fn run(&self) -> Result<()> {
        let model = self.model.as_deref().map(model_named).transpose()?;
        let task = Assignment {
            instance: Instance::new(&self.instance)?,
            worlds: self.world..self.world.saturating_add(self.worlds),
            takeover: self.takeover,
            estimator: match self.estimator {
                EstimatorName::KnownModel => EstimatorKind::KnownModel,
                EstimatorName::SpatialFilter => EstimatorKind::Spatial,
            },
            planner: match self.planner {
                PlannerName::Beam => PlannerKind::Beam,
                PlannerName::Shooting => PlannerKind::Shooting,
            },
            config: self.settings.effective()?,
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
}
