//! The benchmark: every policy on the same worlds, scored against the hidden states.

use crate::benchmark::arena::Arena;
use crate::benchmark::report::{PolicyRun, Snapshot};
use crate::benchmark::team::Team;
use crate::client::view::view;
use anyhow::{Context, Result, ensure};
use emberwatch_belief::brier::brier_score;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::scoring::Score;
use emberwatch_belief::merit::{Found, MeritTally};
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
use emberwatch_protocol::message::WorldResult;
use emberwatch_protocol::path::Flight;
use emberwatch_protocol::{Grid, Model, Move};
use sha2::{Digest, Sha256};
use std::borrow::Cow;
use std::ops::Range;
use std::time::{Duration, Instant};

/// The policy of the team that is told the true states.
const ORACLE: &str = "oracle_beam";

#[derive(Debug, Clone)]
pub struct Comparison {
    /// The policies, in the order of the table.
    pub policies: Vec<Policy>,
    /// How the robots of a world act together, each with each policy.
    pub teams: Vec<Team>,
    pub seeds: Range<u64>,
    pub steps: u64,
    /// Steps for which a cell counts as seen after a visit, at least 1.
    pub recent_steps: u32,
    pub config: AgentConfig,
    /// What was learned, for policies that act on it.
    pub learned: Learned,
    /// Whether beliefs of a known model begin with each world's hidden state.
    pub first_state_known: bool,
}

#[derive(Debug)]
pub struct Results {
    /// One run per policy, team and world, in the order of the policies.
    pub runs: Vec<PolicyRun>,
    /// Cells in the state that pays most, per step, means over worlds: the same for all policies.
    pub fire_cells: Vec<f32>,
    /// The end of the first world's run, of its first robot, with the last policy whose snapshot tells most.
    pub snapshot: Option<Snapshot>,
}

/// One policy, and how the robots of a world act on it.
#[derive(Debug, Clone, PartialEq)]
struct Contestant {
    policy: Policy,
    team: Team,
}

/// What is measured of one world.
struct WorldRun {
    seed: u64,
    tally: Tally,
    /// This step's, until all robots have flown.
    flights: Vec<Flight>,
    merit: MeritTally,
    snapshot: Option<Snapshot>,
}

/// Sums over the steps of a run.
#[derive(Default)]
struct Tally {
    rewards: Vec<f32>,
    fire_cells: Vec<f32>,
    reward: f64,
    n_visited: u64,
    n_hits: u64,
    /// Distinct cells of each robot, all together.
    n_visited_each: u64,
    n_fire: u64,
    planning: Duration,
    /// Where the hidden states are published.
    brier: Option<f64>,
    score: Score,
}

/// Runs every policy on every world; `progress` is told of each policy and of each world step.
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
        snapshot: None,
    };
    let mut feed = Feed::open(arena.instance(), prior.probabilities());
    let contestants = comparison.contestants(arena.model());
    let game = |contestant, seeds| Match {
        comparison,
        contestant,
        prior: &prior,
        seeds,
    };
    // What does not fit is refused before hours of what does.
    for contestant in &contestants {
        let checked = game(contestant, &seeds[..1]).check(arena);
        checked.with_context(|| format!("policy {:?}", contestant.policy.name))?;
    }
    for contestant in &contestants {
        for batch in seeds.chunks(arena.batch_size()) {
            let game = game(contestant, batch);
            let runs = game.play(arena, &mut feed, progress);
            let mut worlds =
                runs.with_context(|| format!("policy {:?}", contestant.policy.name))?;
            if *contestant == contestants[0] {
                let share = 1.0 / seeds.len() as f32;
                results.add_fire(share, &worlds);
            }
            if batch[0] == comparison.seeds.start {
                let both = [results.snapshot, worlds[0].snapshot.take()];
                results.snapshot = both.into_iter().flatten().max_by_key(Snapshot::rank);
            }
            let model = arena.known_model();
            let fingerprint = comparison.policy_fingerprint(&contestant.policy, model);
            let runs = worlds.into_iter();
            let runs = runs.map(|world| contestant.policy_run(world, arena.info(), &fingerprint));
            results.runs.extend(runs);
        }
    }
    feed.end();
    Ok(results)
}

impl Comparison {
    /// Pairs of a policy and a team that are compared.
    pub fn n_contestants(&self) -> usize {
        let n_policies = |team: &Team| match team {
            Team::Oracle => 1,
            _ => self.policies.len(),
        };
        self.teams.iter().map(n_policies).sum()
    }

    /// Returns 16 hexadecimal digits that identify all that a policy's actions depend on, besides its name and the worlds.
    pub fn policy_fingerprint(&self, policy: &Policy, model: &Model) -> String {
        let learned = policy.needs_checkpoint().then_some(&self.learned.digests);
        let model = toml::to_string(model.file()).expect("invariant: model files serialise");
        let config = toml::to_string(&self.config).expect("invariant: settings serialise");
        let version = env!("CARGO_PKG_VERSION");
        let mut text = format!("{version}\n{model}\n{config}\n{learned:?}");
        if self.first_state_known {
            text += "\nfirst state known";
        }
        let hash = Sha256::digest(text);
        hash[..8].iter().map(|byte| format!("{byte:02x}")).collect()
    }

    /// Each policy with each team, but the oracle once.
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
    /// Refuses a contestant that cannot act.
    fn check(&self, arena: &Arena) -> Result<()> {
        let policy = &self.contestant.policy;
        let is_told = matches!(policy.belief.input, Input::States | Input::NextStates);
        ensure!(
            arena.shows_truth() || !(is_told || self.comparison.first_state_known),
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
            if self.contestant.policy.belief.input == Input::NextStates {
                players.foresee(&arena.foresee(self.seeds, step)?)?;
            }
            players.is_last = step == self.comparison.steps;
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
        let world = |&seed: &u64| WorldRun {
            seed,
            tally: Tally::default(),
            flights: Vec::new(),
            merit: MeritTally::new(arena.shape(), target as u8, recent_steps),
            snapshot: None,
        };
        Ok(Players {
            rollouts: agents.zip(seen).map(rollout).collect::<Result<_>>()?,
            worlds: self.seeds.iter().map(world).collect(),
            plans: Vec::new(),
            target,
            first_world: arena.worlds().start,
            n_robots: arena.n_robots(),
            is_last: false,
            feed,
        })
    }

    fn agent(&self, arena: &Arena, prior: &Belief, agent: (u64, usize)) -> Result<Agent> {
        let Comparison {
            config, learned, ..
        } = self.comparison;
        arena.agent(&self.contestant.policy, config, prior, agent, learned)
    }

    /// An agent's first belief, which is certain if the first state is known.
    fn prior(&self, arena: &Arena, seen: &Seen) -> Result<Cow<'_, Belief>> {
        if !self.comparison.first_state_known {
            return Ok(Cow::Borrowed(self.prior));
        }
        let states = seen.truth.as_ref();
        let states = states.context("expected published hidden states, got none")?;
        let certain = Belief::from_states(states, arena.known_model().n_states())?;
        Ok(Cow::Owned(certain))
    }
}

/// The agents of a batch of worlds, and what is measured of each world.
struct Players<'a> {
    /// World by world.
    rollouts: Vec<Rollout>,
    worlds: Vec<WorldRun>,
    /// The last plans of each agent, and the time that they took.
    plans: Vec<(Vec<Plan>, Duration)>,
    /// The state that pays most.
    target: usize,
    first_world: u32,
    /// Robots of each world.
    n_robots: usize,
    is_last: bool,
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
    /// Agents of each world.
    fn n_agents(&self) -> usize {
        self.rollouts.len() / self.worlds.len()
    }

    /// Tells clairvoyants the states that their next paths will meet, world by world.
    fn foresee(&mut self, next: &[Grid<u8>]) -> Result<()> {
        let n_agents = self.n_agents();
        for (rollouts, next) in self.rollouts.chunks_mut(n_agents).zip(next) {
            for rollout in rollouts {
                rollout.agent.foresee(next)?;
            }
        }
        Ok(())
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
                if self.is_last {
                    world.snapshot = world.snapshot(rollout, record, plans);
                }
            }
        }
    }

    /// Shows the posteriors of the worlds whose turn it is.
    fn show(&mut self) {
        let (n_agents, n_robots) = (self.n_agents(), self.n_robots as u32);
        let crew = n_robots / n_agents as u32;
        for index in self.feed.due(self.rollouts.len()) {
            let world = self.first_world + (index / n_agents) as u32;
            let robot = self.first_world * n_robots + index as u32 * crew;
            let (rollout, (_, time)) = (&self.rollouts[index], &self.plans[index]);
            let view = view(rollout, world, robot..robot + crew, *time);
            self.feed.show(&view);
        }
    }
}

impl WorldRun {
    /// Counts what an agent's robots visited; with those of the last agent the step is complete.
    fn count(&mut self, rollout: &Rollout, plans: &[Plan], n_robots: usize) {
        let airspace = rollout.agent.airspace();
        let flown = rollout.results().zip(plans);
        let flown = flown.map(|(result, plan)| airspace.fly(result.start(), &plan.moves));
        self.flights.extend(flown);
        let n_visited = rollout.results().map(|it| u64::from(it.n_visited));
        self.tally.n_visited_each += n_visited.sum::<u64>();
        if self.flights.len() == n_robots {
            let result = &rollout.observation().world;
            let found = Found {
                n_hits: result.n_hits,
                n_burning: result.n_target_cells,
            };
            self.merit.update(&self.flights, found, rollout.truth());
            self.flights.clear();
        }
    }

    /// Scores the posterior of the world's first agent.
    fn score(&mut self, rollout: &Rollout, target: usize, score: Option<Score>) {
        let agent = &rollout.agent;
        let brier = rollout
            .truth()
            .map(|truth| brier_score(agent.belief(), truth, target, agent.target()));
        self.tally.add(&rollout.observation().world, brier);
        self.tally.score += score.unwrap_or_default();
    }

    fn snapshot(&self, rollout: &Rollout, record: &StepRecord, plans: &[Plan]) -> Option<Snapshot> {
        let (agent, observation) = (&rollout.agent, rollout.observation());
        let (airspace, start) = (agent.airspace(), record.before.robot.cell());
        let belief = agent.policy().belief;
        let moves = &plans[0].moves;
        let mut path_cells = vec![start];
        path_cells.extend((1..=moves.len()).map(|n| airspace.fly(start, &moves[..n]).end));
        Some(Snapshot {
            seed: self.seed,
            step: observation.world.step,
            truth: rollout.truth()?.clone(),
            frame: observation.frame.clone(),
            path_cells,
            belief: (belief.input == Input::Frames).then(|| agent.belief().clone()),
            learned_target: belief.learned_by.is_some().then(|| agent.target()),
        })
    }
}

/// An agent's plans, and the time that they took.
fn timed_plan(rollout: &mut Rollout) -> (Vec<Plan>, Duration) {
    let start = Instant::now();
    (rollout.plan(), start.elapsed())
}

impl Contestant {
    fn policy_run(&self, world: WorldRun, info: &ServerInfo, fingerprint: &str) -> PolicyRun {
        let (tally, policy, merit) = (world.tally, &self.policy, world.merit.merit());
        let steps = tally.rewards.len() as u64;
        let brier = tally.brier;
        let brier = brier.filter(|_| policy.belief.input != Input::Nothing);
        let mean = |sum: f64| sum / steps.max(1) as f64;
        let share = |n: u64, of: u64| n as f64 / of.max(1) as f64;
        let n_repeated = tally.n_visited_each - tally.n_visited;
        PolicyRun {
            policy: policy.name.clone(),
            estimator: policy.belief.label.into(),
            world_seed: world.seed,
            steps,
            mean_reward: mean(tally.reward),
            mean_distinct_cells: mean(tally.n_visited as f64),
            hit_rate: share(tally.n_hits, tally.n_visited),
            mean_fire_cells: mean(tally.n_fire as f64),
            mean_plan_millis: mean(tally.planning.as_secs_f64() * 1e3),
            brier: brier.map(mean),
            moves: info.n_moves,
            robots: info.n_robots,
            team: self.team.label().into(),
            mean_repeated: share(n_repeated, tally.n_visited_each),
            steps_to_detection: merit.steps_to_detection,
            burning_cells_at_detection: merit.burning_cells_at_detection,
            recent_steps: Some(world.merit.recent_steps()),
            burning_seen_share: merit.burning_seen_share,
            front_distance: merit.front_distance,
            grid_seen_share: Some(merit.grid_seen_share),
            log_likelihood: (tally.score.n_seen > 0).then(|| tally.score.mean()),
            worlds_fingerprint: info.worlds_fingerprint.clone().unwrap_or_default(),
            policy_fingerprint: fingerprint.into(),
            training_seconds: None,
            is_added: false,
            rewards: tally.rewards,
        }
    }
}

impl Tally {
    fn add(&mut self, result: &WorldResult, brier: Option<f64>) {
        self.rewards.push(result.reward as f32);
        self.fire_cells.push(result.n_target_cells as f32);
        self.reward += result.reward;
        self.n_visited += u64::from(result.n_visited);
        self.n_hits += u64::from(result.n_hits);
        self.n_fire += u64::from(result.n_target_cells);
        self.brier = brier.map(|brier| self.brier.unwrap_or_default() + brier);
    }
}
