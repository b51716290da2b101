//! Measures one world's run: scores the flights and beliefs of each step, and sums them up in a row of the results.

use crate::benchmark::report::PolicyRun;
use crate::benchmark::team::Team;
use emberwatch_belief::brier::brier_score;
use emberwatch_belief::estimation::scoring::Score;
use emberwatch_belief::merit::{Found, MeritTally};
use emberwatch_belief::planning::Plan;
use emberwatch_learning::beliefs::Input;
use emberwatch_learning::policy::Policy;
use emberwatch_learning::rollout::Rollout;
use emberwatch_protocol::Shape;
use emberwatch_protocol::control::ServerInfo;
use emberwatch_protocol::message::WorldResult;
use emberwatch_protocol::path::Flight;
use std::time::Duration;

/// The measurements of one world's run.
pub struct WorldRun {
    pub seed: u64,
    pub tally: Tally,
    /// Flights of the present step, collected until all robots have flown.
    flights: Vec<Flight>,
    merit: MeritTally,
}

/// Sums over the steps of a run.
#[derive(Default)]
pub struct Tally {
    rewards: Vec<f32>,
    /// Number of cells in the state with the highest reward, at each step.
    pub fire_cells: Vec<f32>,
    reward: f64,
    n_visited: u64,
    n_hits: u64,
    /// Number of distinct cells that each robot visits in a step, summed over robots and steps.
    n_visited_each: u64,
    n_fire: u64,
    pub planning: Duration,
    /// Sum of Brier scores; `None` if hidden states are not published.
    brier: Option<f64>,
    score: Score,
}

impl WorldRun {
    /// Starts the measurement of a world. `target` is the state with the highest reward.
    pub fn new(seed: u64, shape: Shape, target: usize, recent_steps: u32) -> Self {
        Self {
            seed,
            tally: Tally::default(),
            flights: Vec::new(),
            merit: MeritTally::new(shape, target as u8, recent_steps),
        }
    }

    /// Adds one agent's flights. After the last agent, updates the figures of merit.
    pub fn count(&mut self, rollout: &Rollout, plans: &[Plan], n_robots: usize) {
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
    pub fn score(&mut self, rollout: &Rollout, target: usize, score: Option<Score>) {
        let agent = &rollout.agent;
        let brier = rollout
            .truth()
            .map(|truth| brier_score(agent.belief(), truth, target, agent.target()));
        self.tally.add(&rollout.observation().world, brier);
        self.tally.score += score.unwrap_or_default();
    }

    /// Summarises the run as a row of the results.
    pub fn into_run(self, policy: &Policy, team: Team, info: &ServerInfo) -> PolicyRun {
        let (tally, merit) = (self.tally, self.merit.merit());
        let steps = tally.rewards.len() as u64;
        let brier = tally.brier;
        let brier = brier.filter(|_| policy.belief.input != Input::Nothing);
        let mean = |sum: f64| sum / steps.max(1) as f64;
        let share = |n: u64, of: u64| n as f64 / of.max(1) as f64;
        let n_repeated = tally.n_visited_each - tally.n_visited;
        PolicyRun {
            policy: policy.name.clone(),
            estimator: policy.belief.label.into(),
            world_seed: self.seed,
            steps,
            mean_reward: mean(tally.reward),
            mean_distinct_cells: mean(tally.n_visited as f64),
            hit_rate: share(tally.n_hits, tally.n_visited),
            mean_fire_cells: mean(tally.n_fire as f64),
            mean_plan_millis: mean(tally.planning.as_secs_f64() * 1e3),
            brier: brier.map(mean),
            moves: info.n_moves,
            robots: info.n_robots,
            team: team.label().into(),
            mean_repeated: share(n_repeated, tally.n_visited_each),
            steps_to_detection: merit.steps_to_detection,
            burning_cells_at_detection: merit.burning_cells_at_detection,
            recent_steps: Some(self.merit.recent_steps()),
            burning_seen_share: merit.burning_seen_share,
            front_distance: merit.front_distance,
            grid_seen_share: Some(merit.grid_seen_share),
            log_likelihood: (tally.score.n_seen > 0).then(|| tally.score.mean()),
            worlds_fingerprint: info.worlds_fingerprint.clone().unwrap_or_default(),
            rewards: tally.rewards,
            ..PolicyRun::default()
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
