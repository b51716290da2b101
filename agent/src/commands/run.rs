//! `run`: act on one world of a running server.

use super::shared::{WaitFlag, model_named, model_of, parse_range};
use crate::acting::mission::{Company, Mission};
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
    /// The server's instance name
    #[arg(long, default_value = "default")]
    instance: String,
    #[command(flatten)]
    wait: WaitFlag,
    #[arg(long, value_name = "NAME|FILE", value_parser = Task::named, help = format!(
        "Refuse a server whose worlds are not this task: {} or a task file", listed(Task::built_in_names())))]
    task: Option<Task>,
    /// The world to act on
    #[arg(long, default_value_t = 0)]
    world: u32,
    /// The robot of that world to fly
    #[arg(long, default_value_t = 0, conflicts_with = "robots")]
    robot: u32,
    /// Several robots of that world to fly: needs --team
    #[arg(long, value_name = "FIRST..END", value_parser = parse_range::<u32>, requires = "team")]
    robots: Option<Range<u32>>,
    /// Plan for all robots of the world that fly, on what all see; agents with the same policy and settings make the
    /// same plan, of which each flies its own part
    #[arg(long)]
    team: bool,
    /// See what all robots of the world see, but plan without regard to the others
    #[arg(long, conflicts_with = "team")]
    share: bool,
    /// The policy, by its name or as BELIEF/PLANNER/GOAL; the parts are listed by --help
    #[arg(long, default_value = "beam_exploit")]
    policy: String,
    /// Steps to act for; 0: until stopped
    #[arg(long, default_value_t = 0)]
    steps: u64,
    /// Steps a second at most, for people who watch; without it: as many as possible
    #[arg(long, value_name = "STEPS", value_parser = parse_rate)]
    steps_per_second: Option<f64>,
    /// Take the robot from its holder
    #[arg(long)]
    takeover: bool,
    #[arg(long, value_name = "NAME|FILE", help = format!(
        "The model, where the server does not reveal it: {} or a model file", listed(Model::built_in_names())))]
    model: Option<String>,
    /// What `train` learned, for policies on a learned belief and those that a DQN decides for
    #[arg(long, value_name = "FILE")]
    checkpoint: Option<PathBuf>,
    /// Where networks compute: cpu, cuda or metal
    #[arg(long, value_name = "DEVICE", default_value_t)]
    device: DeviceKind,
    #[command(flatten)]
    settings: AgentFlags,
}

impl RunCommand {
    pub fn run(&self) -> Result<()> {
        let model = self.model.as_deref().map(model_named).transpose()?;
        // What no server can fly needs none to be refused.
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
            company: match (self.team, self.share) {
                (true, _) => Company::Team,
                (_, true) => Company::Shared,
                _ => Company::Alone,
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
    let model = (!task.is_recorded()).then(|| model_of(&task));
    Ok((task, model.transpose()?))
}

/// A rate at which observers see that the agent lives, and at which it is stopped within a second.
fn parse_rate(text: &str) -> Result<f64, String> {
    let rate: f64 = text.parse().unwrap_or(f64::NAN);
    if rate.is_finite() && rate >= 1.0 {
        Ok(rate)
    } else {
        Err(format!("expected steps a second, 1 or more, got {text:?}"))
    }
}
