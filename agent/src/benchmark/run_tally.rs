//! Measures one world's run: scores the flights and beliefs of each step, and sums them up in a row of the results.

use crate::acting::team::Team;
use crate::benchmark::report::PolicyRun;
use emberwatch_acting::beliefs::Input;
use emberwatch_acting::policy::Policy;
use emberwatch_acting::rollout::ActingAgent;
use emberwatch_belief::brier::brier_score;
use emberwatch_belief::estimation::scoring::Score;
use emberwatch_belief::merit::{Found, MeritTally};
use emberwatch_belief::planning::Plan;
use emberwatch_protocol::Shape;
use emberwatch_protocol::control::ServerInfo;
use emberwatch_protocol::path::Flight;
use std::time::Duration;

/// The measurements of one world's run, summed over its steps.
pub struct RunTally {
    seed: u64,
    target: usize,
    fire_cells: f64,
    rewards: Vec<f32>,
    reward: f64,
    n_visited: u64,
    n_hits: u64,
    n_visited_each: u64,
    planning: Duration,
    brier: Option<f64>,
    score: Score,
    flights: Vec<Flight>,
    merit: MeritTally,
}

impl RunTally {
    /// Starts the measurement of a world. `target` is the state with the highest reward.
    pub fn new(seed: u64, shape: Shape, target: usize) -> Self {
        Self {
            seed,
            target,
            fire_cells: 0.0,
            rewards: Vec::new(),
            reward: 0.0,
            n_visited: 0,
            n_hits: 0,
            n_visited_each: 0,
            planning: Duration::ZERO,
            brier: None,
            score: Score::default(),
            flights: Vec::new(),
            merit: MeritTally::new(shape, target as u8),
        }
    }

    /// Adds one agent's flights. After the last agent, updates the figures of merit.
    pub fn count(
        &mut self,
        acting: &ActingAgent,
        plans: &[Plan],
        planning: Duration,
        n_robots: usize,
    ) {
        let airspace = acting.agent.airspace();
        for (result, plan) in acting.results().zip(plans) {
            self.flights.push(airspace.fly(result.start(), &plan.moves));
            self.n_visited_each += u64::from(result.n_visited);
        }
        self.planning += planning;
        if self.flights.len() == n_robots {
            let result = &acting.observation().world;
            let found = Found {
                n_hits: result.n_hits,
                n_burning: result.n_target_cells,
            };
            self.merit.update(&self.flights, found, acting.truth());
            self.flights.clear();
        }
    }

    /// Adds a step's rewards, and the scores of the belief of the world's first agent.
    pub fn score(&mut self, acting: &ActingAgent, score: Option<Score>) {
        let (agent, result) = (&acting.agent, &acting.observation().world);
        self.rewards.push(result.reward as f32);
        self.fire_cells += f64::from(result.n_target_cells);
        self.reward += result.reward;
        self.n_visited += u64::from(result.n_visited);
        self.n_hits += u64::from(result.n_hits);
        let brier = |truth| brier_score(agent.belief(), truth, self.target, agent.target());
        let brier = acting.truth().map(brier);
        self.brier = brier.map(|brier| self.brier.unwrap_or_default() + brier);
        self.score += score.unwrap_or_default();
    }

    /// Summarises the run as a row of the results.
    pub fn into_run(self, policy: &Policy, team: Team, info: &ServerInfo) -> PolicyRun {
        let (steps, merit) = (self.rewards.len() as u64, self.merit.merit());
        let brier = self.brier.filter(|_| policy.belief.input != Input::Nothing);
        let mean = |sum: f64| sum / steps.max(1) as f64;
        let share = |n: u64, of: u64| n as f64 / of.max(1) as f64;
        PolicyRun {
            policy: policy.name.clone(),
            estimator: policy.belief.name.into(),
            world_seed: self.seed,
            steps,
            mean_reward: mean(self.reward),
            mean_distinct_cells: mean(self.n_visited as f64),
            hit_rate: share(self.n_hits, self.n_visited),
            mean_fire_cells: mean(self.fire_cells),
            mean_plan_millis: mean(self.planning.as_secs_f64() * 1e3),
            brier: brier.map(mean),
            moves: info.n_moves,
            robots: info.n_robots,
            team: team.label().into(),
            mean_repeated: share(self.n_visited_each - self.n_visited, self.n_visited_each),
            steps_to_detection: merit.steps_to_detection,
            burning_cells_at_detection: merit.burning_cells_at_detection,
            burning_seen_share: merit.burning_seen_share,
            front_distance: merit.front_distance,
            grid_seen_share: Some(merit.grid_seen_share),
            log_likelihood: (self.score.n_seen > 0).then(|| self.score.mean()),
            worlds_fingerprint: info.worlds_fingerprint.clone().unwrap_or_default(),
            rewards: self.rewards,
            ..PolicyRun::default()
        }
    }
}
