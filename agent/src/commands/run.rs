//! `run`: acts on one world of a running server.

use super::shared::{open_device, parse_range, parse_seconds};
use crate::acting::mission::Mission;
use crate::acting::run::run;
use crate::acting::team::Team;
use crate::client::info::wait_for_server;
use crate::flags::AgentFlags;
use anyhow::{Context, Result};
use clap::Args;
use emberwatch_acting::policy::{self, Policy};
use emberwatch_learning::learners;
use emberwatch_network::DEVICES;
use emberwatch_protocol::Model;
use emberwatch_protocol::built_in::listed;
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::program::stop_on_signals;
use emberwatch_sim::config::model_named;
use std::ops::Range;
use std::path::PathBuf;
use std::time::Duration;

/// Act on one world of a running server.
#[derive(Args)]
pub struct RunCommand {
    /// Instance name of the server
    #[arg(long, default_value = "default")]
    instance: String,
    /// Policy, as a name or as BELIEF/PLANNER/GOAL; --help lists names and parts
    #[arg(long, default_value = "beam")]
    policy: String,
    /// Checkpoint of `train`, for policies with a learned belief or learned decisions
    #[arg(long, value_name = "FILE")]
    checkpoint: Option<PathBuf>,
    /// Number of steps to act; 0: until stopped
    #[arg(long, default_value_t = 0)]
    steps: u64,
    /// The robot to fly in that world, or several as FIRST..END
    #[arg(long, value_name = "NUMBER|RANGE", default_value = "0", value_parser = parse_robots)]
    robots: Range<u32>,
    /// How the agent acts together with the other robots of the world; several robots need `joint`
    #[arg(long, default_value = "alone")]
    team: Team,
    /// Number of the world to act on
    #[arg(long, default_value_t = 0)]
    world: u32,
    /// Maximum steps per second, to watch the robots [default: no limit]
    #[arg(long, value_name = "STEPS", value_parser = parse_rate)]
    steps_per_second: Option<f64>,
    /// Take the robots over from the client that holds them
    #[arg(long)]
    takeover: bool,
    /// Maximum seconds to wait for the instance's server; 0: do not wait
    #[arg(long, value_name = "SECONDS", default_value = "10", value_parser = parse_seconds)]
    wait: Duration,
    #[arg(long, value_name = "NAME|FILE", help = format!(
        "Model, if the server does not reveal it: {}, or a model file", listed(Model::built_in_names())))]
    model: Option<String>,
    /// Device for networks: cpu, cuda or metal
    #[arg(long, value_name = "DEVICE", default_value = "cpu", value_parser = DEVICES)]
    device: String,
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
            world: self.world,
            robots: self.robots.clone(),
            team: self.team,
            policy: self.policy.clone(),
            steps: self.steps,
            shortest_step: self
                .steps_per_second
                .map_or(Duration::ZERO, |rate| Duration::from_secs_f64(1.0 / rate)),
            takeover: self.takeover,
            model,
            config: self.settings.effective()?,
            learned: learners::read(self.checkpoint.as_deref(), &open_device(&self.device)?)?,
            stop: stop_on_signals().context("handle signals")?,
        };
        if !wait_for_server(&mission.instance, self.wait, || mission.is_over())? {
            return Ok(());
        }
        let summary = run(&mission)?;
        let mean_reward = summary.reward / summary.steps.max(1) as f64;
        tracing::info!(steps = summary.steps, mean_reward, "done");
        Ok(())
    }
}

fn parse_robots(text: &str) -> Result<Range<u32>, String> {
    let one = text
        .parse()
        .ok()
        .and_then(|robot: u32| Some(robot..robot.checked_add(1)?));
    one.map_or_else(|| parse_range(text), Ok)
}

/// Observers would take an agent with less than 1 step per second for dead, and it would stop late.
fn parse_rate(text: &str) -> Result<f64, String> {
    let rate: f64 = text.parse().unwrap_or(f64::NAN);
    if rate.is_finite() && rate >= 1.0 {
        Ok(rate)
    } else {
        Err(format!("expected 1 or more steps per second, got {text:?}"))
    }
}
