//! Learns the filter's parameters in several worlds at once. Robots first make random moves, and then plan on the
//! belief of the current filter.

pub mod fit;

pub use crate::models::SavedFilter;

use crate::checkpoint::Contents;
use crate::learners::base::{Learner, LearnerInputs, LearnerKind, Worlds, replace};
use crate::learners::filter::fit::FilterFit;
use crate::learners::update::ModelUpdate;
use anyhow::{Result, ensure};
use emberwatch_acting::beliefs::learned::LearnedModel;
use emberwatch_acting::beliefs::{LEARNED, numbered_states};
use emberwatch_acting::config::AgentConfig;
use emberwatch_acting::parallel::in_parallel;
use emberwatch_acting::policy::Policy;
use emberwatch_acting::rollout::{
    ActingAgent, Actor, AgentObservation, StepRecord, predict_all, see_all,
};
use emberwatch_belief::estimation::BayesFilter;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::parameters::Dimensions;
use emberwatch_belief::planning::Plan;
use emberwatch_messages::control::CoverageRule;
use emberwatch_messages::observation::Observation;
use emberwatch_model::Move;

pub struct FilterLearner {
    worlds: Worlds,
    config: AgentConfig,
    fit: FilterFit,
    learned: LearnedModel,
    agents: Vec<ActingAgent>,
    planned: Vec<(Belief, Plan)>,
}

pub const FILTER: LearnerKind = LearnerKind {
    name: "filter",
    about: "A Bayes filter of the paper's form, with learned parameters",
    checkpoint: "learned_filter",
    columns: &[],
    is_single: false,
    flags: &["coverage"],
    base: |_| Ok(None),
    needs_base: false,
    steps: |_| 0,
    episode_steps: |_| None,
    done: |contents| Ok(contents.state::<SavedFilter>()?.world_steps),
    adopt: |contents, config| {
        config.full_frames = contents.settings()?.full_frames;
        Ok(())
    },
    read: |contents, _, learned| {
        let model = contents.state::<SavedFilter>()?.model;
        Ok(learned.put(model.read(&contents.part(""))?))
    },
    build,
};

fn build(on: LearnerInputs<'_>) -> Result<Box<dyn Learner>> {
    let dimensions = dimensions(on.config, &on.worlds)?;
    ensure!(
        !on.config.full_frames || on.info.coverage != CoverageRule::Path,
        "full_frames: expected a server with --coverage client or full, got path"
    );
    let learner = FilterLearner::new(on.contents, dimensions, on.worlds, on.config);
    Ok(Box::new(learner?))
}

fn dimensions(config: &AgentConfig, worlds: &Worlds) -> Result<Dimensions> {
    let learning = config.learning;
    let dimensions = Dimensions {
        n_states: match learning.states {
            0 => worlds.n_observations,
            states => states,
        },
        n_observations: worlds.n_observations,
        kernel: (learning.kernel[0], learning.kernel[1]),
    };
    dimensions.check().map_err(anyhow::Error::msg)
}

impl FilterLearner {
    /// Creates a learner, or resumes one from a checkpoint.
    pub fn new(
        contents: Option<&Contents>,
        dimensions: Dimensions,
        worlds: Worlds,
        config: &AgentConfig,
    ) -> Result<Self> {
        let mut fit = FilterFit::new(dimensions, worlds.shape(), config);
        contents.map_or(Ok(()), |contents| fit.load(contents))?;
        Ok(Self {
            learned: fit.learned(),
            fit,
            worlds,
            config: config.clone(),
            agents: Vec::new(),
            planned: Vec::new(),
        })
    }

    fn agent_at(&self, observation: Observation) -> Result<ActingAgent> {
        let tables = &self.learned.tables;
        let filter = BayesFilter::learned(tables, tables.prior(self.worlds.shape()));
        let names = numbered_states(tables.dimensions.n_states);
        let (policy, target) = (Policy::exploiting(&LEARNED), self.learned.target);
        let (worlds, config) = (&self.worlds, &self.config);
        worlds.new_agent(
            config,
            (&policy, target),
            Box::new(filter),
            names,
            observation,
        )
    }

    fn n_walking(&self) -> usize {
        let learning = &self.config.learning;
        if self.fit.world_steps < learning.explore_steps {
            return self.agents.len();
        }
        (learning.explore_share * self.agents.len() as f64).round() as usize
    }
}

impl Actor for FilterLearner {
    fn plan(&mut self) -> Vec<Vec<Move>> {
        self.learned = self.fit.learned();
        let (n_walking, tables) = (self.n_walking(), &self.learned.tables);
        let policy = Policy::exploiting(&LEARNED);
        let objective = policy.objective(self.learned.target);
        let agents = self.agents.iter_mut().enumerate();
        self.planned = in_parallel(agents, |(index, acting)| {
            let belief = acting.agent.belief().clone();
            let filter = BayesFilter::learned(tables, belief.clone());
            acting.agent.set_estimator(Box::new(filter));
            let (cells, step) = (acting.cells(), acting.step());
            let mut plans = if index < n_walking {
                acting.agent.walk(&cells, step)
            } else {
                acting.agent.plan_for(objective, &cells, step)
            };
            (belief, plans.remove(0))
        });
        let plans = self.planned.iter();
        plans.map(|(_, plan)| plan.moves.clone()).collect()
    }

    fn see(&mut self, seen: Vec<AgentObservation>) -> Result<Vec<StepRecord>> {
        let records = see_all(&mut self.agents, seen)?;
        let runs = self.agents.iter().zip(&self.planned).zip(&records);
        for (robot, ((acting, (predictor, plan)), record)) in
            (self.worlds.numbers.start..).zip(runs)
        {
            let frame = &acting.observation().frame;
            let start = record.before.robot.cell();
            let flight = self.worlds.airspace.fly(start, &plan.moves);
            self.fit.see(robot, frame, Some(predictor), &self.learned);
            let belief = acting.agent.belief();
            self.fit.earn(belief, &flight.visited, record.reward);
        }
        Ok(records)
    }

    fn predict(&mut self) {
        predict_all(&mut self.agents);
    }
}

impl Learner for FilterLearner {
    fn wants_full_frames(&self) -> bool {
        self.config.full_frames
    }

    fn start_episode(&mut self, robot: u32, observation: Observation) -> Result<()> {
        self.fit.start_track(robot);
        self.fit.see(robot, &observation.frame, None, &self.learned);
        let acting = self.agent_at(observation)?;
        replace(&mut self.agents, &self.worlds, robot, acting);
        Ok(())
    }

    fn learn(&mut self) -> Result<Vec<ModelUpdate>> {
        let update = |update: crate::gradient::Update| ModelUpdate {
            number: update.number,
            loss: Some(update.loss),
            rate: Some(update.rate),
            more: Vec::new(),
        };
        Ok(self.fit.learn()?.into_iter().map(update).collect())
    }

    fn agent(&self, index: usize) -> &ActingAgent {
        &self.agents[index]
    }

    fn world_steps(&self) -> u64 {
        self.fit.world_steps
    }

    fn n_updates(&self) -> u64 {
        self.fit.n_updates()
    }

    fn contents(&self) -> Result<Contents> {
        Ok(self.fit.contents())
    }
}
