//! The benchmark: every policy on the same worlds, scored against the hidden states.

use crate::acting::team::Team;
use crate::benchmark::compared_worlds::ComparedWorlds;
use crate::benchmark::report::PolicyRun;
use crate::benchmark::report::common_worlds::World;
use crate::benchmark::run_tally::RunTally;
use crate::client::info::warn_of_other_worlds;
use crate::client::view::view;
use anyhow::{Context, Result, ensure};
use emberwatch_acting::beliefs::first_belief::first_belief;
use emberwatch_acting::beliefs::{Conditions, Input, WorldForm};
use emberwatch_acting::config::AgentConfig;
use emberwatch_acting::learned::Learned;
use emberwatch_acting::parallel::in_parallel;
use emberwatch_acting::policy::Policy;
use emberwatch_acting::rollout::{
    self, ActingAgent, Actor, AgentObservation, StepRecord, building, predict_all, see_all,
};
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::planning::Plan;
use emberwatch_belief::planning::team::robot_seed;
use emberwatch_protocol::Move;
use emberwatch_protocol::feed::Feed;
use std::ops::Range;
use std::time::{Duration, Instant};

#[derive(Clone)]
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
}

/// Runs every policy on every world. Calls `progress` with a policy's name and the number of world steps just made.
pub fn compare(
    worlds: &mut ComparedWorlds,
    comparison: &Comparison,
    progress: &mut dyn FnMut(&str, u64),
) -> Result<Vec<PolicyRun>> {
    let config = &comparison.config;
    let prior = config.prior(worlds.info().burn_in);
    let prior = first_belief(prior, worlds.known_model(), worlds.shape(), config.seed)?;
    let seeds: Vec<u64> = comparison.seeds.clone().collect();
    warn_of_other_worlds(&comparison.learned, worlds.info());
    let mut runs = Vec::new();
    let mut feed = worlds.feed(prior.probabilities());
    let entries = comparison.entries();
    // Before other policies run for hours, refuse any policy that cannot run.
    for (policy, _) in &entries {
        let checked = comparison.check(policy, worlds);
        checked.with_context(|| format!("policy {:?}", policy.name))?;
    }
    for (policy, team) in &entries {
        worlds.set_team(*team);
        for batch in seeds.chunks(worlds.n_worlds as usize) {
            let started = comparison.start(policy, &prior, worlds, batch, &mut feed);
            let played = started.and_then(|mut agents| {
                for _ in 0..comparison.steps {
                    rollout::step(&mut agents, worlds)?;
                    progress(&policy.name, batch.len() as u64);
                }
                Ok(agents.tallies)
            });
            let tallies = played.with_context(|| format!("policy {:?}", policy.name))?;
            let tallies = tallies.into_iter();
            runs.extend(tallies.map(|tally| tally.into_run(policy, *team, worlds.info())));
        }
    }
    feed.end();
    Ok(runs)
}

impl Comparison {
    /// Returns the worlds that each policy's rows have, in ascending order.
    pub fn worlds(&self, fingerprint: &str) -> Vec<World> {
        let world = |seed| (seed, self.steps, fingerprint.to_owned());
        self.seeds.clone().map(world).collect()
    }

    /// Returns each policy with each kind of team.
    pub fn entries(&self) -> Vec<(Policy, Team)> {
        let teams = self.teams.iter();
        let entries =
            teams.flat_map(|&team| self.policies.iter().map(move |it| (it.clone(), team)));
        entries.collect()
    }

    fn check(&self, policy: &Policy, worlds: &mut ComparedWorlds) -> Result<()> {
        ensure!(
            worlds.has_truth() || policy.belief.input != Input::States,
            "it needs the truth channel: start the server with --publish-truth"
        );
        worlds.check_model(policy)?;
        let world = WorldForm::of(&worlds.model, worlds.shape());
        building::check(policy, &self.learned, &world)
    }

    fn start<'a>(
        &self,
        policy: &Policy,
        prior: &Belief,
        worlds: &mut ComparedWorlds,
        seeds: &[u64],
        feed: &'a mut Feed,
    ) -> Result<MeasuredAgents<'a>> {
        let seen = worlds.reset(seeds)?;
        let n_agents = worlds.n_agents();
        let mut agents = Vec::new();
        for (index, seen) in seen.into_iter().enumerate() {
            let (seed, number) = (seeds[index / n_agents], index % n_agents);
            let conditions = Conditions {
                model: Some(worlds.known_model()),
                shape: worlds.shape(),
                prior: Some(prior),
                learned: &self.learned,
            };
            let seed = robot_seed(self.config.planner_seed(seed), number);
            let n_moves = worlds.info().n_moves;
            let agent = building::agent(policy, &self.config, &conditions, n_moves, seed)?;
            agents.push(ActingAgent::begun(agent, seen)?);
        }
        let (target, n_robots) = (worlds.model.target_state(), worlds.n_robots());
        let tally = |&seed| RunTally::new(seed, worlds.shape(), target);
        Ok(MeasuredAgents {
            agents,
            tallies: seeds.iter().map(tally).collect(),
            plans: Vec::new(),
            n_robots,
            feed,
        })
    }
}

struct MeasuredAgents<'a> {
    /// Ordered by world.
    agents: Vec<ActingAgent>,
    tallies: Vec<RunTally>,
    plans: Vec<(Vec<Plan>, Duration)>,
    n_robots: usize,
    feed: &'a mut Feed,
}

impl Actor for MeasuredAgents<'_> {
    fn plan(&mut self) -> Vec<Vec<Move>> {
        self.plans = in_parallel(&mut self.agents, |acting| {
            let start = Instant::now();
            (acting.plan(), start.elapsed())
        });
        let plans = self.plans.iter().flat_map(|(plans, _)| plans);
        plans.map(|plan| plan.moves.clone()).collect()
    }

    fn see(&mut self, seen: Vec<AgentObservation>) -> Result<Vec<StepRecord>> {
        let records = see_all(&mut self.agents, seen)?;
        let n_agents = self.agents.len() / self.tallies.len();
        for (index, record) in records.iter().enumerate() {
            let (tally, acting) = (&mut self.tallies[index / n_agents], &self.agents[index]);
            let (plans, time) = &self.plans[index];
            tally.count(acting, plans, *time, self.n_robots);
            if index % n_agents == 0 {
                tally.score(acting, record.score);
            }
        }
        self.show(n_agents);
        Ok(records)
    }

    fn predict(&mut self) {
        predict_all(&mut self.agents);
    }
}

impl MeasuredAgents<'_> {
    fn show(&mut self, n_agents: usize) {
        let n_own = (self.n_robots / n_agents) as u32;
        for index in self.feed.due(self.agents.len()) {
            let (world, robot) = ((index / n_agents) as u32, index as u32 * n_own);
            let (acting, (_, time)) = (&self.agents[index], &self.plans[index]);
            self.feed
                .show(&view(acting, world, robot..robot + n_own, *time));
        }
    }
}
