//! One world's robot while a model is learned: plans on the learned belief and keeps it. Pure.

mod stored;

pub use stored::Stand;

use crate::client::Observation;
use crate::compare::planner_seed;
use crate::config::AgentConfig;
use crate::estimator::{BayesFilter, ZeroEvidence};
use crate::learner::{LearnedModel, Learner};
use crate::planner::{PlanBasis, Planner, PlanningProblem, Target};
use crate::policy::{PlannerKind, Policy};
use crate::scoring::{Score, score};
use protocol::path::fly;
use protocol::{Move, Shape};
use std::time::{Duration, Instant};

/// Acts on one world on a learned belief.
pub struct Pilot {
    /// The belief.
    pub filter: BayesFilter,
    /// What paths are planned on.
    basis: PlanBasis,
    /// What the world shows.
    pub observation: Observation,
    walk: Box<dyn Planner + Send>,
    beam: Box<dyn Planner + Send>,
    seed: u64,
    /// The cells that the last path visits.
    visited: Vec<usize>,
    /// Time that its plan took.
    pub planning: Duration,
}

impl Pilot {
    /// A pilot before it took in what the world shows.
    pub fn new(
        learned: &LearnedModel,
        shape: Shape,
        observation: Observation,
        config: &AgentConfig,
    ) -> Self {
        Self {
            filter: BayesFilter::learned(&learned.tables, learned.tables.prior(shape)),
            basis: PlanBasis::new(config.objective.belief),
            walk: config.planner(&Policy::learned(PlannerKind::RandomWalk)),
            beam: config.planner(&Policy::learned(PlannerKind::Beam)),
            seed: planner_seed(config, observation.result.seed),
            visited: Vec::new(),
            planning: Duration::ZERO,
            observation,
        }
    }

    /// Begins a track with the frame that the world shows.
    ///
    /// # Errors
    /// [`ZeroEvidence`].
    pub fn begin(&mut self, world: u32, learner: &mut Learner) -> Result<(), ZeroEvidence> {
        learner.begin(world);
        let frame = &self.observation.frame;
        learner.see(world, self.filter.belief(), frame);
        self.filter.correct(frame)?;
        self.predict();
        Ok(())
    }

    /// Moves the belief to the next step.
    pub fn predict(&mut self) {
        self.basis.see(self.filter.belief());
        self.filter.predict();
    }

    /// Goes on where a checkpoint left it, if the world still shows what it showed then; else begins
    /// a new track. Returns whether it goes on.
    ///
    /// # Errors
    /// [`ZeroEvidence`].
    pub fn go_on(
        &mut self,
        world: u32,
        stand: Option<&Stand>,
        learner: &mut Learner,
    ) -> Result<bool, ZeroEvidence> {
        match stand {
            Some(stand) if stand.is_of(&self.observation) && learner.has_track(world) => {
                self.filter.set_belief(stand.belief.clone());
                if let Some(estimate) = &stand.estimate {
                    self.basis.see(estimate);
                }
                Ok(true)
            }
            _ => self.begin(world, learner).map(|()| false),
        }
    }

    /// The next path; `target`: the state that pays most.
    pub fn plan(
        &mut self,
        kind: PlannerKind,
        target: usize,
        config: &AgentConfig,
        n_moves: usize,
    ) -> Vec<Move> {
        let start = Instant::now();
        let policy = Policy::learned(kind);
        let mut objective = config.objective(&policy);
        let planner = match kind {
            PlannerKind::RandomWalk => &mut self.walk,
            PlannerKind::Shooting | PlannerKind::Beam => {
                objective.target = Target::State(target);
                &mut self.beam
            }
        };
        let values = objective.values(self.basis.belief(self.filter.belief()));
        let problem = PlanningProblem {
            start: self.observation.robot(),
            n_moves,
            values: &values,
            seed: self.seed,
            step: self.observation.result.step,
        };
        let moves = planner.plan(&problem).moves;
        let shape = self.filter.belief().shape();
        self.visited = fly(shape, problem.start, &moves).visited;
        self.planning = start.elapsed();
        moves
    }

    /// Scores the prediction of a frame, hands it to the learner and corrects the belief with it.
    ///
    /// # Errors
    /// [`ZeroEvidence`].
    pub fn take_in(
        &mut self,
        world: u32,
        observation: Observation,
        learner: &mut Learner,
    ) -> Result<Score, ZeroEvidence> {
        self.observation = observation;
        let Observation { result, frame } = &self.observation;
        let score = score(self.filter.belief(), self.filter.likelihood(), frame);
        learner.see(world, self.filter.belief(), frame);
        self.filter.correct(frame)?;
        learner.reward(self.filter.belief(), &self.visited, result.reward);
        Ok(score)
    }
}
