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
use emberwatch_learning::config::AgentConfig;
use emberwatch_learning::estimation::first_belief::first_belief;
use emberwatch_learning::learned::Learned;
use emberwatch_learning::policy::{EstimatorKind, Policy};
use emberwatch_learning::rollout::agent::Agent;
use emberwatch_learning::rollout::{Rollout, Turn, in_parallel, paths_of, predict_all, see_all};
use emberwatch_protocol::Model;
use emberwatch_protocol::control::ServerInfo;
use emberwatch_protocol::feed::Feed;
use emberwatch_protocol::message::WorldResult;
use emberwatch_protocol::path::Flight;
use sha2::{Digest, Sha256};
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

struct Runs {
    /// The agents of each world, world by world.
    rollouts: Vec<Rollout>,
    worlds: Vec<World>,
}

struct World {
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
    let prior = first_belief(prior, arena.model(), arena.shape(), comparison.config.seed)?;
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
            let fingerprint = comparison.policy_fingerprint(&contestant.policy, arena.model());
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
        let hash = Sha256::digest(format!("{version}\n{model}\n{config}\n{learned:?}"));
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
    fn add_fire(&mut self, share: f32, worlds: &[World]) {
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
        let Contestant { policy, team } = self.contestant;
        ensure!(
            !(policy.is_decided() && team.is_joint() && arena.n_robots() > 1),
            "it decides for one robot: expected --team alone or shared, got {}",
            team.label()
        );
        let is_told = matches!(
            policy.estimator,
            EstimatorKind::Truth | EstimatorKind::NextTruth
        );
        ensure!(
            arena.shows_truth() || !is_told,
            "it needs the truth channel: start the server with --publish-truth"
        );
        self.agent(arena, (self.seeds[0], 0)).map(drop)
    }

    fn play(
        &self,
        arena: &mut Arena,
        feed: &mut Feed,
        progress: &dyn Fn(&str, u64),
    ) -> Result<Vec<World>> {
        arena.fly_as(self.contestant.team);
        let mut runs = self.start(arena)?;
        for step in 0..self.comparison.steps {
            self.step(arena, feed, &mut runs, step)?;
            progress(&self.contestant.policy.name, runs.worlds.len() as u64);
        }
        Ok(runs.worlds)
    }

    fn start(&self, arena: &mut Arena) -> Result<Runs> {
        let n_agents = arena.n_agents();
        let agents = self.seeds.iter();
        let agents = agents.flat_map(|&seed| (0..n_agents).map(move |number| (seed, number)));
        let seen = arena.reset(self.seeds)?;
        let rollout = |(agent, seen)| Rollout::begun(self.agent(arena, agent)?, seen);
        let (target, recent_steps) = (arena.model().target_state(), self.comparison.recent_steps);
        let world = |&seed: &u64| World {
            seed,
            tally: Tally::default(),
            flights: Vec::new(),
            merit: MeritTally::new(arena.shape(), target as u8, recent_steps),
            snapshot: None,
        };
        Ok(Runs {
            rollouts: agents.zip(seen).map(rollout).collect::<Result<_>>()?,
            worlds: self.seeds.iter().map(world).collect(),
        })
    }

    fn step(&self, arena: &mut Arena, feed: &mut Feed, runs: &mut Runs, step: u64) -> Result<()> {
        let Runs { rollouts, worlds } = runs;
        let n_agents = arena.n_agents();
        if self.contestant.policy.estimator == EstimatorKind::NextTruth {
            let next = arena.foresee(self.seeds, step + 1)?;
            for (rollouts, next) in rollouts.chunks_mut(n_agents).zip(&next) {
                for rollout in rollouts {
                    rollout.agent.foresee(next)?;
                }
            }
        }
        let plans = in_parallel(&mut *rollouts, timed_plan);
        let (plans, times): (Vec<_>, Vec<_>) = plans.into_iter().unzip();
        let seen = arena.step(self.seeds, &paths_of(&plans), step + 1)?;
        let turns = see_all(&mut *rollouts, seen)?;
        let is_last = step + 1 == self.comparison.steps;
        let target = arena.model().target_state();
        for (index, turn) in turns.into_iter().enumerate() {
            let (world, rollout) = (&mut worlds[index / n_agents], &rollouts[index]);
            let plans = &plans[index];
            world.tally.planning += times[index];
            world.fly(rollout, plans, arena.n_robots());
            if index % n_agents == 0 {
                world.look(rollout, target, turn.score);
                if is_last {
                    world.snapshot = world.snapshot(rollout, turn, plans);
                }
            }
        }
        self.show(arena, feed, rollouts, &times);
        predict_all(rollouts);
        Ok(())
    }

    /// Shows the posteriors of the worlds whose turn it is.
    fn show(&self, arena: &Arena, feed: &mut Feed, rollouts: &[Rollout], times: &[Duration]) {
        let (n_agents, n_robots) = (arena.n_agents(), arena.n_robots() as u32);
        let (first_world, crew) = (arena.worlds().start, n_robots / n_agents as u32);
        for index in feed.turn(rollouts.len()) {
            let world = first_world + (index / n_agents) as u32;
            let robot = first_world * n_robots + index as u32 * crew;
            let view = view(&rollouts[index], world, robot..robot + crew, times[index]);
            feed.show(&view);
        }
    }

    fn agent(&self, arena: &Arena, agent: (u64, usize)) -> Result<Agent> {
        let Comparison {
            config, learned, ..
        } = self.comparison;
        arena.agent(&self.contestant.policy, config, self.prior, agent, learned)
    }
}

impl World {
    /// Takes in what an agent's robots flew; with those of the last agent the step is complete.
    fn fly(&mut self, rollout: &Rollout, plans: &[Plan], n_robots: usize) {
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

    /// Takes in the posterior of the world's first agent.
    fn look(&mut self, rollout: &Rollout, target: usize, score: Option<Score>) {
        let agent = &rollout.agent;
        let brier = rollout
            .truth()
            .map(|truth| brier_score(agent.belief(), truth, target, agent.target()));
        self.tally.add(&rollout.observation().world, brier);
        self.tally.score += score.unwrap_or_default();
    }

    fn snapshot(&self, rollout: &Rollout, turn: Turn, plans: &[Plan]) -> Option<Snapshot> {
        let (agent, observation) = (&rollout.agent, rollout.observation());
        let (airspace, start) = (agent.airspace(), turn.before.robot.cell());
        let estimator = agent.policy().estimator;
        let moves = &plans[0].moves;
        let mut path_cells = vec![start];
        path_cells.extend((1..=moves.len()).map(|n| airspace.fly(start, &moves[..n]).end));
        Some(Snapshot {
            seed: self.seed,
            step: observation.world.step,
            truth: rollout.truth()?.clone(),
            frame: observation.frame.clone(),
            path_cells,
            belief: estimator.sees_frames().then(|| agent.belief().clone()),
            learned_target: estimator.is_learned().then(|| agent.target()),
        })
    }
}

/// An agent's plans, and the time that they took.
fn timed_plan(rollout: &mut Rollout) -> (Vec<Plan>, Duration) {
    let start = Instant::now();
    (rollout.plan(), start.elapsed())
}

impl Contestant {
    fn policy_run(&self, world: World, info: &ServerInfo, fingerprint: &str) -> PolicyRun {
        let (tally, policy, merit) = (world.tally, &self.policy, world.merit.merit());
        let steps = tally.rewards.len() as u64;
        let brier = tally.brier;
        let brier = brier.filter(|_| policy.estimator != EstimatorKind::None);
        let mean = |sum: f64| sum / steps.max(1) as f64;
        let share = |n: u64, of: u64| n as f64 / of.max(1) as f64;
        let n_repeated = tally.n_visited_each - tally.n_visited;
        PolicyRun {
            policy: policy.name.clone(),
            estimator: policy.estimator.label(),
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
