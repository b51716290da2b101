//! Learns the neural belief in several worlds at once, from masked frames alone (paper eqs. 8 and 11).
//!
//! Which cells are seen depends on behaviour, and the belief must be valid for any policy. Therefore, robots change
//! their behaviour from time to time. At first they explore. Later, most of them plan on the current belief.

mod behaviour;
mod replay;

use self::behaviour::Behaviour;
use self::replay::LessonReplay;
use crate::checkpoint::{Contents, check, check_counts};
use crate::learners::base::{Learner, LearnerInputs, LearnerKind, Worlds, replace};
use crate::learners::update::ModelUpdate;
use crate::models::{SavedNeural, SavedNeuralModel, corrected_tensors};
use crate::reward::{RewardEstimate, met};
use anyhow::Result;
use emberwatch_acting::beliefs::learned::LearnedModel;
use emberwatch_acting::beliefs::neural::{NeuralEstimator, NeuralModel, estimator};
use emberwatch_acting::beliefs::{LEARNED, LearnedBelief, NEURAL as BELIEF, cast, numbered_states};
use emberwatch_acting::config::AgentConfig;
use emberwatch_acting::parallel::in_parallel;
use emberwatch_acting::policy::Policy;
use emberwatch_acting::rollout::{
    ActingAgent, Actor, AgentObservation, StepRecord, predict_all, see_all,
};
use emberwatch_messages::observation::Observation;
use emberwatch_model::randomness::{Purpose, stream};
use emberwatch_model::{Move, Probabilities};
use emberwatch_network::{Device, NeuralBelief};

pub const NEURAL: LearnerKind = LearnerKind {
    name: "neural",
    about: "A convolutional network that predicts observations from earlier ones",
    checkpoint: "neural_belief",
    columns: &[],
    is_single: false,
    flags: &["checkpoint"],
    base: |_| Ok(Some(&LEARNED)),
    needs_base: false,
    steps: |config| config.neural.steps,
    episode_steps: |config| Some(config.neural.episode_steps),
    done: |contents| Ok(contents.state::<SavedNeural>()?.world_steps),
    adopt: |_, _| Ok(()),
    read: |contents, device, learned| {
        let model = contents.state::<SavedNeural>()?.model;
        Ok(learned.put(model.read(&contents.part(""), device)?))
    },
    build,
};

fn build(on: LearnerInputs<'_>) -> Result<Box<dyn Learner>> {
    let filter = on.learned.get::<LearnedModel>();
    let learner = NeuralLearner::new(on.contents, filter, on.worlds, on.config, on.device);
    Ok(Box::new(learner?))
}

pub struct NeuralLearner {
    worlds: Worlds,
    config: AgentConfig,
    network: NeuralBelief,
    filter: Option<Box<LearnedModel>>,
    reward: RewardEstimate,
    replay: LessonReplay,
    runs: Vec<Run>,
    world_steps: u64,
    earned: f64,
}

struct Run {
    acting: ActingAgent,
    behaviour: Option<Behaviour>,
    path: Vec<Move>,
}

impl NeuralLearner {
    /// Creates a learner, or resumes one from a checkpoint. The network corrects the prediction of `filter`, if any.
    pub fn new(
        contents: Option<&Contents>,
        filter: Option<&LearnedModel>,
        worlds: Worlds,
        config: &AgentConfig,
        device: &Device,
    ) -> Result<Self> {
        let n_observations = worlds.n_observations;
        let mut learner = Self {
            network: NeuralBelief::new(n_observations, config.seed, device)?,
            filter: filter.cloned().map(Box::new),
            reward: RewardEstimate::new(n_observations),
            replay: LessonReplay::new(config.neural.replay_frames),
            runs: Vec::new(),
            world_steps: 0,
            earned: 0.0,
            worlds,
            config: config.clone(),
        };
        if let Some(contents) = contents {
            learner.load(contents)?;
        }
        let mut filters = learner.filter.iter();
        filters.try_for_each(|filter| filter.check_world(&learner.worlds.form()))?;
        Ok(learner)
    }

    /// Returns the observation with the highest estimated reward, or the last observation before the first reward.
    fn paying(&self) -> usize {
        let last = self.worlds.n_observations - 1;
        self.reward.target().unwrap_or(last)
    }

    fn agent_at(&self, observation: Observation) -> Result<ActingAgent> {
        let filter = self.filter.as_deref();
        let estimator = estimator(&self.network, filter, self.worlds.shape())?;
        let names = numbered_states(self.worlds.n_observations);
        let (policy, target) = (Policy::exploiting(&BELIEF), self.paying());
        let (estimator, worlds) = (Box::new(estimator), &self.worlds);
        let policy = (&policy, target);
        worlds.new_agent(&self.config, policy, estimator, names, observation)
    }

    fn progress(&self) -> f64 {
        self.world_steps as f64 / self.config.neural.steps.max(1) as f64
    }

    fn rate(&self) -> f64 {
        let config = &self.config.neural;
        config.rate * (1.0 - self.progress()).max(config.final_rate)
    }

    fn load(&mut self, contents: &Contents) -> Result<()> {
        let saved: SavedNeural = contents.state()?;
        let (expected, got) = (self.worlds.n_observations, saved.model.n_observations());
        check(got == expected, "n_observations", expected, got)?;
        check_counts(&[
            ("n_updates", saved.n_updates),
            ("world_steps", saved.world_steps),
        ])?;
        contents.check_squares()?;
        saved.reward.check(expected)?;
        self.filter = saved.model.read_filter(&contents.part(""))?;
        let find = |name: &str, shape: &[usize]| contents.tensor(name, shape);
        self.network.load(find, saved.n_updates)?;
        (self.reward, self.world_steps) = (saved.reward, saved.world_steps);
        Ok(())
    }
}

impl Actor for NeuralLearner {
    fn plan(&mut self) -> Vec<Vec<Move>> {
        let (target, first) = (self.paying(), self.worlds.numbers.start);
        let objective = Policy::exploiting(&BELIEF).objective(target);
        let is_exploring = self.progress() < self.config.neural.explore_share;
        let (seed, step) = (self.config.seed, self.world_steps);
        let mut runs = std::mem::take(&mut self.runs);
        let paths = in_parallel(runs.iter_mut().enumerate(), |(index, run)| {
            let (cells, k) = (run.acting.cells(), run.acting.step());
            let agent = &mut run.acting.agent;
            let mut rng = stream(seed, Purpose::Exploration, step + index as u64);
            let behaviour =
                Behaviour::next(run.behaviour, is_exploring, self.worlds.shape(), &mut rng);
            let seen = || self.replay.present(first + index as u32);
            let (airspace, belief) = (&self.worlds.airspace, agent.belief());
            let plans = match behaviour.values(objective, airspace, target, belief, seen, &mut rng)
            {
                Some(values) => agent.plan_values(&values, "learning", &cells, k),
                None => agent.walk(&cells, k),
            };
            run.behaviour = Some(behaviour);
            run.path = plans
                .into_iter()
                .next()
                .map_or(Vec::new(), |plan| plan.moves);
            run.path.clone()
        });
        self.runs = runs;
        paths
    }

    fn see(&mut self, seen: Vec<AgentObservation>) -> Result<Vec<StepRecord>> {
        let agents = self.runs.iter_mut().map(|run| &mut run.acting);
        let records = see_all(agents, seen)?;
        let runs = self.worlds.numbers.clone().zip(&self.runs);
        for ((robot, run), record) in runs.zip(&records) {
            let (belief, observation) = (run.acting.agent.belief(), run.acting.observation());
            let start = record.before.robot.cell();
            let flight = self.worlds.airspace.fly(start, &run.path);
            self.reward
                .add(&met(belief, &flight.visited), record.reward);
            let base = base(&run.acting);
            self.replay.push(robot, &observation.frame, base);
        }
        let n_robots = records.len() as u64;
        self.world_steps += n_robots;
        self.earned += n_robots as f64 * self.config.neural.updates_per_step;
        Ok(records)
    }

    fn predict(&mut self) {
        predict_all(self.runs.iter_mut().map(|run| &mut run.acting));
    }
}

impl Learner for NeuralLearner {
    fn start_episode(&mut self, robot: u32, observation: Observation) -> Result<()> {
        self.replay.start_track(robot, self.worlds.shape());
        let filter = self.filter.as_deref();
        let before = estimator(&self.network, filter, self.worlds.shape())?;
        self.replay.push(robot, &observation.frame, before.base());
        let run = Run {
            acting: self.agent_at(observation)?,
            behaviour: None,
            path: Vec::new(),
        };
        replace(&mut self.runs, &self.worlds, robot, run);
        Ok(())
    }

    fn learn(&mut self) -> Result<Vec<ModelUpdate>> {
        let mut updates = Vec::new();
        while self.earned >= 1.0 {
            self.earned -= 1.0;
            let mut rng = stream(self.config.seed, Purpose::Replay, self.n_updates());
            let lessons = self.replay.lessons(self.config.neural.batch, &mut rng);
            if lessons.is_empty() {
                continue;
            }
            let rate = self.rate();
            let loss = self.network.update(rate as f32, &lessons)?;
            updates.push(ModelUpdate {
                number: self.n_updates(),
                loss: Some(loss),
                rate: Some(rate),
                more: Vec::new(),
            });
        }
        Ok(updates)
    }

    fn agent(&self, index: usize) -> &ActingAgent {
        &self.runs[index].acting
    }

    fn world_steps(&self) -> u64 {
        self.world_steps
    }

    fn n_updates(&self) -> u64 {
        self.network.n_updates()
    }

    fn contents(&self) -> Result<Contents> {
        let model = NeuralModel {
            network: self.network.clone(),
            filter: self.filter.clone(),
            target: self.paying(),
        };
        let state = SavedNeural {
            model: SavedNeuralModel::of(&model),
            reward: self.reward.clone(),
            n_updates: self.n_updates(),
            world_steps: self.world_steps,
        };
        let filter = self.filter.iter().flat_map(|it| corrected_tensors(it));
        let tensors = self.network.named_tensors()?.into_iter().chain(filter);
        Ok(Contents::new(tensors, &state))
    }
}

/// Returns the distribution of each cell's next observation that the refined filter predicts, shape `[O, H, W]`.
fn base(acting: &ActingAgent) -> Option<&Probabilities> {
    cast::<NeuralEstimator>(acting.agent.estimator()).base()
}
