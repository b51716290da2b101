//! One agent in one world: plan, correct, predict. It does not communicate.

use crate::beliefs::Traits;
use crate::config::AgentConfig;
use crate::parallel::in_parallel;
use crate::policy::{Policy, RANDOM};
use anyhow::{Context, Result};
use emberwatch_belief::estimation::Estimator;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::scoring::{Score, score};
use emberwatch_belief::planning::options::choose_by_rule;
use emberwatch_belief::planning::team::{ROUNDS, plan_team};
use emberwatch_belief::planning::{
    CellValues, Memory, OPTIONS, Objective, OptionPlanner, PathOption, Plan, Planner, Proposal,
    RandomWalk, Target, ValueLayers,
};
use emberwatch_messages::agent_belief::Intent;
use emberwatch_model::{Airspace, Cell, Frame, Grid};
use emberwatch_network::Dqn;
use std::sync::Arc;
use std::time::Duration;

const RANDOM_MOVES: &str = "random moves";

const NO_TRUTH: &str = "the policy needs the truth channel: start the server with --publish-truth";

/// A policy that acts in one world.
pub struct Agent {
    policy: Policy,
    chooser: Chooser,
    estimator: Box<dyn Estimator>,
    planner: Box<dyn Planner + Send>,
    options: OptionPlanner,
    pub memory: Memory,
    target: usize,
    aim: String,
    state_names: Vec<String>,
    n_moves: usize,
    seed: u64,
    airspace: Airspace,
}

/// Chooses the purpose of each path.
pub enum Chooser {
    /// Always the same objective.
    Objective(Objective),
    /// A DQN, which reads the estimator after its prediction (paper eq. 17).
    Network(Decider),
    /// Always the same option.
    Option(&'static PathOption),
    /// The option that a hand-written rule chooses.
    Rule,
    /// The option whose features have the highest value under a DQN.
    Scorer(Arc<Dqn>),
}

pub type Decider = Box<dyn Fn(&dyn Estimator) -> Objective + Send>;

/// The parts of an agent besides its estimator and its policy.
pub struct Setup {
    pub chooser: Chooser,
    /// Width of the beam search that plans options.
    pub beam_width: usize,
    pub state_names: Vec<String>,
    pub n_moves: usize,
    /// Seed of the planner's random numbers, derived from the agent's seed and the world's seed.
    pub seed: u64,
    /// The index, in the belief, of the state with the highest reward.
    pub target: usize,
    /// The cells that robots may fly over, and the range of their sensors.
    pub airspace: Airspace,
}

impl Agent {
    /// Creates an agent before its first frame.
    pub fn new(
        estimator: Box<dyn Estimator>,
        policy: &Policy,
        config: &AgentConfig,
        setup: Setup,
    ) -> Self {
        let is_random = *policy.planner == RANDOM;
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

    /// Returns the cells that robots may fly over, and the range of their sensors.
    pub fn airspace(&self) -> &Airspace {
        &self.airspace
    }

    /// Returns the index, in the belief, of the state with the highest reward.
    pub fn target(&self) -> usize {
        self.target
    }

    /// Plans the paths for step k -> k + 1 from the robots' cells (paper eq. 15).
    pub fn plan(&mut self, robots: &[Cell], step: u64) -> Vec<Plan> {
        let objective = match &self.chooser {
            Chooser::Objective(objective) => *objective,
            Chooser::Network(decide) => decide(&*self.estimator),
            _ => return self.plan_options(robots),
        };
        self.plan_for(objective, robots, step)
    }

    /// Plans paths as [`Self::plan`] does, but for the given objective instead of the policy's objective.
    pub fn plan_for(&mut self, objective: Objective, robots: &[Cell], step: u64) -> Vec<Plan> {
        let aim = if *self.policy.planner == RANDOM {
            RANDOM_MOVES.into()
        } else {
            objective.target.label(&self.state_names)
        };
        let values = objective.values_in(self.belief(), &self.airspace);
        self.plan_values(&values, &aim, robots, step)
    }

    /// Plans paths as [`Self::plan`] does, but for the given values of cells. `aim` describes the values to observers.
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

    /// Plans all options from a robot's cell. Each proposal contains the path and the features of one option.
    pub fn propose(&mut self, robot: Cell) -> Vec<Proposal> {
        self.options.propose(&self.layers(), robot)
    }

    /// Records a proposed option as the aim of the next path, and returns its plan.
    pub fn take_up(&mut self, option: usize, proposal: Proposal) -> Plan {
        OPTIONS[option].name.clone_into(&mut self.aim);
        proposal.plan
    }

    fn layers(&self) -> ValueLayers {
        let (belief, air) = (self.belief(), &self.airspace);
        ValueLayers::new(belief, air, self.target, &self.memory, self.n_moves)
    }

    /// Plans an option for each robot in turn. Cells that an earlier robot visits have no value for later robots.
    fn plan_options(&mut self, robots: &[Cell]) -> Vec<Plan> {
        let mut layers = self.layers();
        let mut plans: Vec<Plan> = Vec::with_capacity(robots.len());
        for (index, &robot) in robots.iter().enumerate() {
            if let Some(last) = plans.last() {
                let visited = self.airspace.fly(robots[index - 1], &last.moves).visited;
                layers = layers.without(&visited);
            }
            plans.push(self.plan_option(&layers, robot));
        }
        plans
    }

    fn plan_option(&mut self, layers: &ValueLayers, robot: Cell) -> Plan {
        let option = match &self.chooser {
            Chooser::Option(option) => option,
            Chooser::Scorer(scorer) => {
                let mut proposals = self.options.propose(layers, robot);
                let features: Vec<f32> = proposals.iter().flat_map(|it| it.features).collect();
                let best = scorer.best(&features);
                OPTIONS[best].name.clone_into(&mut self.aim);
                return proposals.swap_remove(best).plan;
            }
            _ => choose_by_rule(layers, robot),
        };
        option.name.clone_into(&mut self.aim);
        self.options.plan(option, layers, robot)
    }

    /// Plans random moves.
    pub fn walk(&mut self, robots: &[Cell], step: u64) -> Vec<Plan> {
        self.aim = RANDOM_MOVES.into();
        let new_cells = Objective::new(Target::Coverage);
        let values = new_cells.values_in(self.belief(), &self.airspace);
        let (planner, random) = (&mut RandomWalk, (self.seed, step));
        plan_team(planner, &values, robots, self.n_moves, random, ROUNDS)
    }

    /// Scores the belief's prediction of a frame. Returns `None` if the estimator does not predict frames.
    pub fn score(&self, frame: &Frame) -> Option<Score> {
        let observation_model = self.traits().observation_model?(&*self.estimator);
        let likelihood = observation_model.likelihood()?;
        Some(score(self.estimator.belief(), &likelihood, frame))
    }

    /// Corrects the belief with a frame of X_k (paper eq. 5). `truth` is X_k, which oracles require.
    ///
    /// # Errors
    /// If the frame is impossible under the belief, or an oracle lacks the truth. The belief then remains unchanged.
    pub fn correct(&mut self, frame: &Frame, truth: Option<&Grid<u8>>) -> Result<()> {
        self.estimator.correct(frame)?;
        if let Some(told) = self.traits().told {
            told(&mut *self.estimator).tell(truth.context(NO_TRUTH)?)?;
        }
        self.memory.see(frame);
        Ok(())
    }

    /// Records the reward of the last path.
    pub fn earn(&mut self, reward: f64) {
        self.memory.earn(reward, self.n_moves);
    }

    /// Predicts the belief about X_{k+1} from the belief about X_k (paper eq. 6).
    pub fn predict(&mut self) {
        Self::predict_all([self]);
    }

    /// Predicts the beliefs of several agents, all of the same kind, as [`Self::predict`] does for one.
    pub fn predict_all<'a>(agents: impl IntoIterator<Item = &'a mut Self>) {
        let mut together = None;
        let mut estimators = Vec::new();
        for agent in agents {
            together = agent.traits().predict_together;
            estimators.push(&mut *agent.estimator);
        }
        match together {
            Some(predict) => predict(estimators),
            None => {
                in_parallel(estimators, Estimator::predict);
            }
        }
    }

    fn traits(&self) -> &Traits {
        &self.policy.belief.traits
    }

    /// Returns the belief, which is about X_k after `correct` and about X_{k+1} after `predict`.
    pub fn belief(&self) -> &Belief {
        self.estimator.belief()
    }

    pub fn estimator(&self) -> &dyn Estimator {
        &*self.estimator
    }

    /// Returns the name of the format of [`Self::handover`]. `None` if no other agent can resume from this agent.
    pub fn handover_kind(&self) -> Option<String> {
        let kind = self.traits().handover?(&*self.estimator).kind();
        Some(format!("{kind}; freshness [H, W] as f32, rewards, paths"))
    }

    /// Encodes the estimator's state and the agent's memory before the frame of X_{k+1}.
    pub fn handover(&self) -> Option<Vec<u8>> {
        let estimator = self.traits().handover?(&*self.estimator).to_bytes();
        Some([estimator, self.memory.to_bytes()].concat())
    }

    /// Resumes from the handover of an agent of the same kind. Returns false and changes nothing if it does not fit.
    pub fn take_over(&mut self, bytes: &[u8]) -> bool {
        let shape = self.belief().shape();
        let Some(n_bytes) = bytes.len().checked_sub(Memory::n_bytes(shape)) else {
            return false;
        };
        let (estimator, memory) = bytes.split_at(n_bytes);
        let Some(memory) = Memory::from_bytes(memory, shape) else {
            return false;
        };
        let handover = self.traits().handover_mut;
        let is_taken = handover.is_some_and(|own| own(&mut *self.estimator).restore(estimator));
        if is_taken {
            self.memory = memory;
        }
        is_taken
    }

    /// Replaces the estimator, for example with one that has newer parameters.
    pub fn set_estimator(&mut self, estimator: Box<dyn Estimator>) {
        self.estimator = estimator;
    }

    /// Returns the message for observers. `planning` is the time that the last planning took.
    pub fn intent(&self, planning: Duration) -> Intent {
        Intent {
            policy: self.policy.name.clone(),
            belief_from: self.policy.belief.name.into(),
            objective: self.aim.clone(),
            states: self.state_names.clone(),
            plan_millis: planning.as_secs_f64() * 1e3,
        }
    }

    pub fn policy(&self) -> &Policy {
        &self.policy
    }
}
