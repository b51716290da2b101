//! The worlds of a client's robots, each with one agent: over a server, or in this process.

use crate::rollout::{Environment, Seen};
use anyhow::Result;
use emberwatch_messages::backend::Backend;
use emberwatch_messages::client::Client;
use emberwatch_model::Move;

/// All robots of a client.
pub struct Served<'a, B> {
    client: &'a mut Client<B>,
    /// Whether frames show every cell.
    shows_all: bool,
}

impl<'a, B: Backend> Served<'a, B> {
    /// `shows_all`: whether frames show every cell, where the server gives such.
    pub fn new(client: &'a mut Client<B>, shows_all: bool) -> Self {
        Self { client, shows_all }
    }

    /// What each agent sees now.
    ///
    /// # Errors
    /// If there is no answer.
    pub fn observe(&mut self) -> Result<Vec<Seen>> {
        let observations = self.client.observe(self.client.robots())?;
        let seen = observations.into_iter();
        Ok(seen.map(|observation| Seen::new([observation])).collect())
    }
}

impl<B: Backend> Environment for Served<'_, B> {
    fn fly(&mut self, paths: &[Vec<Move>]) -> Result<Option<Vec<Seen>>> {
        let robots = self.client.robots();
        let observations = if self.shows_all {
            self.client.step_full(robots, paths)?
        } else {
            self.client.step(robots, paths)?
        };
        // Without hidden states: neither learners nor policies see any.
        let seen = observations.into_iter();
        Ok(Some(
            seen.map(|observation| Seen::new([observation])).collect(),
        ))
    }
}
