//! What a policy is: a belief, a planner, an objective, and what chooses.

use emberwatch_belief::planning::objective::{BEAM_BONUS, Objective, Target};
use emberwatch_belief::planning::options::PathOption;
use serde::{Deserialize, Serialize};
use std::str::FromStr;

/// Whose belief a policy plans on; in settings and checkpoints by [`EstimatorKind::label`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
pub enum EstimatorKind {
    None,
    /// The Bayes filter with the model's parameters (paper section III.A, masked as in III.C); corrections may reach the
    /// neighbours of visited cells.
    Known {
        is_spatial: bool,
    },
    /// The same with learned parameters, of which kernels may be of the cell's own state.
    Learned {
        is_own: bool,
        is_spatial: bool,
    },
    /// A network that keeps space, learned from what was seen.
    Neural,
    /// The paper's dynamic autoencoder (sections III.B and III.C).
    Autoencoder,
    /// The hidden state X_k, predicted one step ahead: an oracle.
    Truth,
    /// The hidden state X_{k+1} that the path will meet: a clairvoyant.
    NextTruth,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum PlannerKind {
    /// Uniform moves: the paper's baseline.
    RandomWalk,
    /// The best of many random paths (paper section III.D).
    Shooting,
    Beam,
    /// Beam search over several paths, of which the first is flown.
    BeamAhead,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Policy {
    /// Its name in commands, tables and files.
    pub name: String,
    pub estimator: EstimatorKind,
    pub planner: PlannerKind,
    pub objective: Objective,
    pub choice: Choice,
}

/// What says what each path is for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Choice {
    /// The policy's objective, always.
    Objective,
    /// A DQN on the autoencoder's hidden vector, among objectives (paper section III.E).
    Network,
    /// One option, always.
    Option(&'static PathOption),
    /// The rule by hand, among options.
    Rule,
    /// A DQN that scores options by their features.
    Scorer,
}

impl EstimatorKind {
    pub const KNOWN: Self = Self::Known { is_spatial: false };
    pub const LEARNED: Self = Self::learned(false);

    pub const fn learned(is_own: bool) -> Self {
        Self::Learned {
            is_own,
            is_spatial: false,
        }
    }

    pub fn spatial(self) -> Self {
        match self {
            Self::Known { .. } => Self::Known { is_spatial: true },
            Self::Learned { is_own, .. } => Self::Learned {
                is_own,
                is_spatial: true,
            },
            other => other,
        }
    }

    /// Those whose beliefs options are planned on.
    pub fn all_of_options() -> impl Iterator<Item = Self> + Clone {
        let filters = [Self::KNOWN, Self::LEARNED, Self::learned(true)].into_iter();
        let filters = filters.flat_map(|filter| [filter, filter.spatial()]);
        filters.chain([Self::Neural, Self::Truth])
    }

    /// Whether its corrections reach the neighbours of visited cells.
    pub fn is_spatial(self) -> bool {
        matches!(self, Self::Known { is_spatial } | Self::Learned { is_spatial, .. } if is_spatial)
    }

    /// Whether its kernels see the cell's own state.
    pub fn sees_own_state(self) -> bool {
        matches!(self, Self::Learned { is_own: true, .. })
    }

    pub fn knows_model(self) -> bool {
        matches!(self, Self::Known { .. })
    }

    /// Whether its parameters, and so the meaning of its states, were learned.
    pub fn is_learned(self) -> bool {
        matches!(
            self,
            Self::Learned { .. } | Self::Neural | Self::Autoencoder
        )
    }

    /// Whether frames change its belief.
    pub fn sees_frames(self) -> bool {
        !matches!(self, Self::None | Self::Truth | Self::NextTruth)
    }

    /// How names of policies on its belief begin.
    pub fn family(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Known { is_spatial: false } => "known",
            Self::Known { is_spatial: true } => "spatial",
            Self::Learned { is_own, is_spatial } => match (is_own, is_spatial) {
                (false, false) => "learned",
                (false, true) => "learned_spatial",
                (true, false) => "learned_own",
                (true, true) => "learned_own_spatial",
            },
            Self::Neural => "neural",
            Self::Autoencoder => "autoencoder",
            Self::Truth => "oracle",
            Self::NextTruth => "clairvoyant",
        }
    }

    pub fn label(self) -> String {
        match self {
            Self::KNOWN => "known_model".into(),
            Self::Known { .. } | Self::Learned { .. } => format!("{}_filter", self.family()),
            Self::Neural => "neural_belief".into(),
            Self::Truth => "truth".into(),
            Self::NextTruth => "next_truth".into(),
            Self::None | Self::Autoencoder => self.family().into(),
        }
    }
}

impl From<EstimatorKind> for String {
    fn from(kind: EstimatorKind) -> Self {
        kind.label()
    }
}

impl FromStr for EstimatorKind {
    type Err = String;

    /// One on whose belief decisions can be learned, from frames alone.
    fn from_str(name: &str) -> Result<Self, String> {
        let kinds = Self::all_of_options().filter(|kind| kind.sees_frames());
        let found = kinds.clone().find(|kind| kind.label() == name);
        found.ok_or_else(|| {
            let names: Vec<String> = kinds.map(Self::label).collect();
            format!("expected one of {}, got {name:?}", names.join(", "))
        })
    }
}

impl TryFrom<String> for EstimatorKind {
    type Error = String;

    fn try_from(name: String) -> Result<Self, String> {
        name.parse()
    }
}

impl PlannerKind {
    pub fn label(self) -> &'static str {
        match self {
            Self::RandomWalk => "random_walk",
            Self::Shooting => "shooting",
            Self::Beam => "beam",
            Self::BeamAhead => "beam_ahead",
        }
    }
}

impl Policy {
    /// A policy with its planner's objective. Where states are learned, the agent puts the one that pays most in the
    /// place of the target's.
    pub fn new(name: &str, estimator: EstimatorKind, planner: PlannerKind, target: Target) -> Self {
        let objective = match planner {
            // The authors' for shooting; for beam search hardly any bonus.
            PlannerKind::Shooting if target != Target::Coverage => Objective::paper(target),
            PlannerKind::Beam | PlannerKind::BeamAhead => Objective {
                coverage_bonus: BEAM_BONUS,
                ..Objective::new(target)
            },
            PlannerKind::Shooting | PlannerKind::RandomWalk => Objective::new(target),
        };
        Self {
            name: name.into(),
            estimator,
            planner,
            objective,
            choice: Choice::Objective,
        }
    }

    /// Whether it flies one option, or goes by the rule, on a belief.
    pub fn is_option(&self) -> bool {
        let is_rule = self.choice == Choice::Rule && self.estimator != EstimatorKind::Truth;
        is_rule || matches!(self.choice, Choice::Option(_))
    }

    /// Whether a DQN decides.
    pub fn is_decided(&self) -> bool {
        matches!(self.choice, Choice::Network | Choice::Scorer)
    }

    /// Whether it acts on what `train` learned.
    pub fn needs_checkpoint(&self) -> bool {
        self.is_decided() || self.estimator.is_learned()
    }
}

/// Names of states that were learned.
pub fn numbered_states(n_states: usize) -> Vec<String> {
    (0..n_states)
        .map(|state| format!("state {state}"))
        .collect()
}
