//! One agent on one world: plan, then correct and predict. Pure; the wire is elsewhere.

use crate::config::AgentConfig;
use crate::estimation::Estimator;
use crate::estimation::belief::{Belief, BeliefError};
use crate::estimation::scoring::Score;
use crate::planning::action::Action;
use crate::planning::policy::{PlannerKind, Policy};
use crate::planning::team::{ROUNDS, plan_team};
use crate::planning::{Objective, Plan, PlanBasis, Planner, RandomWalk, Target};
use anyhow::Result;
use protocol::agent_belief::Intent;
use protocol::{Cell, Frame, Grid};
use std::time::Duration;

/// What a path that was not planned was for.
pub const RANDOM_MOVES: &str = "random moves";

/// A policy at work on one world.
pub struct Agent {
    policy: Policy,
    pub(crate) objective: Objective,
    estimator: Box<dyn Estimator>,
    pub(crate) basis: PlanBasis,
    planner: Box<dyn Planner + Send>,
    decider: Option<Box<dyn Decider>>,
    /// The state that pays most, where that is learned.
    target: Option<usize>,
    /// What the last path was for.
    pub(crate) aim: Aim,
    state_names: Vec<String>,
    n_moves: usize,
    seed: u64,
}

/// What a path was for.
pub(crate) enum Aim {
    Nothing,
    Walk,
    Objective(Target),
    Action(String),
}

/// Chooses what each path is for (paper eq. 17), given the estimator after its prediction.
pub trait Decider: Send {
    /// The choice for a robot's cell.
    fn decide(&self, estimator: &dyn Estimator, robot: Cell, n_moves: usize) -> Choice;
}

/// What a path may be for.
pub enum Choice {
    /// The cells that are worth most.
    Objective(Objective),
    /// One of [`crate::planning::action::ActionSet`].
    Action(Action),
}

/// What an agent has beside its estimator and its policy.
#[derive(Debug, Clone)]
pub struct Setup {
    pub basis: PlanBasis,
    pub state_names: Vec<String>,
    pub n_moves: usize,
    /// Seed of the planner's random numbers: the agent's and the world's.
    pub seed: u64,
}

impl Agent {
    /// An agent before its first frame.
    pub fn new(
        estimator: Box<dyn Estimator>,
        policy: &Policy,
        config: &AgentConfig,
        setup: Setup,
    ) -> Self {
        Self {
            policy: policy.clone(),
            objective: config.objective(policy),
            estimator,
            basis: setup.basis,
            planner: config.planner(policy),
            decider: None,
            target: None,
            aim: Aim::Nothing,
            state_names: setup.state_names,
            n_moves: setup.n_moves,
            seed: setup.seed,
        }
    }

    /// The same, for a belief that calls what pays most a state of its own.
    pub fn with_target(mut self, target: Option<usize>) -> Self {
        self.target = target;
        if let (Target::State(state), Some(target)) = (&mut self.objective.target, target) {
            *state = target;
        }
        self
    }

    /// The same, with what chooses its objectives.
    pub fn with_decider(mut self, decider: Option<Box<dyn Decider>>) -> Self {
        self.decider = decider;
        self
    }

    /// The state that the belief calls what pays most; `otherwise` unless that is learned.
    pub fn target(&self, otherwise: usize) -> usize {
        self.target.unwrap_or(otherwise)
    }

    /// The paths for step k -> k + 1, from where the robots are (paper eq. 15). Decisions are made for the first robot.
    pub fn plan(&mut self, robots: &[Cell], step: u64) -> Vec<Plan> {
        let estimator = &*self.estimator;
        let decided = self.decider.as_ref();
        let decided = decided.map(|decider| decider.decide(estimator, robots[0], self.n_moves));
        let always = || self.policy.action.clone().map(Choice::Action);
        match decided.or_else(always) {
            Some(Choice::Action(action)) => self.plan_action(&action, robots, step),
            Some(Choice::Objective(objective)) => self.plan_for(objective, robots, step),
            None => self.plan_for(self.objective, robots, step),
        }
    }

    /// As [`Self::plan`], for an action other than the policy's.
    pub fn plan_action(&mut self, action: &Action, robots: &[Cell], step: u64) -> Vec<Plan> {
        self.aim = Aim::Action(action.name.clone());
        let belief = self.basis.belief(self.estimator.belief());
        let random = (self.seed, step);
        action.plan(&mut *self.planner, belief, robots, self.n_moves, random)
    }

    /// As [`Self::plan`], for an objective other than the policy's.
    pub fn plan_for(&mut self, objective: Objective, robots: &[Cell], step: u64) -> Vec<Plan> {
        self.aim = Aim::Objective(objective.target);
        let values = objective.values(self.basis.belief(self.estimator.belief()));
        let (planner, random) = (&mut *self.planner, (self.seed, step));
        plan_team(planner, &values, robots, self.n_moves, random, ROUNDS)
    }

    /// As [`Self::plan`], paths of random moves.
    pub fn walk(&mut self, robots: &[Cell], step: u64) -> Vec<Plan> {
        self.aim = Aim::Walk;
        let values = self.objective.values(self.estimator.belief());
        let (planner, random) = (&mut RandomWalk, (self.seed, step));
        plan_team(planner, &values, robots, self.n_moves, random, ROUNDS)
    }

    /// How well the belief predicts a frame; `None` of an estimator that predicts none.
    pub fn score(&self, frame: &Frame) -> Result<Option<Score>> {
        Ok(self.estimator.score(frame)?)
    }

    /// Takes in a frame of X_k (paper eq. 5); `truth` is X_k, for policies that are fed with it.
    ///
    /// # Errors
    /// The belief is then as it was.
    pub fn correct(&mut self, frame: &Frame, truth: Option<&Grid<u8>>) -> Result<()> {
        Ok(self.estimator.correct(frame, truth)?)
    }

    /// Moves the belief from X_k to X_{k+1} (paper eq. 6).
    pub fn predict(&mut self) {
        self.basis.see(self.estimator.belief());
        self.estimator.predict();
    }

    /// Tells a clairvoyant agent the state X_{k+1} that its next path will meet; others ignore it.
    pub fn foresee(&mut self, next: &Grid<u8>) -> Result<(), BeliefError> {
        self.estimator.foresee(next)
    }

    /// The belief: about X_k after `correct`, about X_{k+1} after `predict`.
    pub fn belief(&self) -> &Belief {
        self.estimator.belief()
    }

    pub fn estimator(&self) -> &dyn Estimator {
        &*self.estimator
    }

    pub fn estimator_mut(&mut self) -> &mut dyn Estimator {
        &mut *self.estimator
    }

    pub fn basis_mut(&mut self) -> &mut PlanBasis {
        &mut self.basis
    }

    /// The estimate p_k, where paths are planned on it.
    pub fn estimate(&self) -> Option<&Belief> {
        self.basis.estimate()
    }

    /// What the last path was for, in a word or two.
    fn aim(&self) -> String {
        match &self.aim {
            _ if self.policy.planner == PlannerKind::RandomWalk => RANDOM_MOVES.into(),
            Aim::Walk => RANDOM_MOVES.into(),
            Aim::Nothing => "nothing yet".into(),
            Aim::Objective(target) => target.label(&self.state_names),
            Aim::Action(name) => name.clone(),
        }
    }

    /// What it tells observers; `planning`: time that its last plan took.
    pub fn intent(&self, planning: Duration) -> Intent {
        Intent {
            policy: self.policy.name.clone(),
            belief_from: self.policy.estimator.label().into(),
            objective: self.aim(),
            states: self.state_names.clone(),
            plan_millis: planning.as_secs_f64() * 1e3,
        }
    }

    pub fn policy(&self) -> &Policy {
        &self.policy
    }
}

/// Names of states that were learned.
pub fn numbered_states(n_states: usize) -> Vec<String> {
    (0..n_states)
        .map(|state| format!("state {state}"))
        .collect()
}
