//! The benchmark: every policy on the same worlds, scored against the hidden states.

use crate::acting::team::Team;
use crate::benchmark::arena::Arena;
use crate::benchmark::report::PolicyRun;
use crate::benchmark::report::common_worlds::World;
use crate::benchmark::world_run::WorldRun;
use crate::client::view::view;
use anyhow::{Context, Result, ensure};
use emberwatch_acting::beliefs::first_belief::first_belief;
use emberwatch_acting::beliefs::{Conditions, Input, WorldForm};
use emberwatch_acting::config::AgentConfig;
use emberwatch_acting::learned::Learned;
use emberwatch_acting::parallel::in_parallel;
use emberwatch_acting::policy::Policy;
use emberwatch_acting::rollout::{
    self, Actor, Rollout, Seen, StepRecord, building, predict_all, see_all,
};
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::planning::Plan;
use emberwatch_belief::planning::team::robot_seed;
use emberwatch_protocol::feed::Feed;
use emberwatch_protocol::{Model, Move};
use std::ops::Range;
use std::time::{Duration, Instant};

/// The policy of [`Team::Oracle`].
const ORACLE: &str = "oracle_beam";

#[derive(Debug, Clone)]
pub struct Comparison {
    /// The policies, in the order of the table.
    pub policies: Vec<Policy>,
    /// Kinds of team. Each policy runs with each kind.
    pub teams: Vec<Team>,
    pub seeds: Range<u64>,
    pub steps: u64,
    pub config: AgentConfig,
    /// Learned models, for policies that use them.
    pub learned: Learned,
    /// Whether known-model beliefs start from each world's hidden state.
    pub first_state_known: bool,
}

#[derive(Debug, Default)]
pub struct Results {
    /// One run per policy, team and world, in the order of the policies.
    pub runs: Vec<PolicyRun>,
    /// Number of cells in the state with the highest reward, per step, averaged over worlds. The same for all policies.
    pub fire_cells: Vec<f32>,
}

/// Runs every policy on every world. Calls `progress` with a policy's name and the number of world steps just made.
pub fn compare(
    arena: &mut Arena,
    comparison: &Comparison,
    progress: &mut dyn FnMut(&str, u64),
) -> Result<Results> {
    let config = &comparison.config;
    let prior = config.prior(arena.info().burn_in);
    let prior = first_belief(prior, arena.known_model(), arena.shape(), config.seed)?;
    let seeds: Vec<u64> = comparison.seeds.clone().collect();
    let mut results = Results::default();
    let mut feed = arena.feed(prior.probabilities());
    let contestants = comparison.contestants(&arena.model);
    // Before other policies run for hours, refuse any policy that cannot run.
    for (policy, _) in &contestants {
        let checked = comparison.check(policy, arena);
        checked.with_context(|| format!("policy {:?}", policy.name))?;
    }
    for (index, (policy, team)) in contestants.iter().enumerate() {
        arena.fly_as(*team);
        for batch in seeds.chunks(arena.n_worlds as usize) {
            let started = comparison.start(policy, &prior, arena, batch, &mut feed);
            let played = started.and_then(|mut players| {
                for _ in 0..comparison.steps {
                    rollout::step(&mut players, arena)?;
                    progress(&policy.name, batch.len() as u64);
                }
                Ok(players.worlds)
            });
            let worlds = played.with_context(|| format!("policy {:?}", policy.name))?;
            if index == 0 {
                results.add_fire(1.0 / seeds.len() as f32, &worlds);
            }
            let runs = worlds.into_iter();
            let runs = runs.map(|world| world.into_run(policy, *team, arena.info()));
            results.runs.extend(runs);
        }
    }
    feed.end();
    Ok(results)
}

impl Comparison {
    /// Returns the worlds that each policy's rows have, in ascending order.
    pub fn worlds(&self, fingerprint: &str) -> Vec<World> {
        let world = |seed| (seed, self.steps, fingerprint.to_owned());
        self.seeds.clone().map(world).collect()
    }

    /// Returns each policy with each kind of team, but the oracle team only once.
    pub fn contestants(&self, model: &Model) -> Vec<(Policy, Team)> {
        let mut contestants = Vec::new();
        for &team in &self.teams {
            let oracle = Policy::named(ORACLE, model).expect("invariant: every model has it");
            match team {
                Team::Oracle => contestants.push((oracle, team)),
                _ => contestants.extend(self.policies.iter().map(|it| (it.clone(), team))),
            }
        }
        contestants
    }

    /// Checks that a policy can act in an arena.
    fn check(&self, policy: &Policy, arena: &mut Arena) -> Result<()> {
        let needs_truth = policy.belief.input == Input::States || self.first_state_known;
        ensure!(
            arena.has_truth() || !needs_truth,
            "it needs the truth channel: start the server with --publish-truth"
        );
        arena.check_model(policy)?;
        let world = WorldForm::of(&arena.model, arena.shape());
        building::check(policy, &self.learned, &world)
    }

    /// Starts a batch of worlds with the agents of a policy.
    fn start<'a>(
        &self,
        policy: &Policy,
        prior: &Belief,
        arena: &mut Arena,
        seeds: &[u64],
        feed: &'a mut Feed,
    ) -> Result<Players<'a>> {
        let seen = arena.reset(seeds)?;
        let n_agents = arena.n_agents();
        let mut rollouts = Vec::new();
        for (index, seen) in seen.into_iter().enumerate() {
            let (seed, number) = (seeds[index / n_agents], index % n_agents);
            // If the first state is known, the belief is certain.
            let known = seen.truth.as_ref().filter(|_| self.first_state_known);
            let n_states = arena.known_model().n_states();
            let certain = known.map(|states| Belief::from_states(states, n_states));
            let certain = certain.transpose()?;
            let conditions = Conditions {
                model: Some(arena.known_model()),
                shape: arena.shape(),
                prior: Some(certain.as_ref().unwrap_or(prior)),
                learned: &self.learned,
            };
            let seed = robot_seed(self.config.planner_seed(seed), number);
            let n_moves = arena.info().n_moves;
            let agent = building::agent(policy, &self.config, &conditions, n_moves, seed)?;
            rollouts.push(Rollout::begun(agent, seen)?);
        }
        let (target, n_robots) = (arena.model.target_state(), arena.n_robots());
        let world = |&seed| WorldRun::new(seed, arena.shape(), target);
        Ok(Players {
            rollouts,
            worlds: seeds.iter().map(world).collect(),
            plans: Vec::new(),
            n_robots,
            feed,
        })
    }
}

impl Results {
    fn add_fire(&mut self, share: f32, worlds: &[WorldRun]) {
        for cells in worlds.iter().map(|world| &world.fire_cells) {
            self.fire_cells.resize(cells.len(), 0.0);
            let both = self.fire_cells.iter_mut().zip(cells);
            both.for_each(|(mean, cells)| *mean += share * cells);
        }
    }
}

/// The agents of a batch of worlds, and the measurements of each world.
struct Players<'a> {
    /// One rollout per agent, ordered by world.
    rollouts: Vec<Rollout>,
    worlds: Vec<WorldRun>,
    /// Each agent's last plans, and the time that planning took.
    plans: Vec<(Vec<Plan>, Duration)>,
    /// Number of robots per world.
    n_robots: usize,
    feed: &'a mut Feed,
}

impl Actor for Players<'_> {
    fn plan(&mut self) -> Vec<Vec<Move>> {
        self.plans = in_parallel(&mut self.rollouts, |rollout| {
            let start = Instant::now();
            (rollout.plan(), start.elapsed())
        });
        let plans = self.plans.iter().flat_map(|(plans, _)| plans);
        plans.map(|plan| plan.moves.clone()).collect()
    }

    fn see(&mut self, seen: Vec<Seen>) -> Result<Vec<StepRecord>> {
        let records = see_all(&mut self.rollouts, seen)?;
        let n_agents = self.rollouts.len() / self.worlds.len();
        for (index, record) in records.iter().enumerate() {
            let (world, rollout) = (&mut self.worlds[index / n_agents], &self.rollouts[index]);
            let (plans, time) = &self.plans[index];
            world.count(rollout, plans, *time, self.n_robots);
            if index % n_agents == 0 {
                world.score(rollout, record.score);
            }
        }
        self.show(n_agents);
        Ok(records)
    }

    fn predict(&mut self) {
        predict_all(&mut self.rollouts);
    }
}

impl Players<'_> {
    /// Publishes the posterior of each agent that is due to be shown to observers.
    fn show(&mut self, n_agents: usize) {
        let crew = (self.n_robots / n_agents) as u32;
        for index in self.feed.due(self.rollouts.len()) {
            let (world, robot) = ((index / n_agents) as u32, index as u32 * crew);
            let (rollout, (_, time)) = (&self.rollouts[index], &self.plans[index]);
            self.feed
                .show(&view(rollout, world, robot..robot + crew, *time));
        }
    }
}
