//! The paper's Algorithm 1: a dynamic autoencoder estimates, a DQN chooses what the next path is for,
//! shooting finds the path, and both networks learn from every step.
//!
//! One iteration: `h_{k+1}` and the predictor `u_{k+1}` from the frame (eq. 9), the estimate `p_k` by Bayes'
//! rule (eq. 10), an action from `h` (eq. 17), a path for it (eq. 15), the path's frame and reward; then one
//! step of Adam on each network (eq. 19), with step sizes of their own ([`crate::config::StepSize`]).

mod progress;

pub use self::progress::{Position, Progress, SavedNetwork};

use self::progress::follower;
use anyhow::Result;

use crate::config::AgentConfig;
use crate::estimation::belief::Belief;
use crate::estimation::{AutoencoderEstimator, Follower};
use crate::learning::checkpoint::Contents;
use crate::learning::metrics::{ModelUpdate, Tick};
use crate::learning::reward::met;
use crate::learning::student::base::{Fly, Look, Student, Worlds, place, without_truth};
use crate::planning::policy::{Policy, numbered_states};
use crate::rollout::{self, Robot};
use ::network::{Transition, Window};
use protocol::client::Observation;
use protocol::path;
use std::time::{Duration, Instant};

pub const KIND: &str = "autoencoder";

const COLUMNS: [&str; 5] = ["dqn_loss", "dqn_rate", "action", "action_value", "epsilon"];

/// An autoencoder and a DQN that are learned.
pub struct NetworkStudent {
    worlds: Worlds,
    config: AgentConfig,
    progress: Progress,
    choices: Vec<Policy>,
    /// Its world's, once it is attached.
    robot: Option<Robot>,
    decision: Option<Decision>,
    is_frozen: bool,
    times: [(&'static str, Duration); 3],
}

/// The action of a step, and what it was chosen on.
struct Decision {
    input: Vec<f32>,
    action: usize,
    value: f32,
}

impl NetworkStudent {
    /// Goes on from some progress, or begins.
    pub fn new(progress: Progress, worlds: Worlds, config: &AgentConfig) -> Self {
        Self {
            choices: Policy::network_choices(progress.autoencoder.shape().n_states),
            progress,
            worlds,
            config: config.clone(),
            robot: None,
            decision: None,
            is_frozen: false,
            times: ["planning", "dqn", "autoencoder"].map(|part| (part, Duration::ZERO)),
        }
    }

    /// A robot whose hidden vector is where another was, before it takes in what its world shows.
    fn robot(&self, follower: Follower, observation: Observation) -> Robot {
        let network = &self.progress.autoencoder;
        let estimator = AutoencoderEstimator::at(network, follower);
        let names = numbered_states(network.shape().n_states);
        let (policy, config) = (&self.choices[0], &self.config);
        let worlds = &self.worlds;
        worlds.robot(config, policy, Box::new(estimator), names, observation)
    }

    /// What the next action goes by.
    fn input(robot: &Robot) -> Vec<f32> {
        follower(robot).hidden().to_vec()
    }

    fn decide(&self, robot: &Robot) -> Decision {
        let (dqn, input) = (&self.progress.dqn, Self::input(robot));
        let action = match self.is_frozen {
            true => dqn.best(&input),
            false => dqn.act(&input, self.progress.position.iterations),
        };
        Decision {
            value: dqn.values(&input)[action],
            input,
            action,
        }
    }

    fn remember(&mut self, robot: &Robot, decision: &Decision) {
        let step = Transition {
            input: decision.input.clone(),
            action: decision.action,
            reward: robot.observation().robot.reward as f32,
            next: Self::input(robot),
        };
        if let Some(transition) = self.progress.position.track.add(step) {
            self.progress.dqn.remember(transition);
        }
    }

    fn update_dqn(&mut self) -> Result<[Option<f64>; 2]> {
        let start = Instant::now();
        let rate = self
            .config
            .dqn
            .step_size
            .at(self.progress.position.iterations);
        self.progress.dqn.set_learning_rate(rate as f32);
        let loss = self.progress.dqn.update();
        self.times[1].1 += start.elapsed();
        Ok([loss?.map(f64::from), Some(rate)])
    }

    fn update_autoencoder(&mut self) -> Result<[Option<f64>; 2]> {
        let start = Instant::now();
        let number = self.progress.autoencoder.n_updates();
        let config = &self.config.autoencoder;
        let replay = &self.progress.replay;
        let window = replay.window(config.window, self.config.seed, number);
        let Some(window) = window.filter(Window::has_targets) else {
            return Ok([None; 2]);
        };
        // Both step sizes go by the iteration, as eq. 20 compares them.
        let rate = config.step_size.at(self.progress.position.iterations);
        self.progress.autoencoder.set_learning_rate(rate as f32);
        let loss = self.progress.autoencoder.update(&window);
        self.times[2].1 += start.elapsed();
        Ok([Some(loss?), Some(rate)])
    }

    fn step_with(&mut self, robot: &mut Robot, fly: Fly<'_>, look: Look<'_>) -> Result<Tick> {
        let start = Instant::now();
        let decision = self.decide(robot);
        let objective = self.config.objective(&self.choices[decision.action]);
        let (mut planning, mut tick) = (Duration::ZERO, Tick::default());
        rollout::step(
            std::slice::from_mut(robot),
            |robot| robot,
            |robot| robot.plan_with(|agent, robots, step| agent.plan_for(objective, robots, step)),
            |paths| {
                planning = start.elapsed();
                anyhow::Ok(without_truth(fly(paths)?))
            },
            |index, robot, turn| {
                tick.score = turn.score.unwrap_or_default();
                tick.reward = robot.observation().robot.reward;
                let path = &turn.plans[0].moves;
                let cells = path::fly(self.worlds.shape, turn.before.robot.cell(), path);
                let met = met(robot.agent.belief(), cells.visited.iter().copied());
                self.progress.position.reward.add(&met, tick.reward);
                look(index, robot);
                Ok(())
            },
        )?;
        self.times[0].1 += planning;
        self.remember(robot, &decision);
        self.decision = Some(decision);
        let frame = robot.observation().frame.clone();
        self.progress.replay.push(frame);
        self.progress.position.iterations += 1;
        tick.world_steps = self.progress.position.iterations;
        tick.n_worlds = 1;
        Ok(tick)
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
        !self.is_frozen && self.progress.position.iterations < self.config.autoencoder.full_frames
    }

    fn attach(&mut self, mut observations: Vec<Observation>) -> Result<usize> {
        let observation = observations.remove(0);
        let shown = self.progress.replay.frames().last();
        let goes_on = self.progress.position.place == Some(place(&observation))
            && shown == Some(&observation.frame);
        if goes_on {
            let mut robot = self.robot(self.progress.position.follower.clone(), observation);
            let estimate = self.progress.position.estimate.as_ref();
            robot.agent.remember_estimate(estimate);
            self.robot = Some(robot);
        } else {
            self.begin(self.worlds.numbers.start, observation)?;
        }
        Ok(usize::from(goes_on))
    }

    fn begin(&mut self, _: u32, observation: Observation) -> Result<()> {
        self.progress.position.track = self.progress.dqn.track();
        self.progress.replay.begin();
        self.progress.replay.push(observation.frame.clone());
        let follower = Follower::new(&self.progress.autoencoder)?;
        let mut robot = self.robot(follower, observation);
        robot.begin(None, |_| ())?;
        self.robot = Some(robot);
        Ok(())
    }

    fn step(&mut self, fly: Fly<'_>, look: Look<'_>) -> Result<Tick> {
        let robot = self.robot.take();
        let mut robot = robot.expect("invariant: a world begins before it is acted on");
        let stepped = self.step_with(&mut robot, fly, look);
        self.robot = Some(robot);
        stepped
    }

    fn learn(&mut self) -> Result<Vec<ModelUpdate>> {
        let epsilon = self
            .config
            .dqn
            .settings()
            .epsilon_at(self.progress.position.iterations - 1);
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
        Ok(vec![ModelUpdate {
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
        self.progress.position.iterations
    }

    fn n_updates(&self) -> u64 {
        self.progress.autoencoder.n_updates()
    }

    fn belief(&self) -> Option<(&Belief, usize)> {
        let belief = follower(self.robot.as_ref()?).prediction();
        Some((belief, self.progress.target()))
    }

    fn contents(&self) -> Result<Contents> {
        let robot = self.robot.as_ref();
        let robot = robot.expect("invariant: a world begins before it is saved");
        Ok(self.progress.to_contents(robot)?)
    }

    fn times(&self) -> Vec<(&'static str, Duration)> {
        self.times.to_vec()
    }
}
