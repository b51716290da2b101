//! The mission of an agent on one world of a running server, and checks that the server fits it.

use crate::acting::team::Team;
use crate::client::info::connect;
use anyhow::{Result, bail, ensure};
use emberwatch_acting::config::AgentConfig;
use emberwatch_acting::learned::Learned;
use emberwatch_acting::policy::Policy;
use emberwatch_protocol::Model;
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::client::Claim;
use emberwatch_protocol::connection::refused;
use emberwatch_protocol::control::ServerInfo;
use emberwatch_protocol::message::Status;
use emberwatch_protocol::model::{Description, ModelError};
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

#[derive(Clone)]
pub struct Mission {
    pub instance: Instance,
    pub world: u32,
    /// Numbers of the robots to fly in the world. They share one belief.
    pub robots: Range<u32>,
    /// How the agent acts together with the other robots of the world, which other agents may fly. Agents of a joint
    /// team with the same belief compute the same plan, and each flies its own part.
    pub team: Team,
    pub policy: String,
    /// Number of steps to act; 0: until stopped.
    pub steps: u64,
    /// Minimum time from the start of one step to the start of the next. A request to stop waits until it has passed.
    pub shortest_step: Duration,
    pub takeover: bool,
    /// The model to use if the server does not reveal its own.
    pub model: Option<Model>,
    pub config: AgentConfig,
    /// Learned models, for policies that use them.
    pub learned: Learned,
    /// Set when the agent must stop.
    pub stop: Arc<AtomicBool>,
}

impl Mission {
    pub fn is_over(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    pub(super) fn worlds(&self) -> Range<u32> {
        self.world..self.world.saturating_add(1)
    }

    pub(super) fn claim(&self, numbers: &Range<u32>) -> Claim {
        Claim {
            takeover: self.takeover,
            ..Claim::new(numbers.clone())
        }
    }

    pub(super) fn numbers(&self, info: &ServerInfo) -> Result<Range<u32>> {
        let (robots, team) = (&self.robots, info.n_robots);
        ensure!(
            !robots.is_empty() && robots.end <= team,
            "robots: expected a part of the world's robots 0..{team}, got {}..{}",
            robots.start,
            robots.end
        );
        ensure!(
            robots.len() == 1 || self.team == Team::Joint,
            "robots: expected one robot, or several with --team joint"
        );
        Ok(self.world * team + robots.start..self.world * team + robots.end)
    }
}

pub(super) fn info_of(instance: &Instance, worlds: &Range<u32>) -> Result<ServerInfo> {
    let info = connect(instance)?.info().clone();
    if worlds.end > info.n_worlds {
        return Err(refused(Status::NoSuchWorld, info.n_worlds.into()).into());
    }
    Ok(info)
}

/// Returns a model of revealed recorded states without transitions; `None` for simulated worlds.
pub fn recorded_states(info: &ServerInfo) -> Result<Option<Model>, ModelError> {
    let recorded = info.recorded_world.as_ref();
    let description = recorded.and_then(|recorded| recorded.description.as_deref());
    let model = description.map(Description::model_of).transpose()?;
    let radius = info.airspace.as_ref().map_or(0, |airspace| airspace.radius);
    model.map(|model| model.with_radius(radius)).transpose()
}

/// Returns the error text for a policy whose filter needs a model, if none was given for recorded worlds.
pub fn needs_model(policy: &Policy) -> String {
    format!(
        "policy {:?} filters with a model, and recorded worlds have none: give --model FILE, or choose a policy \
         without a model, such as coverage or learned_beam",
        policy.name
    )
}

pub(super) fn model_of(
    instance: &Instance,
    info: &ServerInfo,
    model: Option<&Model>,
) -> Result<Model> {
    let revealed = info.model.as_deref().map(Model::from_toml).transpose()?;
    let model = match (model, revealed) {
        (Some(given), Some(revealed)) if *given != revealed => {
            bail!(
                "model: expected the server's model {:?}, got a different model, {:?}",
                revealed.file().name,
                given.file().name
            );
        }
        (Some(given), _) => given.clone(),
        (None, Some(revealed)) => revealed,
        (None, None) if info.recorded_world.is_some() => bail!(
            "instance {:?} has recorded worlds without a model: give --model FILE",
            instance.name()
        ),
        (None, None) => bail!(
            "instance {:?} does not reveal its model: give --model FILE",
            instance.name()
        ),
    };
    check_sensor(info, &model)?;
    Ok(model)
}

fn check_sensor(info: &ServerInfo, model: &Model) -> Result<()> {
    let (expected, got) = (info.n_observations, model.n_observations());
    ensure!(
        got == expected,
        "model: expected {expected} observation values as on the server, got {got}"
    );
    let airspace = info.airspace().map_err(anyhow::Error::msg)?;
    ensure!(
        model.airspace(info.shape()?)? == airspace,
        "model: expected the server's sensor radius and no-fly cells, got others"
    );
    Ok(())
}

/// Checks that a filter's model has the same states, rewards and sensor as the recorded worlds.
pub fn check_recorded(info: &ServerInfo, states: &Model, model: &Model) -> Result<()> {
    let [expected, got] = [states, model].map(|model| model.state_names().join(", "));
    ensure!(
        got == expected,
        "--model: expected the recorded states {expected}, got {got}"
    );
    let [expected, got] = [states, model].map(|model| model.reward().to_vec());
    ensure!(
        got == expected,
        "--model: expected the rewards of the recorded states, {expected:?}, got {got:?}"
    );
    check_sensor(info, model)?;
    Ok(model.check_on(info.shape()?)?)
}
