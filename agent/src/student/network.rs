//! The paper's Algorithm 1: a dynamic autoencoder estimates, a DQN chooses what the next path is for,
//! shooting finds the path, and both networks learn from every step.
//!
//! One iteration: `h_{k+1}` and the predictor `u_{k+1}` from the frame (eq. 9), the estimate `p_k` by Bayes'
//! rule (eq. 10), an action from `h` (eq. 17), a path for it (eq. 15), the path's frame and reward; then one
//! step of Adam on each network (eq. 19), with step sizes of their own ([`crate::config::StepSize`]).

mod progress;

pub use self::progress::Progress;

use super::{Impression, Lesson, NotFinite, Site, Student, StudentError};
use crate::agent::numbered_states;
use crate::belief::Belief;
use crate::checkpoint::Contents;
use crate::client::Observation;
use crate::compare::planner_seed;
use crate::config::AgentConfig;
use crate::estimator::Follower;
use crate::learned::likelihood;
use crate::metrics::Tick;
use crate::planner::{Objective, Planner, PlanningProblem};
use crate::policy::{EstimatorKind, Policy};
use crate::reward::met;
use crate::scoring::score;
use ::network::{Track, Transition, Window};
use protocol::path::fly;
use protocol::{Frame, Move};
use std::time::{Duration, Instant};

/// How checkpoints of this learner call it.
pub const KIND: &str = "autoencoder";

const COLUMNS: [&str; 5] = ["dqn_loss", "dqn_rate", "action", "action_value", "epsilon"];

/// An autoencoder and a DQN that are learned.
pub struct NetworkStudent {
    site: Site,
    config: AgentConfig,
    progress: Progress,
    objectives: Vec<Objective>,
    planner: Box<dyn Planner + Send>,
    observation: Option<Observation>,
    decision: Option<Decision>,
    track: Track,
    is_frozen: bool,
    /// Time that the last plan took.
    planning: Duration,
    times: [(&'static str, Duration); 4],
}

/// The action of a step, what it was chosen on, and the cells that its path visits.
struct Decision {
    visited: Vec<usize>,
    input: Vec<f32>,
    action: usize,
    value: f32,
}

impl NetworkStudent {
    /// Goes on from some progress, or begins.
    pub fn new(progress: Progress, site: Site, config: &AgentConfig) -> Self {
        let choices = Policy::network_choices(progress.autoencoder.shape().n_states);
        Self {
            objectives: choices
                .iter()
                .map(|choice| config.objective(choice))
                .collect(),
            planner: config.planner(&choices[0]),
            track: progress.dqn.track(),
            progress,
            site,
            config: config.clone(),
            observation: None,
            decision: None,
            is_frozen: false,
            planning: Duration::ZERO,
            times: ["planning", "inference", "dqn", "autoencoder"]
                .map(|part| (part, Duration::ZERO)),
        }
    }

    fn observation(&self) -> &Observation {
        let observation = self.observation.as_ref();
        observation.expect("invariant: a world begins before it is acted on")
    }

    /// Reads a frame: `h`, the estimate and the next predictor.
    fn read(&mut self, frame: &Frame) -> Result<Belief, StudentError> {
        let start = Instant::now();
        let Progress {
            autoencoder,
            follower,
            ..
        } = &mut self.progress;
        let estimate = follower.step(autoencoder, frame);
        self.times[1].1 += start.elapsed();
        let estimate = estimate?;
        self.progress.basis.see(&estimate);
        Ok(estimate)
    }

    /// What the next action goes by.
    fn input(&self) -> Vec<f32> {
        let Progress {
            input, follower, ..
        } = &self.progress;
        input.of(follower, self.observation().robot(), self.site.n_moves)
    }

    /// Adds the transition to the DQN's replay, and what the path met to the estimate of rewards.
    fn remember(&mut self, estimate: &Belief, reward: f64) {
        let next = self.input();
        if let Some(decision) = &self.decision {
            let met = met(estimate, decision.visited.iter().copied());
            self.progress.reward.add(&met, reward);
            let step = Transition {
                input: decision.input.clone(),
                action: decision.action,
                reward: reward as f32,
                next,
            };
            if let Some(transition) = self.track.add(step) {
                self.progress.dqn.remember(transition);
            }
        }
    }

    fn update_dqn(&mut self) -> Result<[Option<f64>; 2], NotFinite> {
        let start = Instant::now();
        let rate = self.config.dqn.step_size.at(self.progress.iterations);
        self.progress.dqn.set_learning_rate(rate as f32);
        let loss = self.progress.dqn.update();
        self.times[2].1 += start.elapsed();
        Ok([loss?.map(f64::from), Some(rate)])
    }

    fn update_autoencoder(&mut self) -> Result<[Option<f64>; 2], NotFinite> {
        let start = Instant::now();
        let number = self.progress.autoencoder.n_updates();
        let config = &self.config.autoencoder;
        let replay = &self.progress.replay;
        let window = replay.window(config.window, self.config.seed, number);
        let Some(window) = window.filter(Window::has_targets) else {
            return Ok([None; 2]);
        };
        // Both step sizes go by the iteration, as eq. 20 compares them.
        let rate = config.step_size.at(self.progress.iterations);
        self.progress.autoencoder.set_learning_rate(rate as f32);
        let loss = self.progress.autoencoder.update(&window);
        self.times[3].1 += start.elapsed();
        Ok([Some(loss?), Some(rate)])
    }
}

impl Student for NetworkStudent {
    fn kind(&self) -> &'static str {
        KIND
    }

    fn columns(&self) -> &'static [&'static str] {
        &COLUMNS
    }

    fn wants_full_frames(&self) -> bool {
        !self.is_frozen && self.progress.iterations < self.config.autoencoder.full_frames
    }

    fn attach(&mut self, mut observations: Vec<Observation>) -> Result<usize, StudentError> {
        let observation = observations.remove(0);
        let shown = self.progress.replay.frames().last();
        let goes_on =
            self.progress.place == Some(observation.place()) && shown == Some(&observation.frame);
        if goes_on {
            self.observation = Some(observation);
        } else {
            self.begin(self.site.worlds.start, observation)?;
        }
        Ok(usize::from(goes_on))
    }

    fn begin(&mut self, _: u32, observation: Observation) -> Result<(), StudentError> {
        self.progress.place = Some(observation.place());
        self.track = self.progress.dqn.track();
        self.progress.follower = Follower::new(&self.progress.autoencoder)?;
        self.progress.replay.begin();
        self.read(&observation.frame)?;
        self.progress.replay.push(observation.frame.clone());
        self.observation = Some(observation);
        Ok(())
    }

    fn plan(&mut self) -> Vec<Vec<Move>> {
        let start = Instant::now();
        let input = self.input();
        let Progress { dqn, basis, .. } = &self.progress;
        let action = match self.is_frozen {
            true => dqn.best(&input),
            false => dqn.act(&input, self.progress.iterations),
        };
        let value = dqn.values(&input)[action];
        let belief = basis.belief(self.progress.follower.prediction());
        let values = self.objectives[action].values(belief);
        let observation = self.observation();
        let problem = PlanningProblem {
            start: observation.robot(),
            n_moves: self.site.n_moves,
            values: &values,
            seed: planner_seed(&self.config, observation.result.seed),
            step: observation.result.step,
        };
        let plan = self.planner.plan(&problem);
        self.decision = Some(Decision {
            visited: fly(self.site.shape, problem.start, &plan.moves).visited,
            input,
            action,
            value,
        });
        self.planning = start.elapsed();
        self.times[0].1 += self.planning;
        vec![plan.moves]
    }

    fn take_in(
        &mut self,
        mut observations: Vec<Observation>,
        watched: &[usize],
    ) -> Result<(Tick, Vec<Impression>), StudentError> {
        let observation = observations.remove(0);
        let frame = observation.frame.clone();
        let prediction = self.progress.follower.prediction();
        let likelihood = likelihood(&self.progress.autoencoder)?;
        let score = score(prediction, &likelihood, &frame);
        self.progress.place = Some(observation.place());
        let reward = observation.result.reward;
        self.observation = Some(observation);
        let estimate = self.read(&frame)?;
        self.remember(&estimate, reward);
        self.progress.replay.push(frame);
        self.progress.iterations += 1;
        let tick = Tick {
            world_steps: self.progress.iterations,
            n_worlds: 1,
            reward,
            score,
        };
        let action = self.decision.as_ref().map(|decision| decision.action);
        let target = action.map(|action| self.objectives[action].target);
        let impression = |_: &usize| Impression {
            belief: estimate.clone(),
            objective: target.map_or_else(String::new, |target| target.label(&self.state_names())),
            planning: self.planning,
        };
        Ok((tick, watched.iter().map(impression).collect()))
    }

    fn learn(&mut self) -> Result<Vec<Lesson>, NotFinite> {
        let epsilon = self
            .config
            .dqn
            .settings()
            .epsilon_at(self.progress.iterations - 1);
        let [dqn_loss, dqn_rate] = self.update_dqn()?;
        let [loss, rate] = self.update_autoencoder()?;
        let decision = self.decision.as_ref();
        let more = vec![
            dqn_loss,
            dqn_rate,
            decision.map(|decision| decision.action as f64),
            decision.map(|decision| f64::from(decision.value)),
            Some(f64::from(epsilon)),
        ];
        let number = self.n_updates();
        Ok(vec![Lesson {
            number,
            loss,
            rate,
            more,
        }])
    }

    fn freeze(&mut self) {
        self.is_frozen = true;
    }

    fn world_steps(&self) -> u64 {
        self.progress.iterations
    }

    fn n_updates(&self) -> u64 {
        self.progress.autoencoder.n_updates()
    }

    fn estimator(&self) -> EstimatorKind {
        EstimatorKind::Autoencoder
    }

    fn state_names(&self) -> Vec<String> {
        numbered_states(self.progress.autoencoder.shape().n_states)
    }

    fn belief(&self) -> Option<(&Belief, usize)> {
        let belief = self.progress.follower.prediction();
        Some((belief, self.progress.target()))
    }

    fn contents(&self) -> Result<Contents, StudentError> {
        Ok(self.progress.to_contents()?)
    }

    fn times(&self) -> Vec<(&'static str, Duration)> {
        self.times.to_vec()
    }
}
