//! The benchmark: every policy on the same worlds, scored against the hidden states.

use crate::benchmark::arena::Arena;
use crate::benchmark::report::PolicyRun;
use crate::benchmark::report::common_worlds::World;
use crate::benchmark::team::Team;
use crate::benchmark::world_run::WorldRun;
use crate::client::view::view;
use anyhow::{Context, Result, ensure};
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::planning::Plan;
use emberwatch_learning::beliefs::first_belief::first_belief;
use emberwatch_learning::beliefs::{Input, WorldForm};
use emberwatch_learning::config::AgentConfig;
use emberwatch_learning::learned::Learned;
use emberwatch_learning::parallel::in_parallel;
use emberwatch_learning::policy::Policy;
use emberwatch_learning::rollout::agent::Agent;
use emberwatch_learning::rollout::{
    self, Actor, Rollout, Seen, StepRecord, building, predict_all, see_all,
};
use emberwatch_protocol::control::ServerInfo;
use emberwatch_protocol::feed::Feed;
use emberwatch_protocol::{Model, Move};
use std::borrow::Cow;
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
    /// Steps for which a cell counts as seen after a visit, at least 1.
    pub recent_steps: u32,
    pub config: AgentConfig,
    /// Learned models, for policies that use them.
    pub learned: Learned,
    /// Whether known-model beliefs start from each world's hidden state.
    pub first_state_known: bool,
}

#[derive(Debug)]
pub struct Results {
    /// One run per policy, team and world, in the order of the policies.
    pub runs: Vec<PolicyRun>,
    /// Number of cells in the state with the highest reward, per step, averaged over worlds. The same for all policies.
    pub fire_cells: Vec<f32>,
}

/// One policy with one kind of team.
#[derive(Debug, Clone, PartialEq)]
struct Contestant {
    policy: Policy,
    team: Team,
}

/// Runs every policy on every world. Calls `progress` with a policy's name and the number of world steps just made.
pub fn compare(
    arena: &mut Arena,
    comparison: &Comparison,
    progress: &dyn Fn(&str, u64),
) -> Result<Results> {
    let prior = comparison.config.prior(arena.info().burn_in);
    let prior = first_belief(
        prior,
        arena.known_model(),
        arena.shape(),
        comparison.config.seed,
    )?;
    let seeds: Vec<u64> = comparison.seeds.clone().collect();
    let mut results = Results {
        runs: Vec::new(),
        fire_cells: Vec::new(),
    };
    let mut feed = Feed::open(arena.instance(), prior.probabilities());
    let contestants = comparison.contestants(arena.model());
    let game = |contestant, seeds| Match {
        comparison,
        contestant,
        prior: &prior,
        seeds,
    };
    // Before other policies run for hours, refuse any policy that cannot run.
    for contestant in &contestants {
        let checked = game(contestant, &seeds[..1]).check(arena);
        checked.with_context(|| format!("policy {:?}", contestant.policy.name))?;
    }
    for contestant in &contestants {
        for batch in seeds.chunks(arena.batch_size()) {
            let game = game(contestant, batch);
            let runs = game.play(arena, &mut feed, progress);
            let worlds = runs.with_context(|| format!("policy {:?}", contestant.policy.name))?;
            if *contestant == contestants[0] {
                let share = 1.0 / seeds.len() as f32;
                results.add_fire(share, &worlds);
            }
            let runs = worlds.into_iter();
            let Contestant { policy, team } = contestant;
            let runs = runs.map(|world| world.into_run(policy, *team, arena.info()));
            results.runs.extend(runs);
        }
    }
    feed.end();
    Ok(results)
}

impl Comparison {
    /// Returns the number of pairs of a policy and a kind of team.
    pub fn n_contestants(&self) -> usize {
        let n_policies = |team: &Team| match team {
            Team::Oracle => 1,
            _ => self.policies.len(),
        };
        self.teams.iter().map(n_policies).sum()
    }

    /// Returns the worlds that each policy's rows have, in ascending order.
    pub fn worlds(&self, info: &ServerInfo) -> Vec<World> {
        let fingerprint = info.worlds_fingerprint.clone().unwrap_or_default();
        let world = |seed| (seed, self.steps, fingerprint.clone());
        self.seeds.clone().map(world).collect()
    }

    /// Returns each policy with each kind of team, but the oracle team only once.
    fn contestants(&self, model: &Model) -> Vec<Contestant> {
        let of_team = |&team: &Team| {
            let policies = match team {
                Team::Oracle => {
                    let oracle = Policy::named(ORACLE, model);
                    vec![oracle.expect("invariant: every model has it")]
                }
                _ => self.policies.clone(),
            };
            policies
                .into_iter()
                .map(move |policy| Contestant { policy, team })
        };
        self.teams.iter().flat_map(of_team).collect()
    }
}

impl Results {
    fn add_fire(&mut self, share: f32, worlds: &[WorldRun]) {
        for cells in worlds.iter().map(|world| &world.tally.fire_cells) {
            self.fire_cells.resize(cells.len(), 0.0);
            let both = self.fire_cells.iter_mut().zip(cells);
            both.for_each(|(mean, cells)| *mean += share * cells);
        }
    }
}

/// One contestant on one batch of worlds.
struct Match<'a> {
    comparison: &'a Comparison,
    contestant: &'a Contestant,
    prior: &'a Belief,
    seeds: &'a [u64],
}

impl Match<'_> {
    /// Checks that the contestant can act in the arena.
    fn check(&self, arena: &Arena) -> Result<()> {
        let policy = &self.contestant.policy;
        let needs_truth = policy.belief.input == Input::States;
        ensure!(
            arena.shows_truth() || !(needs_truth || self.comparison.first_state_known),
            "it needs the truth channel: start the server with --publish-truth"
        );
        arena.check_model(policy)?;
        let world = WorldForm::of(arena.model(), arena.shape());
        building::check(policy, &self.comparison.learned, &world)
    }

    fn play(
        &self,
        arena: &mut Arena,
        feed: &mut Feed,
        progress: &dyn Fn(&str, u64),
    ) -> Result<Vec<WorldRun>> {
        arena.fly_as(self.contestant.team);
        let mut players = self.start(arena, feed)?;
        for step in 1..=self.comparison.steps {
            rollout::step(&mut players, &mut arena.batch(self.seeds, step))?;
            progress(&self.contestant.policy.name, players.worlds.len() as u64);
        }
        Ok(players.worlds)
    }

    fn start<'a>(&self, arena: &mut Arena, feed: &'a mut Feed) -> Result<Players<'a>> {
        let n_agents = arena.n_agents();
        let agents = self.seeds.iter();
        let agents = agents.flat_map(|&seed| (0..n_agents).map(move |number| (seed, number)));
        let seen = arena.reset(self.seeds)?;
        let rollout = |(agent, seen)| {
            let prior = self.prior(arena, &seen)?;
            Rollout::begun(self.agent(arena, &prior, agent)?, seen)
        };
        let (target, recent_steps) = (arena.model().target_state(), self.comparison.recent_steps);
        let world = |&seed: &u64| WorldRun::new(seed, arena.shape(), target, recent_steps);
        Ok(Players {
            rollouts: agents.zip(seen).map(rollout).collect::<Result<_>>()?,
            worlds: self.seeds.iter().map(world).collect(),
            plans: Vec::new(),
            target,
            n_robots: arena.n_robots(),
            feed,
        })
    }

    fn agent(&self, arena: &Arena, prior: &Belief, agent: (u64, usize)) -> Result<Agent> {
        let Comparison {
            config, learned, ..
        } = self.comparison;
        arena.agent(&self.contestant.policy, config, prior, agent, learned)
    }

    /// Returns an agent's first belief. If the first state is known, the belief is certain.
    fn prior(&self, arena: &Arena, seen: &Seen) -> Result<Cow<'_, Belief>> {
        if !self.comparison.first_state_known {
            return Ok(Cow::Borrowed(self.prior));
        }
        let states = seen.truth.as_ref();
        let states = states.context(
            "the first belief needs the truth channel: start the server with --publish-truth",
        )?;
        let certain = Belief::from_states(states, arena.known_model().n_states())?;
        Ok(Cow::Owned(certain))
    }
}

/// The agents of a batch of worlds, and the measurements of each world.
struct Players<'a> {
    /// One rollout per agent, ordered by world.
    rollouts: Vec<Rollout>,
    worlds: Vec<WorldRun>,
    /// Each agent's last plans, and the time that planning took.
    plans: Vec<(Vec<Plan>, Duration)>,
    /// The state with the highest reward.
    target: usize,
    /// Number of robots per world.
    n_robots: usize,
    feed: &'a mut Feed,
}

impl Actor for Players<'_> {
    fn plan(&mut self) -> Vec<Vec<Move>> {
        self.plans = in_parallel(&mut self.rollouts, timed_plan);
        let plans = self.plans.iter().flat_map(|(plans, _)| plans);
        plans.map(|plan| plan.moves.clone()).collect()
    }

    fn see(&mut self, seen: Vec<Seen>) -> Result<Vec<StepRecord>> {
        let records = see_all(&mut self.rollouts, seen)?;
        self.measure(&records);
        self.show();
        Ok(records)
    }

    fn predict(&mut self) {
        predict_all(&mut self.rollouts);
    }
}

impl Players<'_> {
    /// Returns the number of agents per world.
    fn n_agents(&self) -> usize {
        self.rollouts.len() / self.worlds.len()
    }

    fn measure(&mut self, records: &[StepRecord]) {
        let n_agents = self.n_agents();
        for (index, record) in records.iter().enumerate() {
            let (world, rollout) = (&mut self.worlds[index / n_agents], &self.rollouts[index]);
            let (plans, time) = &self.plans[index];
            world.tally.planning += *time;
            world.count(rollout, plans, self.n_robots);
            if index % n_agents == 0 {
                world.score(rollout, self.target, record.score);
            }
        }
    }

    /// Publishes the posterior of each agent that is due to be shown to observers.
    fn show(&mut self) {
        let (n_agents, n_robots) = (self.n_agents(), self.n_robots as u32);
        let crew = n_robots / n_agents as u32;
        for index in self.feed.due(self.rollouts.len()) {
            let world = (index / n_agents) as u32;
            let robot = index as u32 * crew;
            let (rollout, (_, time)) = (&self.rollouts[index], &self.plans[index]);
            let view = view(rollout, world, robot..robot + crew, *time);
            self.feed.show(&view);
        }
    }
}

/// Returns an agent's plans, and the time that planning took.
fn timed_plan(rollout: &mut Rollout) -> (Vec<Plan>, Duration) {
    let start = Instant::now();
    (rollout.plan(), start.elapsed())
}
