//! The way to one world of a server: paths out, what the agent sees back.

use crate::client::truth::TruthFeed;
use anyhow::Result;
use emberwatch_learning::rollout::{Environment, Seen};
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::client::Observation;
use emberwatch_protocol::{Client, Move};
use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};

/// The lease on some robots of a world, and the hidden states of that world for policies that are told them.
pub struct Link {
    pub client: Client,
    truth: Option<TruthFeed>,
    /// The numbers of the robots that the agent plans for, the client's among them.
    robots: Range<u32>,
}

/// A link that gives up waiting for a step when it is time to stop.
pub struct Stoppable<'a> {
    link: &'a mut Link,
    stop: &'a AtomicBool,
}

impl Link {
    /// `is_told`: whether the agent sees the hidden states, too.
    pub fn new(
        client: Client,
        instance: &Instance,
        robots: Range<u32>,
        is_told: bool,
    ) -> Result<Self> {
        let truth = is_told.then(|| TruthFeed::open(instance, client.shape()));
        Ok(Self {
            truth: truth.transpose()?,
            client,
            robots,
        })
    }

    /// As an environment, until `stop` is set.
    pub fn until<'a>(&'a mut self, stop: &'a AtomicBool) -> Stoppable<'a> {
        Stoppable { link: self, stop }
    }

    /// What the world shows now.
    pub fn observe(&mut self) -> Result<Seen> {
        let observations = self.client.observe(self.robots.clone())?;
        self.with_truth(observations)
    }

    fn with_truth(&self, observations: Vec<Observation>) -> Result<Seen> {
        let mut seen = Seen::new(observations);
        if let Some(feed) = &self.truth {
            let worlds = self.client.worlds_of(&self.client.robots());
            let world = &seen.observation.world;
            let states = feed.states(worlds, &[world.seed], world.step)?;
            seen.truth = states.into_iter().next();
        }
        Ok(seen)
    }
}

impl Environment for Stoppable<'_> {
    fn fly(&mut self, paths: &[Vec<Move>]) -> Result<Option<Vec<Seen>>> {
        let Link { client, robots, .. } = &mut *self.link;
        let is_over = || self.stop.load(Ordering::Relaxed);
        let Some(mut observations) = client.step_until(client.robots(), paths, &is_over)? else {
            return Ok(None);
        };
        if robots.len() > observations.len() {
            let step = observations[0].world.step;
            observations = client.recall(robots.clone(), step)?;
        }
        Ok(Some(vec![self.link.with_truth(observations)?]))
    }
}
