//! The link to one world of a server: sends paths, and receives what the agent sees.

use crate::client::truth::TruthFeed;
use anyhow::Result;
use emberwatch_acting::rollout::{Environment, Seen};
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::client::Observation;
use emberwatch_protocol::{Client, Move};
use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};

/// The lease on some robots of a world. For oracles, also a feed of the world's hidden states.
pub struct Link {
    pub client: Client,
    truth: Option<TruthFeed>,
    /// Numbers of the robots that the agent plans for, including the robots that the client holds.
    robots: Range<u32>,
}

/// A link that stops waiting for a step when `stop` is set.
pub struct Stoppable<'a> {
    link: &'a mut Link,
    stop: &'a AtomicBool,
}

impl Link {
    /// `sees_truth`: whether the agent also receives the hidden states.
    pub fn new(
        client: Client,
        instance: &Instance,
        robots: Range<u32>,
        sees_truth: bool,
    ) -> Result<Self> {
        let truth = sees_truth.then(|| TruthFeed::open(instance, client.shape()));
        Ok(Self {
            truth: truth.transpose()?,
            client,
            robots,
        })
    }

    /// Returns the link as an environment that stops waiting when `stop` is set.
    pub fn until<'a>(&'a mut self, stop: &'a AtomicBool) -> Stoppable<'a> {
        Stoppable { link: self, stop }
    }

    /// Returns what the agent sees of the world's present state.
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
