//! One agent on one world: plan, then correct and predict. Pure; the wire is elsewhere.

use crate::config::AgentConfig;
use crate::parallel::in_parallel;
use crate::policy::Policy;
use anyhow::{Context, Result};
use emberwatch_belief::estimation::Estimator;
use emberwatch_belief::estimation::belief::{Belief, BeliefError};
use emberwatch_belief::estimation::scoring::{Score, score};
use emberwatch_belief::planning::options::choose_by_rule;
use emberwatch_belief::planning::team::{ROUNDS, plan_team};
use emberwatch_belief::planning::{
    BasisKind, CellValues, Memory, OPTIONS, Objective, OptionPlanner, Outlook, PathOption, Plan,
    Planner, Proposal, RandomWalk, Target,
};
use emberwatch_messages::agent_belief::Intent;
use emberwatch_model::{Airspace, Cell, Frame, Grid};
use emberwatch_network::Dqn;
use std::sync::Arc;
use std::time::Duration;

/// What a path that was not planned was for.
const RANDOM_MOVES: &str = "random moves";

const NO_TRUTH: &str = "the policy needs the truth channel: start the server with --publish-truth";

/// A policy at work on one world.
pub struct Agent {
    policy: Policy,
    chooser: Chooser,
    estimator: Box<dyn Estimator>,
    pub(crate) basis: BasisKind,
    /// The last estimate p_k, where paths are planned on it.
    estimate: Option<Belief>,
    planner: Box<dyn Planner + Send>,
    options: OptionPlanner,
    pub memory: Memory,
    /// What the belief calls the state that pays most.
    target: usize,
    /// What the last path was for, in a word or two.
    aim: String,
    state_names: Vec<String>,
    n_moves: usize,
    seed: u64,
    /// Where its robots may fly and what they see.
    airspace: Airspace,
}

/// What says what each path is for.
pub enum Chooser {
    /// Always this.
    Objective(Objective),
    /// A DQN, given the estimator after its prediction (paper eq. 17).
    Network(Decider),
    Options(OptionChooser),
}

pub type Decider = Box<dyn Fn(&dyn Estimator) -> Objective + Send>;

/// What chooses among options.
pub enum OptionChooser {
    Always(&'static PathOption),
    Rule,
    /// The option whose features are worth most to a DQN.
    Scorer(Arc<Dqn>),
}

/// What an agent has beside its estimator and its policy.
pub struct Setup {
    pub chooser: Chooser,
    pub basis: BasisKind,
    /// Width of the beam search that plans options.
    pub beam_width: usize,
    pub state_names: Vec<String>,
    pub n_moves: usize,
    /// Seed of the planner's random numbers: the agent's and the world's.
    pub seed: u64,
    /// What the belief calls the state that pays most.
    pub target: usize,
    /// Where its robots may fly and what they see.
    pub airspace: Airspace,
}

impl Agent {
    /// An agent before its first frame.
    pub fn new(
        estimator: Box<dyn Estimator>,
        policy: &Policy,
        config: &AgentConfig,
        setup: Setup,
    ) -> Self {
        let is_random = !policy.planner.has_goal;
        let aim = if is_random {
            RANDOM_MOVES
        } else {
            "nothing yet"
        };
        Self {
            policy: policy.clone(),
            chooser: setup.chooser,
            memory: Memory::new(estimator.belief().shape()),
            estimator,
            basis: setup.basis,
            estimate: None,
            planner: (policy.planner.build)(config),
            options: OptionPlanner::new(setup.beam_width),
            target: setup.target,
            aim: aim.into(),
            state_names: setup.state_names,
            n_moves: setup.n_moves,
            seed: setup.seed,
            airspace: setup.airspace,
        }
    }

    /// Where its robots may fly and what they see.
    pub fn airspace(&self) -> &Airspace {
        &self.airspace
    }

    /// What the belief calls the state that pays most.
    pub fn target(&self) -> usize {
        self.target
    }

    /// The paths for step k -> k + 1, from where the robots are (paper eq. 15).
    pub fn plan(&mut self, robots: &[Cell], step: u64) -> Vec<Plan> {
        let objective = match &self.chooser {
            Chooser::Objective(objective) => *objective,
            Chooser::Network(decide) => decide(&*self.estimator),
            Chooser::Options(_) => return self.plan_options(robots),
        };
        self.plan_for(objective, robots, step)
    }

    /// As [`Self::plan`], for an objective other than the policy's.
    pub fn plan_for(&mut self, objective: Objective, robots: &[Cell], step: u64) -> Vec<Plan> {
        let aim = if !self.policy.planner.has_goal {
            RANDOM_MOVES.into()
        } else {
            objective.target.label(&self.state_names)
        };
        let values = objective.values_in(self.basis_belief(), &self.airspace);
        self.plan_values(&values, &aim, robots, step)
    }

    /// As [`Self::plan`], for values of cells; `aim`: what they stand for.
    pub fn plan_values(
        &mut self,
        values: &CellValues,
        aim: &str,
        robots: &[Cell],
        step: u64,
    ) -> Vec<Plan> {
        aim.clone_into(&mut self.aim);
        let (planner, random) = (&mut *self.planner, (self.seed, step));
        plan_team(planner, values, robots, self.n_moves, random, ROUNDS)
    }

    /// As [`Self::plan`], on a belief other than the agent's.
    #[cfg(test)]
    pub(crate) fn plan_on(&mut self, belief: &Belief, robots: &[Cell], step: u64) -> Vec<Plan> {
        let own = self.estimate.replace(belief.clone());
        let plans = self.plan(robots, step);
        self.estimate = own;
        plans
    }

    /// All options from a robot's cell, with what they promise.
    pub fn propose(&mut self, robot: Cell) -> Vec<Proposal> {
        self.options.propose(&self.outlook(), robot)
    }

    /// The path of an option that was proposed and is flown now.
    pub fn take_up(&mut self, option: usize, proposal: Proposal) -> Plan {
        OPTIONS[option].name.clone_into(&mut self.aim);
        proposal.plan
    }

    /// What the grid promises a robot now.
    fn outlook(&self) -> Outlook {
        let (belief, air) = (self.basis_belief(), &self.airspace);
        Outlook::new(belief, air, self.target, &self.memory, self.n_moves)
    }

    /// The belief that paths are planned on.
    pub fn basis_belief(&self) -> &Belief {
        self.estimate.as_ref().unwrap_or(self.estimator.belief())
    }

    /// Each robot's choice, one after the other: what one of them visits is worth nothing to the next.
    fn plan_options(&mut self, robots: &[Cell]) -> Vec<Plan> {
        let mut outlook = self.outlook();
        let mut plans: Vec<Plan> = Vec::with_capacity(robots.len());
        for (index, &robot) in robots.iter().enumerate() {
            if let Some(last) = plans.last() {
                let visited = self.airspace.fly(robots[index - 1], &last.moves).visited;
                outlook = outlook.without(&visited);
            }
            plans.push(self.plan_option(&outlook, robot));
        }
        plans
    }

    fn plan_option(&mut self, outlook: &Outlook, robot: Cell) -> Plan {
        let option = match &self.chooser {
            Chooser::Options(OptionChooser::Always(option)) => option,
            Chooser::Options(OptionChooser::Scorer(scorer)) => {
                let mut proposals = self.options.propose(outlook, robot);
                let features: Vec<f32> = proposals.iter().flat_map(|it| it.features).collect();
                let best = scorer.best(&features);
                OPTIONS[best].name.clone_into(&mut self.aim);
                return proposals.swap_remove(best).plan;
            }
            _ => choose_by_rule(outlook, robot),
        };
        option.name.clone_into(&mut self.aim);
        self.options.plan(option, outlook, robot)
    }

    /// As [`Self::plan`], paths of random moves.
    pub fn walk(&mut self, robots: &[Cell], step: u64) -> Vec<Plan> {
        self.aim = RANDOM_MOVES.into();
        let new_cells = Objective::new(Target::Coverage);
        let values = new_cells.values_in(self.estimator.belief(), &self.airspace);
        let (planner, random) = (&mut RandomWalk, (self.seed, step));
        plan_team(planner, &values, robots, self.n_moves, random, ROUNDS)
    }

    /// How well the belief predicts a frame; `None` of an estimator that predicts none.
    pub fn score(&self, frame: &Frame) -> Option<Score> {
        let likelihood = self.estimator.likelihood()?;
        Some(score(self.estimator.belief(), &likelihood, frame))
    }

    /// Takes in a frame of X_k (paper eq. 5); `truth` is X_k, for oracles, which must be told it.
    ///
    /// # Errors
    /// Also if an oracle is not told. The belief is then as it was.
    pub fn correct(&mut self, frame: &Frame, truth: Option<&Grid<u8>>) -> Result<()> {
        self.estimator.correct(frame)?;
        if let Some(told) = self.estimator.told() {
            told.tell(truth.context(NO_TRUTH)?)?;
        }
        self.memory.see(frame);
        Ok(())
    }

    /// Takes in what the last path brought.
    pub fn earn(&mut self, reward: f64) {
        self.memory.earn(reward, self.n_moves);
    }

    /// Moves the belief from X_k to X_{k+1} (paper eq. 6).
    pub fn predict(&mut self) {
        Self::predict_all([self]);
    }

    /// [`Self::predict`] of several agents.
    pub fn predict_all<'a>(agents: impl IntoIterator<Item = &'a mut Self>) {
        let (mut together, mut alone) = (Vec::new(), Vec::new());
        for agent in agents {
            if agent.basis == BasisKind::Estimate {
                agent.estimate = Some(agent.estimator.belief().clone());
            }
            let estimator = &mut *agent.estimator;
            match estimator.predict_together() {
                Some(_) => together.push(estimator),
                None => alone.push(estimator),
            }
        }
        in_parallel(alone, Estimator::predict);
        let predict = together.first().and_then(|first| first.predict_together());
        if let Some(predict) = predict {
            predict(together);
        }
    }

    /// Goes on from an estimate p_k, if paths are planned on it.
    pub fn remember_estimate(&mut self, estimate: Option<&Belief>) {
        if self.basis == BasisKind::Estimate {
            self.estimate = estimate.cloned();
        }
    }

    /// Tells an oracle the state X_{k+1} that its next path will meet; others ignore it.
    pub fn foresee(&mut self, next: &Grid<u8>) -> Result<(), BeliefError> {
        self.estimator.told().map_or(Ok(()), |told| told.tell(next))
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

    /// Names what [`Self::handover`] gives; `None` of an agent whose bytes no other can go on from.
    pub fn handover_kind(&self) -> Option<String> {
        let kind = self.estimator.handover()?.kind();
        Some(handover_of(&kind))
    }

    /// All that it knows of its world before X_{k+1}: what its estimator does, and its memory.
    pub fn handover(&self) -> Option<Vec<u8>> {
        let estimator = self.estimator.handover()?.to_bytes();
        Some([estimator, self.memory.to_bytes()].concat())
    }

    /// Goes on from the bytes of an agent of the same kind. Returns false, and changes nothing, if they do not fit.
    pub fn take_over(&mut self, bytes: &[u8]) -> bool {
        let shape = self.belief().shape();
        let Some(n_bytes) = bytes.len().checked_sub(Memory::n_bytes(shape)) else {
            return false;
        };
        let (estimator, memory) = bytes.split_at(n_bytes);
        let Some(memory) = Memory::from_bytes(memory, shape) else {
            return false;
        };
        let own = self.estimator.handover_mut();
        let is_taken = own.is_some_and(|own| own.restore(estimator));
        if is_taken {
            self.memory = memory;
        }
        is_taken
    }

    /// Goes on with another estimator, such as one with newer parameters.
    pub fn set_estimator(&mut self, estimator: Box<dyn Estimator>) {
        self.estimator = estimator;
    }

    /// The estimate p_k, where paths are planned on it.
    pub fn estimate(&self) -> Option<&Belief> {
        self.estimate.as_ref()
    }

    /// What it tells observers; `planning`: time that its last plan took.
    pub fn intent(&self, planning: Duration) -> Intent {
        Intent {
            policy: self.policy.name.clone(),
            belief_from: self.policy.belief.label.into(),
            objective: self.aim.clone(),
            states: self.state_names.clone(),
            plan_millis: planning.as_secs_f64() * 1e3,
        }
    }

    pub fn policy(&self) -> &Policy {
        &self.policy
    }
}

/// Names what an agent hands over whose estimator's bytes are of a kind.
pub fn handover_of(kind: &str) -> String {
    format!("{kind}; freshness [H, W] as f32, rewards, paths")
}
