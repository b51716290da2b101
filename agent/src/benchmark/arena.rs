//! The worlds on which policies are compared, the same for all policies.

use crate::acting::mission::{check_recorded, needs_model, recorded_states};
use crate::benchmark::team::Team;
use crate::client::info::connect;
use crate::client::truth::TruthFeed;
use anyhow::{Context, Result, ensure};
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::planning::team::robot_seed;
use emberwatch_learning::beliefs::Conditions;
use emberwatch_learning::config::AgentConfig;
use emberwatch_learning::learned::Learned;
use emberwatch_learning::policy::Policy;
use emberwatch_learning::rollout::agent::Agent;
use emberwatch_learning::rollout::{Environment, Seen, building};
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::client::{Claim, Observation};
use emberwatch_protocol::control::{ServerInfo, WorldSeed};
use emberwatch_protocol::{Client, Grid, Model, Move, Shape};
use std::ops::Range;
use std::time::Duration;

/// Maximum number of worlds in a batch. Their hidden states fit a reader's buffer.
pub const MAX_BATCH: u32 = 32;

/// Time to live of an unused lease on a comparison's worlds.
const LEASE: Duration = Duration::from_secs(3600);

/// Worlds of one server, leased for a comparison.
pub struct Arena {
    instance: Instance,
    client: Client,
    /// `None` if the server does not publish hidden states.
    truth: Option<TruthFeed>,
    /// The worlds' model. For recorded worlds, a model whose states never change.
    model: Model,
    /// The model with which beliefs predict recorded worlds, if one was given.
    known: Option<Model>,
    /// Number of worlds, which is the number of seeds that run at a time.
    n_worlds: u32,
    /// Number of robots per agent: one, or all robots of a world.
    crew: usize,
}

impl Arena {
    /// Acquires up to `n_seeds` worlds.
    pub fn open(instance: &Instance, n_seeds: u32) -> Result<Self> {
        let unfit =
            |needs: &str| format!("instance {:?}: comparing needs {needs}", instance.name());
        let connection = connect(instance)?;
        let (n_worlds, team) = (connection.info().n_worlds, connection.info().n_robots);
        let n_worlds = n_worlds.min(n_seeds).min(MAX_BATCH);
        let claim = Claim {
            robots: 0..n_worlds * team,
            takeover: false,
            // The time to live is long, because simulating the prior can take long. Closing the connection still ends
            // the lease at once.
            time_to_live: Some(LEASE),
        };
        let client = Client::acquire(connection, &claim)?;
        let info = client.info();
        let model = match recorded_states(info)? {
            None => info.model.as_deref().map(Model::from_toml).transpose()?,
            recorded => recorded,
        };
        let model = model.with_context(|| {
            unfit("the model, for filters: start the server with --reveal-model true")
        })?;
        let truth = info
            .publish_truth
            .then(|| TruthFeed::open(instance, client.shape()));
        let truth = truth.transpose()?;
        Ok(Self {
            instance: instance.clone(),
            client,
            truth,
            model,
            known: None,
            n_worlds,
            crew: 1,
        })
    }

    pub fn instance(&self) -> &Instance {
        &self.instance
    }

    pub fn model(&self) -> &Model {
        &self.model
    }

    /// Returns the model with which beliefs predict.
    pub fn known_model(&self) -> &Model {
        self.known.as_ref().unwrap_or(&self.model)
    }

    /// Sets the model with which beliefs predict recorded worlds.
    ///
    /// # Errors
    /// If the model's states, rewards or sensor differ from those of the worlds.
    pub fn know(&mut self, model: Model) -> Result<()> {
        check_recorded(self.info(), &self.model, &model)?;
        self.known = Some(model);
        Ok(())
    }

    /// Returns whether the worlds were recorded and no model was given for beliefs.
    pub fn lacks_model(&self) -> bool {
        self.info().recorded_world.is_some() && self.known.is_none()
    }

    pub fn shape(&self) -> Shape {
        self.client.shape()
    }

    pub fn info(&self) -> &ServerInfo {
        self.client.info()
    }

    pub fn shows_truth(&self) -> bool {
        self.truth.is_some()
    }

    /// Returns the number of seeds that run at a time.
    pub fn batch_size(&self) -> usize {
        self.n_worlds as usize
    }

    pub fn n_robots(&self) -> usize {
        self.info().n_robots as usize
    }

    /// Sets the kind of team for the following flights.
    pub fn fly_as(&mut self, team: Team) {
        self.crew = if team.is_joint() { self.n_robots() } else { 1 };
        // With one robot per world, sharing frames changes nothing.
        self.client.share_frames(team != Team::Alone);
    }

    pub fn n_agents(&self) -> usize {
        self.n_robots() / self.crew
    }

    /// Starts worlds with these seeds; returns what agents see at k = 0, by world.
    pub fn reset(&mut self, seeds: &[u64]) -> Result<Vec<Seen>> {
        let orders = seeds.iter().zip(0..);
        let orders = orders.map(|(&seed, world)| WorldSeed {
            world,
            seed: Some(seed),
        });
        self.client.reset(&orders.collect::<Vec<_>>())?;
        let truth = self.states(seeds, 0)?;
        let robots = self.robots(seeds);
        let observations = self.client.observe(robots)?;
        Ok(self.seen(observations, &truth))
    }

    /// Returns the worlds of these seeds as an environment whose next step is `step`.
    pub fn batch<'a>(&'a mut self, seeds: &'a [u64], step: u64) -> Batch<'a> {
        Batch {
            arena: self,
            seeds,
            step,
        }
    }

    /// Creates a policy's agent for the world of a seed. `number` is the agent's index in the world.
    pub fn agent(
        &self,
        policy: &Policy,
        config: &AgentConfig,
        prior: &Belief,
        (seed, number): (u64, usize),
        learned: &Learned,
    ) -> Result<Agent> {
        self.check_model(policy)?;
        let conditions = Conditions {
            model: Some(self.known_model()),
            shape: self.shape(),
            prior: Some(prior),
            learned,
        };
        let seed = robot_seed(config.planner_seed(seed), number);
        building::agent(policy, config, &conditions, self.info().n_moves, seed)
    }

    /// Returns an error if the policy's filter needs a model and the worlds have none.
    pub fn check_model(&self, policy: &Policy) -> Result<()> {
        ensure!(
            !(self.lacks_model() && policy.belief.knows_model),
            needs_model(policy)
        );
        Ok(())
    }

    /// Returns the hidden states of the worlds of these seeds at a step, or `None` for each world if they are not
    /// published.
    fn states(&self, seeds: &[u64], step: u64) -> Result<Vec<Option<Grid<u8>>>> {
        let Some(truth) = &self.truth else {
            return Ok(vec![None; seeds.len()]);
        };
        let states = truth.states(0..seeds.len() as u32, seeds, step)?;
        Ok(states.into_iter().map(Some).collect())
    }

    fn robots(&self, seeds: &[u64]) -> Range<u32> {
        0..seeds.len() as u32 * self.info().n_robots
    }

    fn seen(&self, observations: Vec<Observation>, truths: &[Option<Grid<u8>>]) -> Vec<Seen> {
        let mut observations = observations.into_iter();
        let agents = truths.iter().flat_map(|truth| vec![truth; self.n_agents()]);
        let seen = agents.map(|truth| Seen {
            truth: truth.clone(),
            ..Seen::new(observations.by_ref().take(self.crew))
        });
        seen.collect()
    }
}

/// Worlds of an arena as an environment. Observations are ordered by world.
pub struct Batch<'a> {
    arena: &'a mut Arena,
    seeds: &'a [u64],
    step: u64,
}

impl Environment for Batch<'_> {
    fn fly(&mut self, paths: &[Vec<Move>]) -> Result<Option<Vec<Seen>>> {
        let arena = &mut *self.arena;
        let observations = arena.client.step(arena.robots(self.seeds), paths)?;
        let truth = arena.states(self.seeds, self.step)?;
        Ok(Some(arena.seen(observations, &truth)))
    }
}
