//! `status` and `stop`: requests to a running server.

use anyhow::Result;
use clap::Args;
use emberwatch_protocol::Connection;
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::control::{Reply, Request, ServerInfo, ServerStatus};
use emberwatch_protocol::program::print;
use serde::Serialize;
use std::time::Duration;

const TIMEOUT: Duration = Duration::from_secs(5);

/// Prints the state of a running server.
#[derive(Args)]
pub struct StatusCommand {
    #[command(flatten)]
    target: StopCommand,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Stops a running server.
#[derive(Args)]
pub struct StopCommand {
    /// The server's instance name
    #[arg(long, default_value = "default")]
    instance: String,
}

#[derive(Serialize)]
struct NamedStatus<'a> {
    #[serde(skip_serializing_if = "Option::is_none")]
    task: Option<&'a str>,
    #[serde(flatten)]
    status: ServerStatus,
}

impl StatusCommand {
    pub fn run(&self) -> Result<()> {
        let (info, reply) = self.target.ask(&Request::Status {})?;
        match reply {
            Reply::Status(status) if self.json => {
                let task = info.task.as_deref();
                let named = NamedStatus { task, status };
                Ok(print(&(serde_json::to_string_pretty(&named)? + "\n"))?)
            }
            Reply::Status(status) => Ok(print(&describe(&self.target.instance, &info, &status))?),
            other => anyhow::bail!("expected a status, got {other:?}"),
        }
    }
}

impl StopCommand {
    pub fn run(&self) -> Result<()> {
        self.ask(&Request::Shutdown {}).map(drop)
    }

    fn ask(&self, request: &Request) -> Result<(ServerInfo, Reply)> {
        let instance = Instance::new(&self.instance)?;
        let mut connection = Connection::open(&instance, "emberwatch-server", TIMEOUT)?;
        let reply = connection.control(request, TIMEOUT)?;
        Ok((connection.info().clone(), reply))
    }
}

fn describe(instance: &str, info: &ServerInfo, status: &ServerStatus) -> String {
    let task = info.task.iter().map(|task| format!("task {task}, "));
    let task: String = task.collect();
    let uptime = Duration::from_millis(status.uptime_millis).as_secs();
    let mut text = format!(
        "instance {instance}: {task}pid {}, up {uptime} s, {} steps, {:.0} steps/s, {} refused requests, {} clients, {} observers\n",
        status.pid,
        status.n_steps,
        status.steps_per_second,
        status.n_refused,
        status.n_clients,
        status.n_observers
    );
    text += "world  step        seed                  episode  robot  cell          holder\n";
    for world in &status.worlds {
        let info = &world.info;
        for (robot, cell) in info.robots.iter().enumerate() {
            let holder = match (world.resetting, world.holder_pids.get(robot)) {
                (true, _) => "(resetting)".into(),
                (false, Some(Some(pid))) => format!("pid {pid}"),
                (false, _) => "-".into(),
            };
            let cell = format!("({}, {})", cell[0], cell[1]);
            text += &format!(
                "{:<6} {:<11} {:<21} {:<8} {robot:<6} {cell:<13} {holder}\n",
                info.world, info.step, info.seed, info.episode
            );
        }
    }
    text
}
