//! Learns which option to fly (paper section III.E). All options are planned on an estimator's belief, and a DQN scores
//! each option from its features.

mod base;
mod run;
mod saved;

pub use self::base::{Base, belief_of};
pub use self::saved::{SHAPE, SavedDecisions};

use self::run::{Held, Run, features};
use self::saved::SavedBelief;
use crate::checkpoint::{Contents, check};
use crate::learners::base::{Learner, LearnerInputs, LearnerKind, Worlds, replace};
use crate::learners::update::ModelUpdate;
use anyhow::Result;
use emberwatch_acting::config::AgentConfig;
use emberwatch_acting::parallel::in_parallel;
use emberwatch_acting::policy::Policy;
use emberwatch_acting::rollout::{
    ActingAgent, Actor, AgentObservation, StepRecord, predict_all, see_all,
};
use emberwatch_belief::planning::OPTIONS;
use emberwatch_messages::observation::Observation;
use emberwatch_model::Move;
use emberwatch_model::randomness::{Purpose, stream};
use emberwatch_network::Dqn;
use rand_chacha::rand_core::Rng;

pub const DECISIONS: LearnerKind = LearnerKind {
    name: "decisions",
    about: "A DQN that chooses among options on an estimator's belief, which is trained first unless given",
    checkpoint: "decisions",
    columns: &["dqn_loss", "dqn_rate", "epsilon"],
    is_single: false,
    flags: &["checkpoint", "estimator"],
    base: |config| belief_of(&config.decisions.estimator).map(Some),
    needs_base: true,
    steps: |config| config.decisions.steps,
    episode_steps: |config| Some(config.decisions.episode_steps),
    done: |contents| Ok(contents.state::<SavedDecisions>()?.world_steps),
    adopt: |contents, config| {
        config.decisions.estimator = contents.state::<SavedDecisions>()?.estimator;
        Ok(())
    },
    read: saved::read,
    build,
};

fn build(on: LearnerInputs<'_>) -> Result<Box<dyn Learner>> {
    let base = match on.contents {
        Some(contents) => {
            let saved: SavedDecisions = contents.state()?;
            saved.base(contents, on.worlds.shape(), on.device)?
        }
        None => None,
    };
    let base = base.map_or_else(|| Base::of_settings(&on), Ok)?;
    base.kind.check(&base.learned, &on.worlds.form())?;
    let learner = DecisionsLearner::new(base, on.contents, on.worlds, on.config);
    Ok(Box::new(learner?))
}

/// A DQN over options that learns on several worlds.
pub struct DecisionsLearner {
    worlds: Worlds,
    config: AgentConfig,
    base: Base,
    policy: Policy,
    pub(super) dqn: Dqn,
    runs: Vec<Run>,
    world_steps: u64,
    earned: f64,
}

impl DecisionsLearner {
    /// Creates a learner, or resumes one from a checkpoint of decisions on the same kind of belief.
    pub fn new(
        base: Base,
        contents: Option<&Contents>,
        worlds: Worlds,
        config: &AgentConfig,
    ) -> Result<Self> {
        let mut learner = Self {
            policy: Policy::exploiting(base.kind),
            base,
            dqn: Dqn::new(config.decisions.settings(), SHAPE, config.seed),
            runs: Vec::new(),
            world_steps: 0,
            earned: 0.0,
            worlds,
            config: config.clone(),
        };
        if let Some(contents) = contents {
            learner.load(contents)?;
        }
        Ok(learner)
    }

    fn agent_at(&self, observation: Observation) -> Result<ActingAgent> {
        let (base, names) = (&self.base, self.base.state_names.clone());
        let (config, policy) = (&self.config, (&self.policy, self.base.target));
        let (estimator, worlds) = (base.estimator()?, &self.worlds);
        worlds.new_agent(config, policy, estimator, names, observation)
    }

    fn choose(&self, index: usize, features: &[f32], held: &mut Held) -> usize {
        let step = self.world_steps + index as u64;
        let mut rng = stream(self.config.seed, Purpose::Exploration, step);
        let mut random = |below: u64| rng.next_u64() % below;
        let epsilon = self.dqn.settings().epsilon_at(self.world_steps);
        // A random option lasts 2.5 steps on average (with the default settings), so it begins with a probability below
        // epsilon.
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

    fn decide(&mut self) {
        let proposals = in_parallel(self.runs.iter_mut(), Run::propose);
        let mut runs = std::mem::take(&mut self.runs);
        for (index, (run, mut proposals)) in runs.iter_mut().zip(proposals).enumerate() {
            let features = features(&proposals);
            if let Some(transition) = run.led_to(&features, &self.dqn) {
                self.dqn.remember(transition);
            }
            let option = self.choose(index, &features, &mut run.held);
            run.next = Some((option, proposals.swap_remove(option)));
        }
        self.runs = runs;
    }

    fn rate_share(&self) -> f32 {
        let config = &self.config.decisions;
        let done = self.world_steps as f32 / config.steps.max(1) as f32;
        (1.0 - done).max(config.final_rate)
    }

    fn load(&mut self, contents: &Contents) -> Result<()> {
        let saved: SavedDecisions = contents.state()?;
        saved.load_into(&mut self.dqn, contents)?;
        let [expected, got] = [self.base.kind, saved.kind()?].map(|kind| kind.name);
        check(got == expected, "decisions.estimator", expected, got)?;
        self.world_steps = saved.world_steps;
        Ok(())
    }
}

impl Actor for DecisionsLearner {
    fn plan(&mut self) -> Vec<Vec<Move>> {
        self.decide();
        self.runs.iter_mut().map(Run::take_up).collect()
    }

    fn see(&mut self, seen: Vec<AgentObservation>) -> Result<Vec<StepRecord>> {
        let agents = self.runs.iter_mut().map(|run| &mut run.acting);
        let records = see_all(agents, seen)?;
        let scale = self.config.decisions.reward_scale / self.worlds.n_moves as f32;
        for (run, record) in self.runs.iter_mut().zip(&records) {
            if let Some((_, scaled)) = &mut run.last {
                *scaled = record.reward as f32 * scale;
            }
        }
        let n_robots = records.len() as u64;
        self.world_steps += n_robots;
        self.earned += n_robots as f64 * self.config.decisions.updates_per_step;
        Ok(records)
    }

    fn predict(&mut self) {
        predict_all(self.runs.iter_mut().map(|run| &mut run.acting));
    }
}

impl Learner for DecisionsLearner {
    fn start_episode(&mut self, robot: u32, observation: Observation) -> Result<()> {
        let run = Run::begun(self.agent_at(observation)?, &self.dqn);
        if let Some(mut ended) = replace(&mut self.runs, &self.worlds, robot, run) {
            let transitions = ended.end(&self.dqn).into_iter();
            transitions.for_each(|transition| self.dqn.remember(transition));
        }
        Ok(())
    }

    fn learn(&mut self) -> Result<Vec<ModelUpdate>> {
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
        Ok(updates)
    }

    fn agent(&self, index: usize) -> &ActingAgent {
        &self.runs[index].acting
    }

    fn world_steps(&self) -> u64 {
        self.world_steps
    }

    fn n_updates(&self) -> u64 {
        self.dqn.n_updates()
    }

    fn contents(&self) -> Result<Contents> {
        let belief = SavedBelief::of(self.base.kind, &self.base.learned)?;
        let (belief, of_belief) =
            belief.map_or((None, Vec::new()), |(it, tensors)| (Some(it), tensors));
        let state = SavedDecisions {
            options: OPTIONS.map(|option| option.name.into()).into(),
            estimator: self.base.kind.name.into(),
            belief,
            n_updates: self.n_updates(),
            world_steps: self.world_steps,
        };
        let tensors = self.dqn.named_tensors().into_iter().chain(of_belief);
        Ok(Contents::new(tensors, &state))
    }
}
