//! The link to one world of a server: sends paths, and receives what the agent sees.

use crate::acting::mission::Mission;
use crate::client::truth::TruthFeed;
use anyhow::Result;
use emberwatch_acting::rollout::{AgentObservation, Environment};
use emberwatch_protocol::client::Observation;
use emberwatch_protocol::{Client, Move};
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// The lease on some robots of a world. For oracles, also a feed of the world's hidden states.
pub struct Link {
    pub client: Client,
    truth: Option<TruthFeed>,
    robots: Range<u32>,
    stop: Arc<AtomicBool>,
}

impl Link {
    /// `sees_truth`: whether the agent also receives the hidden states.
    pub fn new(
        client: Client,
        mission: &Mission,
        robots: Range<u32>,
        sees_truth: bool,
    ) -> Result<Self> {
        let truth = sees_truth.then(|| TruthFeed::open(&mission.instance, client.shape()));
        Ok(Self {
            truth: truth.transpose()?,
            client,
            robots,
            stop: mission.stop.clone(),
        })
    }

    /// Returns what the agent sees of the world's present state.
    pub fn observe(&mut self) -> Result<AgentObservation> {
        let observations = self.client.observe(self.robots.clone())?;
        self.with_truth(observations)
    }

    fn with_truth(&self, observations: Vec<Observation>) -> Result<AgentObservation> {
        let mut seen = AgentObservation::new(observations);
        if let Some(feed) = &self.truth {
            let worlds = self.client.worlds_of(&self.client.robots());
            let world = &seen.observation.world;
            let states = feed.states(worlds, &[world.seed], world.step)?;
            seen.truth = states.into_iter().next();
        }
        Ok(seen)
    }
}

impl Environment for Link {
    fn step(&mut self, paths: &[Vec<Move>]) -> Result<Option<Vec<AgentObservation>>> {
        let Self {
            client,
            robots,
            stop,
            ..
        } = self;
        let is_over = || stop.load(Ordering::Relaxed);
        let Some(mut observations) = client.step_until(client.robots(), paths, &is_over)? else {
            return Ok(None);
        };
        if robots.len() > observations.len() {
            let step = observations[0].world.step;
            observations = client.recall(robots.clone(), step)?;
        }
        Ok(Some(vec![self.with_truth(observations)?]))
    }
}
