//! The worlds on which policies are compared, the same for all policies.

use crate::acting::mission::{check_recorded, needs_model, recorded_states};
use crate::acting::team::Team;
use crate::client::worlds::Worlds;
use anyhow::{Context, Result, ensure};
use emberwatch_acting::policy::Policy;
use emberwatch_acting::rollout::{AgentObservation, Environment};
use emberwatch_protocol::client::{Backend, Claim, Client, Observation};
use emberwatch_protocol::control::{ServerInfo, WorldSeed};
use emberwatch_protocol::feed::Feed;
use emberwatch_protocol::grid::Probabilities;
use emberwatch_protocol::{Model, Move, Shape};
use std::ops::Range;
use std::time::Duration;

/// Maximum number of worlds in a batch. Their hidden states fit a reader's buffer.
pub const MAX_BATCH: u32 = 32;

const LEASE: Duration = Duration::from_secs(3600);

/// Worlds on which policies are compared.
pub struct ComparedWorlds {
    client: Client<Worlds>,
    /// The worlds' model. For recorded worlds, a model whose states never change.
    pub model: Model,
    /// The model with which beliefs predict recorded worlds, if one was given.
    known: Option<Model>,
    /// Number of worlds, which is the number of seeds that run at a time.
    pub n_worlds: u32,
    /// Number of robots per agent: one, or all robots of a world.
    robots_per_agent: usize,
    seeds: Vec<u64>,
    step: u64,
}

impl ComparedWorlds {
    /// Acquires up to `n_seeds` worlds.
    pub fn open(worlds: Worlds, n_seeds: u32) -> Result<Self> {
        let (n_worlds, team) = (worlds.info().n_worlds, worlds.info().n_robots);
        let n_worlds = n_worlds.min(n_seeds).min(MAX_BATCH);
        let claim = Claim {
            robots: 0..n_worlds * team,
            takeover: false,
            // The time to live is long, because simulating the prior can take long. Closing the connection still ends
            // the lease at once.
            time_to_live: Some(LEASE),
        };
        let client = Client::acquire(worlds, &claim)?;
        let info = client.info();
        let model = match recorded_states(info)? {
            None => info.model.as_deref().map(Model::from_toml).transpose()?,
            recorded => recorded,
        };
        let model = model.context(
            "comparing needs the model, for filters: start the server with --reveal-model true",
        )?;
        Ok(Self {
            client,
            model,
            known: None,
            n_worlds,
            robots_per_agent: 1,
            seeds: Vec::new(),
            step: 0,
        })
    }

    /// Returns the model with which beliefs predict.
    pub fn known_model(&self) -> &Model {
        self.known.as_ref().unwrap_or(&self.model)
    }

    /// Sets the model that predicts recorded worlds, if its states, rewards and sensor are those of the worlds.
    pub fn know(&mut self, model: Model) -> Result<()> {
        check_recorded(self.info(), &self.model, &model)?;
        self.known = Some(model);
        Ok(())
    }

    /// Returns whether the worlds were recorded and no model was given for beliefs.
    pub fn lacks_model(&self) -> bool {
        self.info().recorded_world.is_some() && self.known.is_none()
    }

    pub fn has_truth(&mut self) -> bool {
        self.client.backend().has_truth()
    }

    /// Opens the feed of beliefs to observers of these worlds.
    pub fn feed(&mut self, belief: &Probabilities) -> Feed {
        self.client.backend().feed(belief)
    }

    pub fn shape(&self) -> Shape {
        self.client.shape()
    }

    pub fn info(&self) -> &ServerInfo {
        self.client.info()
    }

    pub fn n_robots(&self) -> usize {
        self.info().n_robots as usize
    }

    /// Sets the kind of team for the following flights.
    pub fn set_team(&mut self, team: Team) {
        self.robots_per_agent = match team {
            Team::Joint => self.n_robots(),
            Team::Alone | Team::Shared => 1,
        };
        // With one robot per world, sharing frames changes nothing.
        self.client.share_frames(team != Team::Alone);
    }

    pub fn n_agents(&self) -> usize {
        self.n_robots() / self.robots_per_agent
    }

    /// Starts worlds with these seeds; returns what agents see at k = 0, by world.
    pub fn reset(&mut self, seeds: &[u64]) -> Result<Vec<AgentObservation>> {
        (self.seeds, self.step) = (seeds.to_vec(), 0);
        let order = |(world, &seed)| WorldSeed {
            world,
            seed: Some(seed),
        };
        let orders: Vec<WorldSeed> = (0..).zip(seeds).map(order).collect();
        self.client.reset(&orders)?;
        let observations = self.client.observe(self.robots())?;
        self.seen(observations)
    }

    /// Returns an error if the policy's filter needs a model and the worlds have none.
    pub fn check_model(&self, policy: &Policy) -> Result<()> {
        ensure!(
            !(self.lacks_model() && policy.belief.knows_model),
            needs_model(policy)
        );
        Ok(())
    }

    fn robots(&self) -> Range<u32> {
        0..self.seeds.len() as u32 * self.info().n_robots
    }

    fn seen(&mut self, observations: Vec<Observation>) -> Result<Vec<AgentObservation>> {
        let n_worlds = self.seeds.len();
        let truth = self.client.backend().states(&self.seeds, self.step)?;
        let mut observations = observations.into_iter();
        let agents = (0..n_worlds).flat_map(|world| vec![world; self.n_agents()]);
        let seen = agents.map(|world| AgentObservation {
            truth: truth.as_ref().map(|states| states[world].clone()),
            ..AgentObservation::new(observations.by_ref().take(self.robots_per_agent))
        });
        Ok(seen.collect())
    }
}

impl Environment for ComparedWorlds {
    fn step(&mut self, paths: &[Vec<Move>]) -> Result<Option<Vec<AgentObservation>>> {
        self.step += 1;
        let observations = self.client.step(self.robots(), paths)?;
        self.seen(observations).map(Some)
    }
}
