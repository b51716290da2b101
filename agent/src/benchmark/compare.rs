//! The benchmark: every policy on the same worlds, scored against the hidden states.

use crate::benchmark::arena::Arena;
use crate::benchmark::report::{ALONE, PolicyRun, Snapshot};
use crate::config::AgentConfig;
use crate::estimation::belief::Belief;
use crate::estimation::first_belief::first_belief;
use crate::learning::learned::Learned;
use crate::planning::policy::{EstimatorKind, Policy};
use crate::rollout::agent::Agent;
use crate::rollout::{self, Robot, Seen, Turn};
use crate::server::client::Observation;
use crate::server::feed::Feed;
use anyhow::{Context, Result};
use protocol::Grid;
use protocol::path::fly;
use std::ops::Range;
use std::time::Duration;

const SHOWS_TRUTH: &str = "invariant: an arena shows hidden states";

/// What is compared.
#[derive(Debug, Clone)]
pub struct Comparison {
    /// The policies, in the order of the table.
    pub policies: Vec<Policy>,
    pub seeds: Range<u64>,
    /// Scored steps of each world.
    pub steps: u64,
    pub config: AgentConfig,
    /// What was learned, for policies that act on it.
    pub learned: Learned,
}

/// What came out.
#[derive(Debug)]
pub struct Results {
    /// One run per policy and world, in the order of the policies.
    pub runs: Vec<PolicyRun>,
    /// Cells in the state that pays most, per step, means over worlds: the same for all policies.
    pub fire_cells: Vec<f32>,
    /// The end of the first world's run of the last policy with a belief of its own.
    pub snapshot: Option<Snapshot>,
}

/// One world's run of one policy.
struct Run {
    robot: Robot,
    seed: u64,
    tally: Tally,
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
    n_fire: u64,
    planning: Duration,
    brier: f64,
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
    let mut feed = Feed::open(arena.instance(), &prior);
    let n_moves = arena.info().n_moves;
    let game = |policy, seeds| Match {
        comparison,
        policy,
        prior: &prior,
        seeds,
    };
    // What does not fit is refused before hours of what does.
    for policy in &comparison.policies {
        let game = game(policy, &seeds[..1]);
        let agent = game.agent(arena, seeds[0]);
        agent.with_context(|| format!("policy {:?}", policy.name))?;
    }
    for policy in &comparison.policies {
        for batch in seeds.chunks(arena.batch_size()) {
            let game = game(policy, batch);
            let runs = game.play(arena, &mut feed, progress);
            let mut runs = runs.with_context(|| format!("policy {:?}", policy.name))?;
            if *policy == comparison.policies[0] {
                let share = 1.0 / seeds.len() as f32;
                results.add_fire(share, &runs);
            }
            if batch[0] == comparison.seeds.start {
                results.snapshot = runs[0].snapshot.take().or(results.snapshot);
            }
            results
                .runs
                .extend(runs.into_iter().map(|run| run.into_policy_run(n_moves)));
        }
    }
    feed.end();
    Ok(results)
}

impl Results {
    fn add_fire(&mut self, share: f32, runs: &[Run]) {
        for cells in runs.iter().map(|run| &run.tally.fire_cells) {
            self.fire_cells.resize(cells.len(), 0.0);
            let both = self.fire_cells.iter_mut().zip(cells);
            both.for_each(|(mean, cells)| *mean += share * cells);
        }
    }
}

/// One policy on one batch of worlds.
struct Match<'a> {
    comparison: &'a Comparison,
    policy: &'a Policy,
    prior: &'a Belief,
    seeds: &'a [u64],
}

impl Match<'_> {
    fn play(
        &self,
        arena: &mut Arena,
        feed: &mut Feed,
        progress: &dyn Fn(&str, u64),
    ) -> Result<Vec<Run>> {
        let mut runs = self.start(arena)?;
        for step in 0..self.comparison.steps {
            self.step(arena, feed, &mut runs, step)?;
            progress(&self.policy.name, runs.len() as u64);
        }
        Ok(runs)
    }

    fn start(&self, arena: &mut Arena) -> Result<Vec<Run>> {
        let worlds = arena.reset(self.seeds)?;
        let worlds = self.seeds.iter().zip(worlds);
        let run = |(&seed, seen): (&u64, Seen)| {
            Ok(Run {
                robot: Robot::at(self.agent(arena, seed)?, seen)?,
                seed,
                tally: Tally::default(),
                snapshot: None,
            })
        };
        worlds.map(run).collect()
    }

    fn step(&self, arena: &mut Arena, feed: &mut Feed, runs: &mut [Run], step: u64) -> Result<()> {
        if self.policy.estimator == EstimatorKind::NextTruth {
            let next = arena.foresee(self.seeds, step + 1)?;
            for (run, next) in runs.iter_mut().zip(&next) {
                run.robot.agent.foresee(next)?;
            }
        }
        let is_last = step + 1 == self.comparison.steps;
        let target = arena.model().target_state();
        let (first_world, shown) = (arena.worlds().start, feed.turn(runs.len()));
        rollout::step(
            runs,
            |run| &mut run.robot,
            |run| run.robot.plan(),
            |paths| arena.step(self.seeds, paths, step + 1),
            |index, run, turn| {
                run.look(turn, target, is_last);
                if shown.contains(&index) {
                    feed.show(&run.robot.view(first_world + index as u32));
                }
                Ok(())
            },
        )
    }

    fn agent(&self, arena: &Arena, seed: u64) -> Result<Agent> {
        let Comparison {
            config, learned, ..
        } = self.comparison;
        arena.agent(self.policy, config, self.prior, seed, learned)
    }
}

impl Run {
    fn look(&mut self, turn: Turn, target: usize, is_last: bool) {
        let agent = &self.robot.agent;
        let truth = turn.truth.as_ref().expect(SHOWS_TRUTH);
        let brier = brier_score(agent.belief(), truth, target, agent.target(target));
        let is_known = agent.policy().estimator.knows_model();
        self.tally.planning += self.robot.planning();
        self.tally.add(self.robot.observation(), brier);
        if is_last && is_known {
            self.snapshot = Some(self.snapshot(turn));
        }
    }

    fn snapshot(&self, turn: Turn) -> Snapshot {
        let (agent, observation) = (&self.robot.agent, self.robot.observation());
        let (shape, start) = (agent.belief().shape(), turn.before.robot());
        let moves = &turn.plan.moves;
        let mut path_cells = vec![start];
        path_cells.extend((1..=moves.len()).map(|n| fly(shape, start, &moves[..n]).end));
        Snapshot {
            seed: self.seed,
            step: observation.result.step,
            truth: turn.truth.expect(SHOWS_TRUTH),
            frame: observation.frame.clone(),
            path_cells,
            belief: agent.belief().clone(),
        }
    }

    fn into_policy_run(self, moves: usize) -> PolicyRun {
        let (tally, policy) = (self.tally, self.robot.agent.policy());
        let steps = tally.rewards.len() as u64;
        let mean = |sum: f64| sum / steps.max(1) as f64;
        let hit_rate = tally.n_hits as f64 / tally.n_visited.max(1) as f64;
        PolicyRun {
            policy: policy.name.clone(),
            estimator: policy.estimator.label().into(),
            world_seed: self.seed,
            steps,
            mean_reward: mean(tally.reward),
            mean_distinct_cells: mean(tally.n_visited as f64),
            hit_rate,
            mean_fire_cells: mean(tally.n_fire as f64),
            mean_plan_millis: mean(tally.planning.as_secs_f64() * 1e3),
            brier: (policy.estimator != EstimatorKind::None).then(|| mean(tally.brier)),
            moves,
            robots: 1,
            team: ALONE.into(),
            mean_repeated: 0.0,
            is_added: false,
            rewards: tally.rewards,
        }
    }
}

impl Tally {
    fn add(&mut self, observation: &Observation, brier: f64) {
        let result = &observation.result;
        self.rewards.push(result.reward as f32);
        self.fire_cells.push(result.n_target_cells as f32);
        self.reward += result.reward;
        self.n_visited += u64::from(result.n_visited);
        self.n_hits += u64::from(result.n_hits);
        self.n_fire += u64::from(result.n_target_cells);
        self.brier += brier;
    }
}

/// Brier score of a belief: the mean over all cells of `(p - 1[x = target])^2`, where `p` is the
/// probability of the state that pays most, which the belief numbers `own`. 0 is perfect; the share
/// `q` of such cells, told of each cell alike, scores `q (1 - q)`.
pub fn brier_score(belief: &Belief, truth: &Grid<u8>, target: usize, own: usize) -> f64 {
    let squared = |(&p, &state): (&f32, &u8)| {
        let miss = f64::from(p) - f64::from(u8::from(usize::from(state) == target));
        miss * miss
    };
    let sum: f64 = belief.probability(own).iter().zip(truth).map(squared).sum();
    sum / truth.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::Shape;

    #[test]
    fn a_brier_score_is_the_mean_squared_miss() {
        let shape = Shape::new(1, 4).expect("test shape");
        let truth = Grid::from_shape_vec((1, 4), vec![2, 0, 1, 0]).expect("test grid");
        let certain = Belief::from_states(&truth, 3).expect("test states");
        assert_eq!(brier_score(&certain, &truth, 2, 2), 0.0);
        let uniform = Belief::uniform(3, shape);
        let expected = (4.0 / 9.0 + 3.0 / 9.0) / 4.0;
        assert!((brier_score(&uniform, &truth, 2, 0) - expected).abs() < 1e-6);
    }
}
