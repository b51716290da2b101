//! What a policy is, and policies by name.

use super::names::{is_of_model, known_names, ladder_names, names_of_any_model};
use crate::planning::action::{Action, ActionSet};
use crate::planning::objective::{BEAM_BONUS, Objective, Target};
use protocol::Model;
use thiserror::Error;

/// Where a policy's belief comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum EstimatorKind {
    None,
    /// The Bayes filter with the true parameters (paper section III.A, masked as in III.C).
    KnownModel,
    /// The same, whose corrections reach the neighbours of visited cells.
    Spatial,
    /// A Bayes filter with learned parameters.
    Learned,
    /// The same, whose corrections reach the neighbours of visited cells.
    LearnedSpatial,
    /// [`Self::Learned`] with a kernel for each state that a cell itself can be in.
    LearnedOwn,
    /// [`Self::LearnedSpatial`] with a kernel for each state that a cell itself can be in.
    LearnedOwnSpatial,
    /// The paper's dynamic autoencoder (sections III.B and III.C).
    Autoencoder,
    /// The hidden state X_k, predicted one step ahead: an upper bound on estimation.
    Truth,
    /// The hidden state X_{k+1} that the path will meet: an upper bound on prediction too.
    NextTruth,
}

/// How a policy plans.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum PlannerKind {
    /// Uniform moves: the paper's baseline.
    RandomWalk,
    /// The best of many random paths (paper section III.D).
    Shooting,
    Beam,
}

/// A way to act.
#[derive(Debug, Clone, PartialEq)]
pub struct Policy {
    /// Its name in commands, tables and files.
    pub name: String,
    pub estimator: EstimatorKind,
    pub planner: PlannerKind,
    pub objective: Objective,
    /// Whether a DQN chooses what each path is for instead (paper section III.E).
    pub is_decided: bool,
    /// What each path is for instead, always the same.
    pub action: Option<Action>,
}

/// A name that is no policy's.
#[derive(Debug, Error, PartialEq, Eq)]
#[error("policy: expected one of {expected}, got {name:?}")]
pub struct UnknownPolicy {
    name: String,
    expected: String,
}

impl EstimatorKind {
    /// Whether it filters with the true parameters.
    pub fn knows_model(self) -> bool {
        matches!(self, Self::KnownModel | Self::Spatial)
    }

    /// Whether its parameters, and so the meaning of its states, were learned.
    pub fn is_learned(self) -> bool {
        matches!(
            self,
            Self::Learned
                | Self::LearnedSpatial
                | Self::LearnedOwn
                | Self::LearnedOwnSpatial
                | Self::Autoencoder
        )
    }

    /// Its name in tables and files.
    pub fn label(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::KnownModel => "known_model",
            Self::Spatial => "spatial_filter",
            Self::Learned => "learned_filter",
            Self::LearnedSpatial => "learned_spatial_filter",
            Self::LearnedOwn => "learned_own_filter",
            Self::LearnedOwnSpatial => "learned_own_spatial_filter",
            Self::Autoencoder => "autoencoder",
            Self::Truth => "truth",
            Self::NextTruth => "next_truth",
        }
    }
}

impl PlannerKind {
    /// Its name in commands and messages.
    pub fn label(self) -> &'static str {
        match self {
            Self::RandomWalk => "random_walk",
            Self::Shooting => "shooting",
            Self::Beam => "beam",
        }
    }
}

impl Policy {
    fn new(
        name: &str,
        estimator: EstimatorKind,
        planner: PlannerKind,
        objective: Objective,
    ) -> Self {
        Self {
            name: name.into(),
            estimator,
            planner,
            objective,
            is_decided: false,
            action: None,
        }
    }

    /// The policy of a name under a model.
    ///
    /// Names are `random_walk`, `coverage`, `shooting_*` and `beam_*` with `exploit` (the state that
    /// pays most), `exploit_only` (the same without the coverage bonus), `explore` (entropy) or the
    /// name of a state, and `spatial_*`, `oracle_*`, `clairvoyant_*`, `learned_*`,
    /// `learned_spatial_*`, `learned_own_*` and `learned_own_spatial_*` with `shooting` or `beam`. On
    /// the autoencoder's belief there are `autoencoder_exploit` and `autoencoder_explore`, which
    /// shoot, `autoencoder_policy`, for which the DQN chooses among the paper's objectives, and
    /// `autoencoder_beam`. `dqn_beam` chooses among [`ActionSet::beam`] by a DQN; `act_*` always takes
    /// the action of that name.
    pub fn named(name: &str, model: &Model) -> Result<Self, UnknownPolicy> {
        let unknown = || UnknownPolicy {
            name: name.into(),
            expected: known_names(model).join(", "),
        };
        let target = Target::State(model.target_state());
        let policy = |estimator, planner, objective| Self::new(name, estimator, planner, objective);
        Ok(match name {
            "random_walk" => policy(
                EstimatorKind::None,
                PlannerKind::RandomWalk,
                Objective::new(Target::Coverage),
            ),
            "coverage" => policy(
                EstimatorKind::None,
                PlannerKind::Shooting,
                Objective::new(Target::Coverage),
            ),
            _ => {
                let (family, rest) = name.split_once('_').ok_or_else(unknown)?;
                match family {
                    "dqn" if rest == "beam" => Self {
                        is_decided: true,
                        ..policy(
                            EstimatorKind::KnownModel,
                            PlannerKind::Beam,
                            objective(PlannerKind::Beam, target),
                        )
                    },
                    "act" => Self::always(name, rest, model).ok_or_else(unknown)?,
                    "autoencoder" => Self::of_autoencoder(rest).ok_or_else(unknown)?,
                    "spatial" | "oracle" | "clairvoyant" | "learned" => {
                        let (estimator, planner) = match family {
                            "learned" => learned_filter(rest),
                            "spatial" => (EstimatorKind::Spatial, rest),
                            "oracle" => (EstimatorKind::Truth, rest),
                            _ => (EstimatorKind::NextTruth, rest),
                        };
                        let planner = planner_named(planner).ok_or_else(unknown)?;
                        policy(estimator, planner, objective(planner, target))
                    }
                    _ => {
                        let planner = planner_named(family).ok_or_else(unknown)?;
                        let objective = match rest {
                            "exploit" => objective(planner, target),
                            "exploit_only" => Objective::new(target),
                            "explore" => objective(planner, Target::Entropy),
                            state => objective(
                                planner,
                                Target::State(model.state_named(state).ok_or_else(unknown)?),
                            ),
                        };
                        policy(EstimatorKind::KnownModel, planner, objective)
                    }
                }
            }
        })
    }

    /// Checks a name before the model is known.
    ///
    /// # Errors
    /// If it is a policy's under no model.
    pub fn check_name(name: &str) -> Result<(), UnknownPolicy> {
        if is_of_model(name) || Self::named(name, &Model::wildfire()).is_ok() {
            return Ok(());
        }
        Err(UnknownPolicy {
            name: name.into(),
            expected: names_of_any_model().join(", "),
        })
    }

    /// What a high-level decision chooses among (the paper's actions `a_k`): the probability of each
    /// state in the model's order, then `entropy`; each named by its target, with the bonus of
    /// `shooting_*` and `beam_*`.
    pub fn choices(estimator: EstimatorKind, planner: PlannerKind, model: &Model) -> Vec<Self> {
        let choice = |name: &str, target| {
            let objective = objective(planner, target);
            Self::new(name, estimator, planner, objective)
        };
        let states = model.file().states.iter().enumerate();
        let states = states.map(|(state, entry)| choice(&entry.name, Target::State(state)));
        states.chain([choice("entropy", Target::Entropy)]).collect()
    }

    /// A planner on the belief of a learned filter; what it maximises is learned too.
    pub fn learned(estimator: EstimatorKind, planner: PlannerKind) -> Self {
        // The agent puts the state that pays most, as learned, in the place of this one.
        let target = match planner {
            PlannerKind::RandomWalk => Target::Coverage,
            PlannerKind::Shooting | PlannerKind::Beam => Target::State(0),
        };
        let filter = estimator.label().trim_end_matches("_filter");
        let name = format!("{filter}_{}", planner.label());
        Self::new(&name, estimator, planner, objective(planner, target))
    }

    /// Beam search on the known model's belief that always takes one action.
    fn always(name: &str, action: &str, model: &Model) -> Option<Self> {
        let actions = ActionSet::beam(model);
        let action = actions.named(action)?;
        let (estimator, planner) = (EstimatorKind::KnownModel, PlannerKind::Beam);
        Some(Self {
            action: Some(action.clone()),
            ..Self::new(name, estimator, planner, action.objective)
        })
    }

    /// A policy on the autoencoder's belief; the agent puts the state that pays most, as learned, in the
    /// place of this one.
    fn of_autoencoder(name: &str) -> Option<Self> {
        let (planner, target) = match name {
            "exploit" | "policy" => (PlannerKind::Shooting, Target::State(0)),
            "explore" => (PlannerKind::Shooting, Target::Entropy),
            "beam" => (PlannerKind::Beam, Target::State(0)),
            _ => return None,
        };
        let (full, objective) = (format!("autoencoder_{name}"), objective(planner, target));
        Some(Self {
            is_decided: name == "policy",
            ..Self::new(&full, EstimatorKind::Autoencoder, planner, objective)
        })
    }

    /// What the DQN of Algorithm 1 chooses among (paper section IV): the probability of each of the
    /// autoencoder's states, then entropy.
    pub fn network_choices(n_states: usize) -> Vec<Self> {
        let choice = |name: &str, target| {
            let (estimator, planner) = (EstimatorKind::Autoencoder, PlannerKind::Shooting);
            Self::new(name, estimator, planner, objective(planner, target))
        };
        let states = 0..n_states;
        let states = states.map(|state| choice(&format!("state_{state}"), Target::State(state)));
        let entropy = choice("entropy", Target::Entropy);
        states.chain([entropy]).collect()
    }

    /// The benchmark's ladder under a model, from the least to the most informed.
    pub fn ladder(model: &Model) -> Vec<Self> {
        let named = |name: &String| {
            Self::named(name, model).expect("invariant: the ladder's names are known")
        };
        ladder_names(model).iter().map(named).collect()
    }
}

/// The authors' objective for shooting; for beam search hardly any bonus.
fn objective(planner: PlannerKind, target: Target) -> Objective {
    match planner {
        PlannerKind::Shooting => Objective::paper(target),
        PlannerKind::Beam | PlannerKind::RandomWalk => Objective {
            coverage_bonus: BEAM_BONUS,
            ..Objective::new(target)
        },
    }
}

/// The filter and the planner's name of a policy `learned_*`.
fn learned_filter(name: &str) -> (EstimatorKind, &str) {
    let kinds = [
        ("own_spatial_", EstimatorKind::LearnedOwnSpatial),
        ("own_", EstimatorKind::LearnedOwn),
        ("spatial_", EstimatorKind::LearnedSpatial),
        ("", EstimatorKind::Learned),
    ];
    let mut kinds = kinds.into_iter();
    let found = kinds.find_map(|(prefix, kind)| Some((kind, name.strip_prefix(prefix)?)));
    found.expect("invariant: every name begins with nothing")
}

fn planner_named(name: &str) -> Option<PlannerKind> {
    match name {
        "shooting" => Some(PlannerKind::Shooting),
        "beam" => Some(PlannerKind::Beam),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_listed_name_is_a_policy_and_no_other() {
        let model = Model::wildfire();
        for name in known_names(&model) {
            assert_eq!(
                Policy::named(&name, &model).map(|policy| policy.name),
                Ok(name)
            );
        }
        for wrong in [
            "",
            "beam",
            "beam_",
            "oracle_exploit",
            "shooting_ash",
            "Random_walk",
        ] {
            let error = Policy::named(wrong, &model).expect_err(wrong).to_string();
            assert!(
                error.contains("shooting_latent") && error.ends_with(&format!("got {wrong:?}")),
                "{error}"
            );
        }
    }

    #[test]
    fn a_name_is_checked_before_its_model_is_known() {
        for model in Model::built_in_names().filter_map(Model::built_in) {
            for name in known_names(&model) {
                assert_eq!(Policy::check_name(&name), Ok(()));
            }
        }
        for wrong in ["", "bem_exploit", "beam_", "act_", "oracle_exploit", "fire"] {
            let error = Policy::check_name(wrong).expect_err(wrong).to_string();
            assert!(
                error.contains("coverage, shooting_explore, shooting_exploit, ")
                    && error.contains("shooting_STATE, beam_STATE, act_ACTION, got"),
                "{error}"
            );
        }
    }

    #[test]
    fn choices_are_the_policies_of_their_planner() {
        let model = Model::wildfire();
        for (family, planner) in [
            ("beam", PlannerKind::Beam),
            ("shooting", PlannerKind::Shooting),
        ] {
            let choices = Policy::choices(EstimatorKind::KnownModel, planner, &model);
            let names = ["normal", "latent", "fire", "explore"];
            assert_eq!(choices.len(), names.len());
            for (choice, name) in choices.iter().zip(names) {
                let named = Policy::named(&format!("{family}_{name}"), &model).expect("known");
                assert_eq!(choice.objective, named.objective, "{name}");
                assert_eq!(choice.planner, named.planner);
                assert_eq!(choice.estimator, named.estimator);
            }
        }
    }

    #[test]
    fn the_ladder_goes_through_the_states_of_its_model() {
        let names: Vec<String> = Policy::ladder(&Model::wildfire())
            .into_iter()
            .map(|policy| policy.name)
            .collect();
        assert!(
            names.contains(&"shooting_normal".to_string())
                && names.contains(&"shooting_latent".to_string())
        );
        assert!(!names.contains(&"shooting_fire".to_string()));
    }
}
