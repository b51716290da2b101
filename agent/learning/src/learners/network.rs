//! The paper's Algorithm 1: a dynamic autoencoder estimates the state, a DQN chooses the objective of the next path,
//! and random shooting finds the path. Both networks learn from every step.
//!
//! An iteration computes `h_{k+1}` and the predictor `u_{k+1}` from the frame (eq. 9), the estimate `p_k` by Bayes'
//! rule (eq. 10), an action from `h` (eq. 17), and a path for it (eq. 15). After the path's frame and reward, Adam
//! makes one step on each network (eq. 19). Each network has its own step size ([`emberwatch_acting::config::StepSize`]).

mod progress;

pub use self::progress::{Progress, SavedNetwork};

use anyhow::{Result, ensure};
use emberwatch_messages::control::{CoverageRule, ServerInfo};

use crate::checkpoint::Contents;
use crate::learners::base::{Learner, LearnerInputs, LearnerKind, Worlds};
use crate::learners::update::ModelUpdate;
use crate::reward::met;
use emberwatch_acting::beliefs::autoencoder::AutoencoderEstimator;
use emberwatch_acting::beliefs::{cast, numbered_states};
use emberwatch_acting::config::AgentConfig;
use emberwatch_acting::policy::{Policy, network_choices};
use emberwatch_acting::rollout::{
    ActingAgent, Actor, AgentObservation, StepRecord, predict_all, see_all,
};
use emberwatch_messages::observation::Observation;
use emberwatch_model::Move;
use emberwatch_network::{FrameReplay, Track, Transition, Window};

pub const AUTOENCODER: LearnerKind = LearnerKind {
    name: "autoencoder",
    about: "The paper's Algorithm 1: a dynamic autoencoder, and a DQN that chooses objectives",
    checkpoint: "autoencoder",
    columns: &["dqn_loss", "dqn_rate", "action", "action_value", "epsilon"],
    is_single: true,
    flags: &[],
    base: |_| Ok(None),
    needs_base: false,
    steps: |_| 0,
    episode_steps: |_| None,
    done: |contents| Ok(contents.state::<SavedNetwork>()?.iterations),
    adopt: |_, _| Ok(()),
    read: |contents, device, learned| {
        Ok(learned.put(Progress::read(contents, device)?.into_model()))
    },
    build,
};

fn build(on: LearnerInputs<'_>) -> Result<Box<dyn Learner>> {
    let mut progress = Progress::first(&on.worlds.form(), on.config, on.device)?;
    if let Some(contents) = on.contents {
        progress.load(contents)?;
    }
    check_full_frames(&progress, on.config, on.info)?;
    check_window(on.config, on.info)?;
    Ok(Box::new(NetworkLearner::new(
        progress, on.worlds, on.config,
    )))
}

fn check_full_frames(progress: &Progress, config: &AgentConfig, info: &ServerInfo) -> Result<()> {
    let full_frames = config.autoencoder.full_frames;
    ensure!(
        progress.iterations >= full_frames || info.coverage != CoverageRule::Path,
        "autoencoder.full_frames: {full_frames} frames that show every cell need a server with --coverage client or \
         full; set it to 0 for other servers"
    );
    Ok(())
}

/// With shorter episodes, nothing could be learned.
fn check_window(config: &AgentConfig, info: &ServerInfo) -> Result<()> {
    // For recorded worlds, the server reports only the length of the shortest episode, so other episodes can be long
    // enough.
    let is_cut = info.max_steps > 0 && info.recorded_world.is_none();
    let (window, n_frames) = (
        config.autoencoder.window as u64,
        info.max_steps.saturating_add(1),
    );
    ensure!(
        !is_cut || window <= n_frames,
        "autoencoder.window: expected at most the {n_frames} frames of an episode (--max-steps of the server), got \
         {window}"
    );
    Ok(())
}

/// The learner of an autoencoder and a DQN.
pub struct NetworkLearner {
    worlds: Worlds,
    config: AgentConfig,
    pub(super) progress: Progress,
    replay: FrameReplay,
    /// The latest steps, whose transitions are not yet in the DQN's replay buffer.
    track: Track,
    choices: Vec<Policy>,
    acting: Option<ActingAgent>,
    decision: Option<Decision>,
}

struct Decision {
    input: Vec<f32>,
    action: usize,
    value: f32,
    path: Vec<Move>,
}

impl NetworkLearner {
    /// Creates a learner that continues from the given progress.
    pub fn new(progress: Progress, worlds: Worlds, config: &AgentConfig) -> Self {
        Self {
            choices: network_choices(progress.autoencoder.shape().n_states),
            replay: FrameReplay::new(config.autoencoder.settings().replay),
            track: progress.dqn.track(),
            progress,
            worlds,
            config: config.clone(),
            acting: None,
            decision: None,
        }
    }

    fn at_world(&self) -> &ActingAgent {
        let acting = self.acting.as_ref();
        acting.expect("invariant: a world begins before it is acted on")
    }

    fn at_world_mut(&mut self) -> &mut ActingAgent {
        let acting = self.acting.as_mut();
        acting.expect("invariant: a world begins before it is acted on")
    }

    /// Returns the input of the next action: `h_{k+1}`, which depends on the last frame.
    fn input(&self) -> Vec<f32> {
        let estimator = self.at_world().agent.estimator();
        cast::<AutoencoderEstimator>(estimator).hidden().to_vec()
    }

    fn decide(&self) -> Decision {
        let (dqn, input) = (&self.progress.dqn, self.input());
        let action = dqn.act(&input, self.progress.iterations);
        Decision {
            value: dqn.values(&input)[action],
            input,
            action,
            path: Vec::new(),
        }
    }

    fn remember(&mut self) {
        let decision = self.decision.as_ref();
        let decision = decision.expect("invariant: a step begins with a decision");
        let Observation { world, robot, .. } = self.at_world().observation();
        let is_over = world.truncated != 0 || world.terminated != 0;
        let step = Transition {
            input: decision.input.clone(),
            action: decision.action,
            reward: robot.reward as f32,
            next: self.input(),
            discount: self.progress.dqn.discount(world.terminated != 0),
        };
        let full = self.track.add(step);
        let short = if is_over {
            self.track.end()
        } else {
            Vec::new()
        };
        let transitions = full.into_iter().chain(short);
        transitions.for_each(|transition| self.progress.dqn.remember(transition));
    }

    fn update_dqn(&mut self) -> Result<[Option<f64>; 2]> {
        let rate = self.config.dqn.step_size.at(self.progress.iterations);
        self.progress.dqn.set_learning_rate(rate as f32);
        let loss = self.progress.dqn.update();
        Ok([loss?.map(f64::from), Some(rate)])
    }

    fn update_autoencoder(&mut self) -> Result<[Option<f64>; 2]> {
        let number = self.progress.autoencoder.n_updates();
        let config = &self.config.autoencoder;
        let window = self.replay.window(config.window, self.config.seed, number);
        let Some(window) = window.filter(Window::has_targets) else {
            return Ok([None; 2]);
        };
        // Like the DQN's step size, this one depends on the iteration, because eq. 20 compares the two.
        let rate = config.step_size.at(self.progress.iterations);
        self.progress.autoencoder.set_learning_rate(rate as f32);
        let loss = self.progress.autoencoder.update(&window);
        Ok([Some(loss?), Some(rate)])
    }
}

impl Actor for NetworkLearner {
    fn plan(&mut self) -> Vec<Vec<Move>> {
        let mut decision = self.decide();
        let objective = self.choices[decision.action].objective(0);
        let acting = self.at_world_mut();
        let (cells, step) = (acting.cells(), acting.step());
        decision.path = acting
            .agent
            .plan_for(objective, &cells, step)
            .remove(0)
            .moves;
        let paths = vec![decision.path.clone()];
        self.decision = Some(decision);
        paths
    }

    fn see(&mut self, seen: Vec<AgentObservation>) -> Result<Vec<StepRecord>> {
        let records = see_all(&mut self.acting, seen)?;
        let (record, acting) = (&records[0], self.at_world());
        let path = self.decision.as_ref().map(|decision| &*decision.path);
        let start = record.before.robot.cell();
        let flight = self.worlds.airspace.fly(start, path.unwrap_or_default());
        let met = met(acting.agent.belief(), &flight.visited);
        let frame = acting.observation().frame.clone();
        self.progress.reward.add(&met, record.reward);
        self.progress.iterations += 1;
        self.replay.push(frame);
        Ok(records)
    }

    fn predict(&mut self) {
        predict_all(&mut self.acting);
        self.remember();
    }
}

impl Learner for NetworkLearner {
    fn wants_full_frames(&self) -> bool {
        self.progress.iterations < self.config.autoencoder.full_frames
    }

    fn start_episode(&mut self, _: u32, observation: Observation) -> Result<()> {
        self.track = self.progress.dqn.track();
        self.replay.start_track();
        self.replay.push(observation.frame.clone());
        let network = &self.progress.autoencoder;
        let estimator = AutoencoderEstimator::new(network)?;
        let names = numbered_states(network.shape().n_states);
        // The initial policy is the first choice, whose target is the first state.
        let (first, worlds) = ((&self.choices[0], 0), &self.worlds);
        let acting = worlds.new_agent(&self.config, first, Box::new(estimator), names, observation);
        self.acting = Some(acting?);
        Ok(())
    }

    fn learn(&mut self) -> Result<Vec<ModelUpdate>> {
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
        Ok(vec![ModelUpdate {
            number,
            loss,
            rate,
            more,
        }])
    }

    fn agent(&self, _: usize) -> &ActingAgent {
        self.at_world()
    }

    fn world_steps(&self) -> u64 {
        self.progress.iterations
    }

    fn n_updates(&self) -> u64 {
        self.progress.autoencoder.n_updates()
    }

    fn contents(&self) -> Result<Contents> {
        Ok(self.progress.contents()?)
    }
}
