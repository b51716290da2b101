//! Learns which option to fly (paper section III.E): on an estimator's belief all options are planned, and a DQN that
//! reads each one's features says what it is worth.

mod saved;

pub use self::saved::{LearnedDecisions, SavedDecisions};

use self::saved::SavedRun;
use crate::config::AgentConfig;
use crate::learning::checkpoint::Contents;
use crate::learning::learners::base::{Learner, Worlds, without_truth};
use crate::learning::learners::filter::fit::LearnedModel;
use crate::learning::metrics::{ModelUpdate, Tick};
use crate::policy::{EstimatorKind, PlannerKind, Policy, numbered_states};
use crate::rollout::{Rollout, in_parallel, predict_all, see_all};
use ::network::{Dqn, DqnShape, Track, Transition};
use anyhow::Result;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::{BayesFilter, Correlations, Estimator, SpatialFilter};
use emberwatch_belief::planning::options::N_FEATURES;
use emberwatch_belief::planning::{OPTIONS, Proposal, Target};
use protocol::client::Observation;
use protocol::randomness::{Purpose, stream};
use protocol::{Model, Move, Shape};
use rand_chacha::rand_core::Rng;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

pub const KIND: &str = "decisions";

/// What a decision is made on, and among.
pub const SHAPE: DqnShape = DqnShape {
    n_inputs: N_FEATURES,
    n_outputs: 1,
    n_candidates: OPTIONS.len(),
};

/// What keeps the beliefs that decisions are made on, before a world's first frame.
pub struct Base {
    pub kind: EstimatorKind,
    filter: BayesFilter,
    /// The state that pays most.
    target: usize,
    correlations: Correlations,
    state_names: Vec<String>,
    /// What the filter learned, unless the model is known.
    model: Option<LearnedModel>,
}

/// A DQN over options that learns on several worlds.
pub struct DecisionsLearner {
    worlds: Worlds,
    config: AgentConfig,
    base: Base,
    policy: Policy,
    dqn: Dqn,
    runs: Vec<Run>,
    /// Where a checkpoint left the worlds.
    left: BTreeMap<u32, SavedRun>,
    world_steps: u64,
    /// Updates that steps have earned and that are not made yet.
    earned: f64,
    is_frozen: bool,
    times: [(&'static str, Duration); 2],
}

struct Run {
    rollout: Rollout,
    /// The features of the option flown last and its reward, until what follows is known.
    last: Option<(Vec<f32>, f32)>,
    track: Track,
    held: Held,
    /// What is flown next.
    next: Option<(usize, Proposal)>,
}

/// A random option that is flown for some steps in a row.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
struct Held {
    option: usize,
    n_steps: u64,
}

impl Base {
    /// On a known model, whose filter is given.
    pub fn known(kind: EstimatorKind, filter: BayesFilter, model: &Model) -> Self {
        Self {
            kind,
            filter,
            target: model.target_state(),
            correlations: Correlations::default(),
            state_names: model.state_names(),
            model: None,
        }
    }

    pub fn learned(kind: EstimatorKind, model: LearnedModel, shape: Shape) -> Self {
        Self {
            kind,
            filter: BayesFilter::learned(&model.tables, model.tables.prior(shape)),
            target: model.target,
            correlations: model.correlations.clone(),
            state_names: numbered_states(model.tables.dimensions.n_states),
            model: Some(model),
        }
    }

    fn estimator(&self) -> Box<dyn Estimator> {
        let filter = self.filter.clone();
        if self.kind.is_spatial() {
            let correlations = self.correlations.clone();
            Box::new(SpatialFilter::new(filter, self.target, correlations))
        } else {
            Box::new(filter)
        }
    }
}

impl DecisionsLearner {
    /// Before the first step, or going on from a checkpoint of decisions on such a base.
    pub fn new(
        base: Base,
        contents: Option<&Contents>,
        worlds: Worlds,
        config: &AgentConfig,
    ) -> Result<Self> {
        let target = Target::State(base.target);
        let mut learner = Self {
            policy: Policy::new("decisions", base.kind, PlannerKind::Beam, target),
            base,
            dqn: Dqn::new(config.decisions.settings(), SHAPE, config.seed),
            runs: Vec::new(),
            left: BTreeMap::new(),
            world_steps: 0,
            earned: 0.0,
            is_frozen: false,
            times: ["planning", "learning"].map(|part| (part, Duration::ZERO)),
            worlds,
            config: config.clone(),
        };
        if let Some(contents) = contents {
            learner.load(contents)?;
        }
        Ok(learner)
    }

    /// An agent before it takes in what its world shows.
    fn rollout_at(&self, observation: Observation) -> Rollout {
        let (base, names) = (&self.base, self.base.state_names.clone());
        let (config, policy) = (&self.config, &self.policy);
        self.worlds
            .rollout(config, policy, base.estimator(), names, observation)
    }

    /// A run that begins with what its world shows.
    fn begun(&self, observation: Observation) -> Result<Run> {
        let mut rollout = self.rollout_at(observation);
        rollout.correct()?;
        rollout.agent.predict();
        Ok(Run {
            rollout,
            last: None,
            track: self.dqn.track(),
            held: Held::default(),
            next: None,
        })
    }

    /// Chooses a run's option: the best one, or while one is held at random, that.
    fn choose(&self, index: usize, features: &[f32], held: &mut Held) -> usize {
        if self.is_frozen {
            return self.dqn.best(features);
        }
        let step = self.world_steps + index as u64;
        let mut rng = stream(self.config.seed, Purpose::Exploration, step);
        let mut random = |below: u64| rng.next_u64() % below;
        let epsilon = self.dqn.settings().epsilon_at(self.world_steps);
        // A held option lasts two or three steps, so that half as many begin.
        if held.n_steps == 0 && (random(1 << 24) as f32) < epsilon / 2.0 * (1 << 24) as f32 {
            held.option = random(OPTIONS.len() as u64) as usize;
            held.n_steps = 1 + random(self.config.decisions.longest_hold);
        }
        if held.n_steps == 0 {
            return self.dqn.best(features);
        }
        held.n_steps -= 1;
        held.option
    }

    /// Plans all options of all robots, remembers what the last ones led to, and chooses the next ones.
    fn decide(&mut self) {
        let proposals = in_parallel(self.runs.iter_mut(), Run::propose);
        let mut runs = std::mem::take(&mut self.runs);
        for (index, (run, mut proposals)) in runs.iter_mut().zip(proposals).enumerate() {
            let features: Vec<f32> = proposals.iter().flat_map(|it| it.features).collect();
            if let Some(transition) = run.led_to(&features) {
                self.dqn.remember(transition);
            }
            let option = self.choose(index, &features, &mut run.held);
            run.next = Some((option, proposals.swap_remove(option)));
        }
        self.runs = runs;
    }

    /// Share of the step size by now: falls linearly over the steps of a training.
    fn rate_share(&self) -> f32 {
        let config = &self.config.decisions;
        let done = self.world_steps as f32 / config.steps.max(1) as f32;
        (1.0 - done).max(config.final_rate)
    }
}

impl Run {
    fn propose(&mut self) -> Vec<Proposal> {
        let cell = self.rollout.observation().robot.cell();
        self.rollout.agent.propose(cell)
    }

    /// The path of the option that was chosen.
    fn take_up(&mut self) -> Vec<Move> {
        let next = self.next.take();
        let (option, proposal) = next.expect("invariant: an option was chosen");
        self.last = Some((proposal.features.to_vec(), 0.0));
        self.rollout.agent.take_up(option, proposal).moves
    }

    /// Takes in the features of what can be flown now; gives the transition that is complete by then.
    fn led_to(&mut self, features: &[f32]) -> Option<Transition> {
        let (input, reward) = self.last.take()?;
        self.track.add(Transition {
            input,
            action: 0,
            reward,
            next: features.to_vec(),
        })
    }
}

impl Learner for DecisionsLearner {
    fn kind(&self) -> &'static str {
        KIND
    }

    fn columns(&self) -> &'static [&'static str] {
        &["dqn_loss", "dqn_rate", "epsilon"]
    }

    fn attach(&mut self, observations: Vec<Observation>) -> Result<usize> {
        let mut n_gone_on = 0;
        for (world, observation) in self.worlds.numbers.clone().zip(observations) {
            let left = self.left.remove(&world);
            let run = match left.filter(|left| left.is_of(&observation)) {
                Some(left) => {
                    n_gone_on += 1;
                    left.restore(self.rollout_at(observation), &self.dqn)?
                }
                None => self.begun(observation)?,
            };
            self.runs.push(run);
        }
        Ok(n_gone_on)
    }

    fn begin(&mut self, robot: u32, observation: Observation) -> Result<()> {
        let run = self.begun(observation)?;
        self.runs[(robot - self.worlds.numbers.start) as usize] = run;
        Ok(())
    }

    fn plan(&mut self) -> Vec<Vec<Move>> {
        let start = Instant::now();
        self.decide();
        let paths = self.runs.iter_mut().map(Run::take_up).collect();
        self.times[0].1 += start.elapsed();
        paths
    }

    fn see(&mut self, observations: Vec<Observation>) -> Result<Tick> {
        let rollouts = self.runs.iter_mut().map(|run| &mut run.rollout);
        let turns = see_all(rollouts, without_truth(observations))?;
        let scale = self.config.decisions.reward_scale / self.worlds.n_moves as f32;
        let mut tick = Tick::default();
        for (run, turn) in self.runs.iter_mut().zip(turns) {
            let reward = run.rollout.observation().robot.reward;
            if let Some((_, scaled)) = &mut run.last {
                *scaled = reward as f32 * scale;
            }
            tick.reward += reward;
            tick.score += turn.score.unwrap_or_default();
        }
        tick.n_worlds = self.runs.len() as u64;
        self.world_steps += tick.n_worlds;
        tick.world_steps = self.world_steps;
        self.earned += tick.n_worlds as f64 * self.config.decisions.updates_per_step;
        Ok(tick)
    }

    fn rollout(&self, index: usize) -> &Rollout {
        &self.runs[index].rollout
    }

    fn predict(&mut self) {
        predict_all(self.runs.iter_mut().map(|run| &mut run.rollout));
    }

    fn learn(&mut self) -> Result<Vec<ModelUpdate>> {
        let start = Instant::now();
        let rate = self.config.decisions.rate * self.rate_share();
        self.dqn.set_learning_rate(rate);
        let epsilon = self.dqn.settings().epsilon_at(self.world_steps);
        let mut updates = Vec::new();
        while self.earned >= 1.0 {
            self.earned -= 1.0;
            let Some(loss) = self.dqn.update()? else {
                continue;
            };
            updates.push(ModelUpdate {
                number: self.n_updates(),
                loss: None,
                rate: None,
                more: [loss, rate, epsilon].map(|it| Some(it.into())).into(),
            });
        }
        self.times[1].1 += start.elapsed();
        Ok(updates)
    }

    fn freeze(&mut self) {
        self.is_frozen = true;
    }

    fn world_steps(&self) -> u64 {
        self.world_steps
    }

    fn n_updates(&self) -> u64 {
        self.dqn.n_updates()
    }

    fn belief(&self) -> Option<(&Belief, usize)> {
        let run = self.runs.first()?;
        Some((run.rollout.agent.belief(), self.base.target))
    }

    fn contents(&self) -> Result<Contents> {
        Ok(self.saved())
    }

    fn times(&self) -> Vec<(&'static str, Duration)> {
        self.times.to_vec()
    }
}
