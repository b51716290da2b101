//! The worlds of a client's robots, each with one agent, on a server or in this process.

use crate::rollout::{AgentObservation, Environment};
use anyhow::Result;
use emberwatch_messages::backend::Backend;
use emberwatch_messages::client::Client;
use emberwatch_model::Move;

/// The environment of all robots of a client.
pub struct Served<'a, B> {
    client: &'a mut Client<B>,
    shows_all: bool,
}

impl<'a, B: Backend> Served<'a, B> {
    /// Creates the environment. With `shows_all`, it requests frames that show every cell.
    pub fn new(client: &'a mut Client<B>, shows_all: bool) -> Self {
        Self { client, shows_all }
    }

    /// Returns the current observation of each agent.
    ///
    /// # Errors
    /// If the backend does not answer.
    pub fn observe(&mut self) -> Result<Vec<AgentObservation>> {
        let observations = self.client.observe(self.client.robots())?;
        let seen = observations.into_iter();
        Ok(seen
            .map(|observation| AgentObservation::new([observation]))
            .collect())
    }
}

impl<B: Backend> Environment for Served<'_, B> {
    fn step(&mut self, paths: &[Vec<Move>]) -> Result<Option<Vec<AgentObservation>>> {
        let robots = self.client.robots();
        let observations = if self.shows_all {
            self.client.step_full(robots, paths)?
        } else {
            self.client.step(robots, paths)?
        };
        // Hidden states are omitted: neither learners nor policies may see them.
        let seen = observations.into_iter();
        Ok(Some(
            seen.map(|observation| AgentObservation::new([observation]))
                .collect(),
        ))
    }
}
