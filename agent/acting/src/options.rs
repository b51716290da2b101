//! Beliefs about single-robot worlds and the plans of all options, for an external learner that chooses an option. The
//! caller flies the paths.

use crate::beliefs::autoencoder::AutoencoderModel;
use crate::beliefs::{BELIEFS, BeliefKind, Conditions, RECOMMENDED, WorldForm};
use crate::config::AgentConfig;
use crate::learned::Learned;
use crate::policy::{BY_OPTIONS, Goal, LearnedDecisions, Policy};
use crate::rollout::agent::Agent;
use crate::rollout::building;
use anyhow::{Context, Result, ensure};
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::planning::Proposal;
use emberwatch_model::{Cell, Frame, Model, Shape};

/// The data that all worlds share: the model, the kind of belief with its learned values, and the planner's settings.
pub struct OptionSetup {
    model: Model,
    shape: Shape,
    n_moves: usize,
    config: AgentConfig,
    learned: Learned,
    policy: Policy,
}

/// The belief about one world, and the plans of all options in it.
pub struct OptionAgent {
    agent: Agent,
    /// In the order of [`emberwatch_belief::planning::OPTIONS`].
    proposals: Vec<Proposal>,
}

/// The observation of a world after a step or a reset.
#[derive(Debug, Clone)]
pub struct Shown {
    pub frame: Frame,
    /// Reward of the last path. `None` before the first path.
    pub reward: Option<f64>,
}

impl OptionSetup {
    /// Creates the shared data. If `estimator` is `None`, the checkpoint's estimator is used, or [`RECOMMENDED`] if
    /// there is no checkpoint.
    ///
    /// # Errors
    /// If the checkpoint lacks the estimator, or was trained in worlds of another form. The message begins with
    /// `checkpoint`.
    pub fn new(
        estimator: Option<&'static BeliefKind>,
        learned: Learned,
        model: Model,
        shape: Shape,
        n_moves: usize,
    ) -> Result<Self> {
        let kind = estimator.unwrap_or_else(|| usual(&learned));
        ensure!(
            learned.get::<AutoencoderModel>().is_none(),
            "checkpoint: expected a belief that options can be planned on, such as {}, got an autoencoder",
            RECOMMENDED.name
        );
        kind.learned(&learned).context("checkpoint")?;
        kind.check(&learned, &WorldForm::of(&model, shape))?;
        Ok(Self {
            policy: Policy {
                name: "options".into(),
                belief: kind,
                planner: &BY_OPTIONS,
                // A placeholder: the external learner chooses the option.
                goal: Goal::Rule,
            },
            model,
            shape,
            n_moves,
            config: AgentConfig::default(),
            learned,
        })
    }

    pub fn estimator(&self) -> &'static BeliefKind {
        self.policy.belief
    }

    pub fn model(&self) -> &Model {
        &self.model
    }

    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// Returns the number of moves per path.
    pub fn n_moves(&self) -> usize {
        self.n_moves
    }

    /// Creates the belief about one world before its first frame. `prior` is the first belief of known-model filters.
    pub fn begun(&self, prior: &Belief, world_seed: u64) -> Result<OptionAgent> {
        let conditions = Conditions {
            shape: self.shape,
            model: Some(&self.model),
            prior: Some(prior),
            learned: &self.learned,
        };
        let (policy, config) = (&self.policy, &self.config);
        let seed = config.planner_seed(world_seed);
        Ok(OptionAgent {
            agent: building::agent(policy, config, &conditions, self.n_moves, seed)?,
            proposals: Vec::new(),
        })
    }
}

/// Returns the default kind of belief: the kind that learned decisions are based on, otherwise the kind of a
/// learned model, otherwise [`RECOMMENDED`].
pub fn usual(learned: &Learned) -> &'static BeliefKind {
    let decided = learned
        .get::<LearnedDecisions>()
        .map(|decisions| decisions.belief);
    let mut kinds = BELIEFS.iter();
    let found = kinds.find_map(|kind| kind.learned(learned).ok().flatten());
    let found = found.map(|model| model.kind());
    decided.or(found).unwrap_or(RECOMMENDED)
}

impl OptionAgent {
    /// Corrects the belief with a frame, and records the reward.
    pub fn see(&mut self, shown: &Shown) -> Result<()> {
        self.agent.correct(&shown.frame, None)?;
        if let Some(reward) = shown.reward {
            self.agent.earn(reward);
        }
        Ok(())
    }

    /// Predicts the beliefs about several worlds one step ahead.
    pub fn predict_all<'a>(all: impl IntoIterator<Item = &'a mut Self>) {
        Agent::predict_all(all.into_iter().map(|planned| &mut planned.agent));
    }

    /// Plans all options from the robot's cell.
    pub fn plan(&mut self, robot: Cell) {
        self.proposals = self.agent.propose(robot);
    }

    /// Returns the features and paths of the last plans, in the order of `OPTIONS`. Empty before the first plan.
    pub fn proposals(&self) -> &[Proposal] {
        &self.proposals
    }

    pub fn agent(&self) -> &Agent {
        &self.agent
    }

    /// Resumes from another agent's belief. Returns false if the format `kind` or the bytes do not fit.
    pub fn take_over(&mut self, kind: &str, bytes: &[u8]) -> bool {
        self.agent.handover_kind().is_some_and(|own| own == kind) && self.agent.take_over(bytes)
    }
}
