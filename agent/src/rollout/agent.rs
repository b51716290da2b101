//! One agent on one world: plan, then correct and predict. Pure; the wire is elsewhere.

use crate::config::AgentConfig;
use crate::estimation::Estimator;
use crate::estimation::belief::{Belief, BeliefError};
use crate::estimation::scoring::Score;
use crate::planning::action::Action;
use crate::planning::policy::{PlannerKind, Policy};
use crate::planning::team::{ROUNDS, plan_team};
use crate::planning::{BasisKind, Objective, Plan, Planner, RandomWalk, Target};
use anyhow::Result;
use protocol::agent_belief::Intent;
use protocol::{Cell, Frame, Grid};
use std::time::Duration;

/// What a path that was not planned was for.
const RANDOM_MOVES: &str = "random moves";

/// A policy at work on one world.
pub struct Agent {
    policy: Policy,
    /// What each path is for, unless that is decided.
    action: Action,
    decider: Option<Decider>,
    estimator: Box<dyn Estimator>,
    pub(crate) basis: BasisKind,
    /// The last estimate p_k, where paths are planned on it.
    estimate: Option<Belief>,
    planner: Box<dyn Planner + Send>,
    /// The state that pays most, where that is learned.
    target: Option<usize>,
    /// What the last path was for, in a word or two.
    aim: String,
    state_names: Vec<String>,
    n_moves: usize,
    seed: u64,
}

/// Chooses what the next path is for (paper eq. 17), given the estimator after its prediction, a robot's cell and the
/// number of moves.
pub type Decider = Box<dyn Fn(&dyn Estimator, Cell, usize) -> Action + Send>;

/// What an agent has beside its estimator and its policy.
pub struct Setup {
    pub basis: BasisKind,
    pub state_names: Vec<String>,
    pub n_moves: usize,
    /// Seed of the planner's random numbers: the agent's and the world's.
    pub seed: u64,
    /// What the belief calls the state that pays most, where its states were learned.
    pub target: Option<usize>,
    pub decider: Option<Decider>,
}

impl Agent {
    /// An agent before its first frame.
    pub fn new(
        estimator: Box<dyn Estimator>,
        policy: &Policy,
        config: &AgentConfig,
        setup: Setup,
    ) -> Self {
        let mut objective = config.objective(policy);
        if let (Target::State(state), Some(target)) = (&mut objective.target, setup.target) {
            *state = target;
        }
        let plain = || Action::plain(&objective.target.label(&setup.state_names), objective);
        let is_random = policy.planner == PlannerKind::RandomWalk;
        let aim = if is_random {
            RANDOM_MOVES
        } else {
            "nothing yet"
        };
        Self {
            policy: policy.clone(),
            action: policy.action.clone().unwrap_or_else(plain),
            decider: setup.decider,
            estimator,
            basis: setup.basis,
            estimate: None,
            planner: config.planner(policy),
            target: setup.target,
            aim: aim.into(),
            state_names: setup.state_names,
            n_moves: setup.n_moves,
            seed: setup.seed,
        }
    }

    /// The state that the belief calls what pays most; `otherwise` unless that is learned.
    pub fn target(&self, otherwise: usize) -> usize {
        self.target.unwrap_or(otherwise)
    }

    /// What the next path of a robot is for.
    pub(crate) fn choose(&self, robot: Cell) -> Action {
        match &self.decider {
            Some(decide) => decide(&*self.estimator, robot, self.n_moves),
            None => self.action.clone(),
        }
    }

    /// The paths for step k -> k + 1, from where the robots are (paper eq. 15). Decisions are made for the first robot.
    pub fn plan(&mut self, robots: &[Cell], step: u64) -> Vec<Plan> {
        self.plan_action(&self.choose(robots[0]), robots, step)
    }

    /// As [`Self::plan`], for an action other than the policy's.
    pub fn plan_action(&mut self, action: &Action, robots: &[Cell], step: u64) -> Vec<Plan> {
        if self.policy.planner != PlannerKind::RandomWalk {
            self.aim.clone_from(&action.name);
        }
        let belief = self.estimate.as_ref().unwrap_or(self.estimator.belief());
        let random = (self.seed, step);
        action.plan(&mut *self.planner, belief, robots, self.n_moves, random)
    }

    /// As [`Self::plan`], for an objective other than the policy's.
    pub fn plan_for(&mut self, objective: Objective, robots: &[Cell], step: u64) -> Vec<Plan> {
        let name = objective.target.label(&self.state_names);
        self.plan_action(&Action::plain(&name, objective), robots, step)
    }

    /// Tells observers what a path that was planned elsewhere is for.
    pub fn aim_at(&mut self, aim: &str) {
        self.aim = aim.into();
    }

    /// As [`Self::plan`], paths of random moves.
    pub fn walk(&mut self, robots: &[Cell], step: u64) -> Vec<Plan> {
        self.aim = RANDOM_MOVES.into();
        let values = self.action.values(self.estimator.belief());
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
        if self.basis == BasisKind::Estimate {
            self.estimate = Some(self.estimator.belief().clone());
        }
        self.estimator.predict();
    }

    /// Goes on from an estimate p_k, if paths are planned on it.
    pub fn remember_estimate(&mut self, estimate: Option<&Belief>) {
        if self.basis == BasisKind::Estimate {
            self.estimate = estimate.cloned();
        }
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

    /// The estimate p_k, where paths are planned on it.
    pub fn estimate(&self) -> Option<&Belief> {
        self.estimate.as_ref()
    }

    /// What it tells observers; `planning`: time that its last plan took.
    pub fn intent(&self, planning: Duration) -> Intent {
        Intent {
            policy: self.policy.name.clone(),
            belief_from: self.policy.estimator.label().into(),
            objective: self.aim.clone(),
            states: self.state_names.clone(),
            plan_millis: planning.as_secs_f64() * 1e3,
        }
    }

    pub fn policy(&self) -> &Policy {
        &self.policy
    }
}
