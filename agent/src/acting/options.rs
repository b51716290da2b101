//! The beliefs about worlds of one robot each and all options there, for a learner that says what each path is for.
//! Pure: the caller flies.

use crate::acting::registry::{self, Task};
use crate::config::AgentConfig;
use crate::learning::learned::Learned;
use crate::policy::{EstimatorKind, PlannerKind, Policy};
use crate::rollout::agent::Agent;
use anyhow::{Context, Result, ensure};
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::planning::{Proposal, Target};
use emberwatch_protocol::agent_belief::Intent;
use emberwatch_protocol::{Cell, Frame, Model, Shape};
use std::time::{Duration, Instant};

/// What plans options are planned by.
pub struct Crew {
    model: Model,
    shape: Shape,
    n_moves: usize,
    config: AgentConfig,
    learned: Learned,
    policy: Policy,
}

/// A belief about one world, and all options there.
pub struct Planned {
    agent: Agent,
    /// In the order of [`emberwatch_belief::planning::OPTIONS`].
    proposals: Vec<Proposal>,
    /// Time that they took.
    planning: Duration,
}

/// What a world shows after a step or a reset.
#[derive(Debug, Clone)]
pub struct Shown {
    pub frame: Frame,
    /// What the last path paid; `None` before the first.
    pub reward: Option<f64>,
}

impl Crew {
    /// `estimator`: what keeps the beliefs; `None`: what was learned, or else the known model's filter.
    ///
    /// # Errors
    /// If the estimator was not learned, or was in worlds of another form; words begin with `checkpoint`.
    pub fn new(
        estimator: Option<EstimatorKind>,
        learned: Learned,
        model: Model,
        shape: Shape,
        n_moves: usize,
    ) -> Result<Self> {
        let kind = estimator.unwrap_or_else(|| learned.estimator());
        let label = kind.label();
        ensure!(
            learned.network.is_none(),
            "checkpoint: expected one of a belief that options are planned on, such as {label}, got an autoencoder's"
        );
        if kind.is_learned() {
            let belief = learned.belief(kind);
            belief
                .with_context(|| format!("checkpoint: expected one of a {label}, got none"))?
                .check_world(&registry::world_form(&model))?;
        }
        let target = Target::State(model.target_state());
        Ok(Self {
            policy: Policy::new("options", kind, PlannerKind::Beam, target),
            model,
            shape,
            n_moves,
            config: AgentConfig::default(),
            learned,
        })
    }

    pub fn estimator(&self) -> EstimatorKind {
        self.policy.estimator
    }

    pub fn model(&self) -> &Model {
        &self.model
    }

    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// Moves of a path.
    pub fn n_moves(&self) -> usize {
        self.n_moves
    }

    /// A belief before the first frame; `prior`: the filter's, where it knows the model.
    pub fn begun(&self, prior: &Belief, world_seed: u64) -> Result<Planned> {
        let task = Task {
            model: &self.model,
            shape: self.shape,
            n_moves: self.n_moves,
            prior,
            seed: self.config.planner_seed(world_seed),
            learned: &self.learned,
        };
        Ok(Planned {
            agent: registry::agent(&self.policy, &self.config, task)?,
            proposals: Vec::new(),
            planning: Duration::ZERO,
        })
    }
}

impl Planned {
    /// Takes in what the world shows; the belief is then the posterior.
    pub fn see(&mut self, shown: &Shown) -> Result<()> {
        self.agent.correct(&shown.frame, None)?;
        if let Some(reward) = shown.reward {
            self.agent.earn(reward);
        }
        Ok(())
    }

    pub fn predict(&mut self) {
        self.agent.predict();
    }

    /// Plans all options from the robot's cell.
    pub fn plan(&mut self, robot: Cell) {
        let start = Instant::now();
        self.proposals = self.agent.propose(robot);
        self.planning = start.elapsed();
    }

    /// What the last plans promise and fly, in the order of `OPTIONS`; nothing before the first.
    pub fn proposals(&self) -> &[Proposal] {
        &self.proposals
    }

    /// The option that was flown, for those who watch.
    pub fn intent(&mut self, flown: Option<usize>) -> Intent {
        if let Some(proposal) = flown.and_then(|index| self.proposals.get(index)) {
            self.agent
                .take_up(flown.unwrap_or_default(), proposal.clone());
        }
        self.agent.intent(self.planning)
    }

    pub fn agent(&self) -> &Agent {
        &self.agent
    }

    /// Goes on from the belief that another left, as [`Agent::take_over`].
    pub fn take_over(&mut self, kind: &str, bytes: &[u8]) -> bool {
        self.agent.handover_kind().is_some_and(|own| own == kind) && self.agent.take_over(bytes)
    }
}
