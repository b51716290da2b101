//! `run`: acts on one world of a running server.

use super::shared::{WaitFlag, model_named, model_of, parse_range};
use crate::acting::mission::{Cooperation, Mission};
use crate::acting::run::run;
use crate::flags::AgentFlags;
use anyhow::{Context, Result};
use clap::Args;
use emberwatch_learning::learners;
use emberwatch_learning::policy::{self, Policy};
use emberwatch_network::DeviceKind;
use emberwatch_protocol::Model;
use emberwatch_protocol::built_in::listed;
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::program::stop_on_signals;
use emberwatch_protocol::task::Task;
use std::ops::Range;
use std::path::PathBuf;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

/// Act on one world of a running server.
#[derive(Args)]
pub struct RunCommand {
    /// Instance name of the server
    #[arg(long, default_value = "default")]
    instance: String,
    #[command(flatten)]
    wait: WaitFlag,
    #[arg(long, value_name = "NAME|FILE", value_parser = Task::named, help = format!(
        "Refuse the server unless it has this task: {}, or a task file", listed(Task::built_in_names())))]
    task: Option<Task>,
    /// Number of the world to act on
    #[arg(long, default_value_t = 0)]
    world: u32,
    /// Number of the robot to fly in that world
    #[arg(long, default_value_t = 0, conflicts_with = "robots")]
    robot: u32,
    /// Numbers of several robots to fly in that world; needs --team
    #[arg(long, value_name = "FIRST..END", value_parser = parse_range::<u32>, requires = "team")]
    robots: Option<Range<u32>>,
    /// Plan for all flying robots of the world, on the observations of all, and fly this agent's part; agents with the
    /// same policy and settings compute the same plan
    #[arg(long)]
    team: bool,
    /// Use the observations of all robots of the world, but plan as if there were no other robots
    #[arg(long, conflicts_with = "team")]
    share: bool,
    /// Policy, as a name or as BELIEF/PLANNER/GOAL; --help lists names and parts
    #[arg(long, default_value = "beam_exploit")]
    policy: String,
    /// Number of steps to act; 0: until stopped
    #[arg(long, default_value_t = 0)]
    steps: u64,
    /// Maximum steps per second, to watch the robots [default: no limit]
    #[arg(long, value_name = "STEPS", value_parser = parse_rate)]
    steps_per_second: Option<f64>,
    /// Take the robots over from the client that holds them
    #[arg(long)]
    takeover: bool,
    #[arg(long, value_name = "NAME|FILE", help = format!(
        "Model, if the server does not reveal it: {}, or a model file", listed(Model::built_in_names())))]
    model: Option<String>,
    /// Checkpoint of `train`, for policies with a learned belief or learned decisions
    #[arg(long, value_name = "FILE")]
    checkpoint: Option<PathBuf>,
    /// Device for networks: cpu, cuda or metal
    #[arg(long, value_name = "DEVICE", default_value_t)]
    device: DeviceKind,
    #[command(flatten)]
    settings: AgentFlags,
}

impl RunCommand {
    pub fn run(&self) -> Result<()> {
        let model = self.model.as_deref().map(model_named).transpose()?;
        // Before waiting for a server, refuse a policy that no server can run.
        match &model {
            Some(model) => Policy::named(&self.policy, model).map(drop),
            None => policy::check_name(&self.policy),
        }?;
        let mission = Mission {
            instance: Instance::new(&self.instance)?,
            task: self.task.clone().map(task_with_model).transpose()?,
            world: self.world,
            robots: self
                .robots
                .clone()
                .unwrap_or(self.robot..self.robot.saturating_add(1)),
            cooperation: match (self.team, self.share) {
                (true, _) => Cooperation::Team,
                (_, true) => Cooperation::Shared,
                _ => Cooperation::Alone,
            },
            policy: self.policy.clone(),
            steps: self.steps,
            shortest_step: self
                .steps_per_second
                .map_or(Duration::ZERO, |rate| Duration::from_secs_f64(1.0 / rate)),
            takeover: self.takeover,
            model,
            config: self.settings.effective()?,
            learned: learners::read(self.checkpoint.as_deref(), &self.device.open()?)?,
        };
        let stop = stop_on_signals().context("handle signals")?;
        if !self
            .wait
            .for_server(&mission.instance, || stop.load(Relaxed))?
        {
            return Ok(());
        }
        let summary = run(&mission, &stop)?;
        let mean_reward = summary.reward / summary.steps.max(1) as f64;
        tracing::info!(steps = summary.steps, mean_reward, "done");
        Ok(())
    }
}

fn task_with_model(task: Task) -> Result<(Task, Option<Model>)> {
    let model = (!task.world.is_recorded()).then(|| model_of(&task));
    Ok((task, model.transpose()?))
}

/// Parses a rate of at least 1 step per second. Observers would take a slower agent for dead, and a slower agent would
/// stop late.
fn parse_rate(text: &str) -> Result<f64, String> {
    let rate: f64 = text.parse().unwrap_or(f64::NAN);
    if rate.is_finite() && rate >= 1.0 {
        Ok(rate)
    } else {
        Err(format!("expected 1 or more steps per second, got {text:?}"))
    }
}
