//! What a policy is, and policies by name.

use anyhow::{Context, Result, bail};
use emberwatch_belief::planning::objective::{BEAM_BONUS, Objective, Target};
use emberwatch_belief::planning::options::{OPTIONS, PathOption};
use protocol::Model;
use serde::{Deserialize, Serialize};
use std::str::FromStr;

/// In settings and checkpoints by [`EstimatorKind::label`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(into = "&'static str", try_from = "String")]
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
    /// Those whose beliefs options are planned on, with what names of policies begin with.
    pub const FAMILIES: [(&'static str, Self); 7] = [
        ("known", Self::KnownModel),
        ("spatial", Self::Spatial),
        ("learned", Self::Learned),
        ("learned_spatial", Self::LearnedSpatial),
        ("learned_own", Self::LearnedOwn),
        ("learned_own_spatial", Self::LearnedOwnSpatial),
        ("oracle", Self::Truth),
    ];

    /// Whether its kernels see the cell's own state.
    pub fn sees_own_state(self) -> bool {
        matches!(self, Self::LearnedOwn | Self::LearnedOwnSpatial)
    }

    /// Whether its corrections reach the neighbours of visited cells.
    pub fn is_spatial(self) -> bool {
        matches!(
            self,
            Self::Spatial | Self::LearnedSpatial | Self::LearnedOwnSpatial
        )
    }

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

    /// Whether frames change its belief.
    pub fn sees_frames(self) -> bool {
        !matches!(self, Self::None | Self::Truth | Self::NextTruth)
    }

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

impl From<EstimatorKind> for &'static str {
    fn from(kind: EstimatorKind) -> Self {
        kind.label()
    }
}

impl FromStr for EstimatorKind {
    type Err = String;

    /// One on whose belief decisions can be learned, from frames alone.
    fn from_str(name: &str) -> Result<Self, String> {
        let kinds = Self::FAMILIES.map(|(_, kind)| kind).into_iter();
        let mut kinds = kinds.filter(|kind| *kind != Self::Truth);
        kinds
            .clone()
            .find(|kind| kind.label() == name)
            .ok_or_else(|| {
                let names: Vec<&str> = kinds.by_ref().map(Self::label).collect();
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

    /// The policy of a name under a model.
    pub fn named(name: &str, model: &Model) -> Result<Self> {
        let all = Self::all(model);
        let found = all.iter().find(|policy| policy.name == name).cloned();
        found.with_context(|| {
            let names = all.iter().filter(|policy| !policy.is_option());
            let names = names.map(|policy| &*policy.name);
            unknown(name, &names.chain(["BELIEF_OPTION"]).collect::<Vec<_>>())
        })
    }

    /// Checks a name before the model is known.
    ///
    /// # Errors
    /// If it is a policy's under no model.
    pub fn check_name(name: &str) -> Result<()> {
        let of_model = ["shooting_", "beam_"];
        let mut rests = of_model
            .iter()
            .filter_map(|family| name.strip_prefix(family));
        let model = Model::wildfire();
        let all = Self::all(&model);
        if rests.any(|rest| !rest.is_empty()) || all.iter().any(|policy| policy.name == name) {
            return Ok(());
        }
        let is_general = |policy: &&Self| {
            let rest = policy.name.split_once('_').unwrap_or_default().1;
            !policy.is_option() && model.state_named(rest).is_none()
        };
        let names = all.iter().filter(is_general);
        let names = names.map(|policy| &*policy.name);
        let patterns = ["shooting_STATE", "beam_STATE", "BELIEF_OPTION"];
        let names: Vec<&str> = names.chain(patterns).collect();
        bail!(unknown(name, &names))
    }

    /// All policies of a model: the ladder, then the others.
    pub fn all(model: &Model) -> Vec<Self> {
        use EstimatorKind::*;
        use PlannerKind::{Beam, BeamAhead, Shooting};
        let (target, states) = (Target::State(model.target_state()), model.state_names());
        let mut all = Self::ladder(model);
        all.extend([
            Self::new("beam_explore", KnownModel, Beam, Target::Entropy),
            Self::exploit_only("beam_exploit_only", Beam, target),
            Self::new("clairvoyant_shooting", NextTruth, Shooting, target),
            Self::new("clairvoyant_ahead", NextTruth, BeamAhead, target),
        ]);
        for (family, estimator) in [
            ("learned", Learned),
            ("learned_spatial", LearnedSpatial),
            ("learned_own", LearnedOwn),
            ("learned_own_spatial", LearnedOwnSpatial),
        ] {
            for planner in [Shooting, Beam] {
                let name = format!("{family}_{}", planner.label());
                all.push(Self::new(&name, estimator, planner, target));
            }
        }
        let families = EstimatorKind::FAMILIES.into_iter();
        all.extend(families.flat_map(|(family, estimator)| {
            let mut policies = Self::of_options(family, estimator, target);
            // That one is in the ladder.
            policies.retain(|policy| estimator != Truth || policy.is_option());
            policies
        }));
        all.extend([
            Self::new(
                "autoencoder_explore",
                Autoencoder,
                Shooting,
                Target::Entropy,
            ),
            Self::new("autoencoder_exploit", Autoencoder, Shooting, target),
            Self {
                choice: Choice::Network,
                ..Self::new("autoencoder_policy", Autoencoder, Shooting, target)
            },
            Self::new("autoencoder_beam", Autoencoder, Beam, target),
        ]);
        let of_state = |planner: PlannerKind, state: usize| {
            let name = format!("{}_{}", planner.label(), states[state]);
            Self::new(&name, KnownModel, planner, Target::State(state))
        };
        all.push(of_state(Shooting, model.target_state()));
        all.extend((0..states.len()).map(|state| of_state(Beam, state)));
        all
    }

    /// The benchmark's ladder under a model, from the least to the most informed.
    pub fn ladder(model: &Model) -> Vec<Self> {
        use EstimatorKind::{KnownModel, NextTruth, None, Spatial, Truth};
        use PlannerKind::{Beam, BeamAhead, RandomWalk, Shooting};
        let target = Target::State(model.target_state());
        let states = model.state_names().into_iter().enumerate();
        let others = states.filter(|(state, _)| *state != model.target_state());
        let others = others.map(|(state, name)| {
            let target = Target::State(state);
            Self::new(&format!("shooting_{name}"), KnownModel, Shooting, target)
        });
        let first = [
            Self::new("random_walk", None, RandomWalk, Target::Coverage),
            Self::new("coverage", None, Shooting, Target::Coverage),
            Self::new("shooting_explore", KnownModel, Shooting, Target::Entropy),
        ];
        let rest = [
            Self::new("shooting_exploit", KnownModel, Shooting, target),
            Self::exploit_only("shooting_exploit_only", Shooting, target),
            Self::new("beam_exploit", KnownModel, Beam, target),
            Self::new("spatial_shooting", Spatial, Shooting, target),
            Self::new("spatial_beam", Spatial, Beam, target),
            Self::new("oracle_shooting", Truth, Shooting, target),
            Self::new("oracle_beam", Truth, Beam, target),
            Self::new("oracle_ahead", Truth, BeamAhead, target),
            Self {
                choice: Choice::Rule,
                ..Self::new("oracle_policy", Truth, Beam, target)
            },
            Self::new("clairvoyant_beam", NextTruth, Beam, target),
        ];
        first.into_iter().chain(others).chain(rest).collect()
    }

    /// The known model's, without a bonus for each distinct cell.
    fn exploit_only(name: &str, planner: PlannerKind, target: Target) -> Self {
        Self {
            objective: Objective::new(target),
            ..Self::new(name, EstimatorKind::KnownModel, planner, target)
        }
    }

    /// Each option on a belief, the rule, and what was learned; of those who are told the states, the rule is the
    /// policy.
    fn of_options(family: &str, estimator: EstimatorKind, target: Target) -> Vec<Self> {
        let policy = |name: &str, choice| Self {
            choice,
            ..Self::new(
                &format!("{family}_{name}"),
                estimator,
                PlannerKind::Beam,
                target,
            )
        };
        let fixed = OPTIONS
            .iter()
            .map(|option| policy(option.name, Choice::Option(option)));
        let chosen = match estimator {
            EstimatorKind::Truth => vec![],
            _ => vec![
                policy("rule", Choice::Rule),
                policy("policy", Choice::Scorer),
            ],
        };
        fixed.chain(chosen).collect()
    }

    /// What is read off one table: random moves, then each option on a belief, the rule, and the learned choice.
    pub fn table_of_options(model: &Model, estimator: EstimatorKind) -> Vec<Self> {
        let all = Self::all(model).into_iter();
        let is_on = |policy: &Self| match policy.choice {
            Choice::Option(_) | Choice::Rule | Choice::Scorer => policy.estimator == estimator,
            _ => policy.planner == PlannerKind::RandomWalk,
        };
        all.filter(is_on).collect()
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

    /// What a high-level decision chooses among (the paper's actions `a_k`): the probability of each
    /// state, then `entropy`; each named by its target, with the bonus of `shooting_*` and `beam_*`.
    pub fn choices(estimator: EstimatorKind, planner: PlannerKind, states: &[String]) -> Vec<Self> {
        let choice = |name: &str, target| Self::new(name, estimator, planner, target);
        let states = states.iter().enumerate();
        let states = states.map(|(state, name)| choice(name, Target::State(state)));
        states.chain([choice("entropy", Target::Entropy)]).collect()
    }

    /// What the DQN of Algorithm 1 chooses among (paper section IV).
    pub fn network_choices(n_states: usize) -> Vec<Self> {
        let states = numbered_states(n_states);
        Self::choices(EstimatorKind::Autoencoder, PlannerKind::Shooting, &states)
    }
}

/// Names of states that were learned.
pub fn numbered_states(n_states: usize) -> Vec<String> {
    (0..n_states)
        .map(|state| format!("state {state}"))
        .collect()
}

fn unknown(name: &str, expected: &[&str]) -> String {
    format!(
        "policy: expected one of {}, got {name:?}",
        expected.join(", ")
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_listed_name_is_a_policy_and_no_other() {
        let model = Model::wildfire();
        for policy in Policy::all(&model) {
            let named = Policy::named(&policy.name, &model).expect("known");
            assert_eq!(named, policy, "each name once");
        }
        for wrong in [
            "",
            "beam",
            "beam_",
            "oracle_rule",
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
    fn the_wildfires_policies_are_these() {
        let expected = [
            ("none", "random_walk coverage"),
            (
                "known_model",
                "shooting_explore shooting_normal shooting_latent shooting_exploit \
                 shooting_exploit_only beam_exploit",
            ),
            ("spatial_filter", "spatial_shooting spatial_beam"),
            (
                "truth",
                "oracle_shooting oracle_beam oracle_ahead oracle_policy",
            ),
            ("next_truth", "clairvoyant_beam"),
            ("known_model", "beam_explore beam_exploit_only"),
            ("next_truth", "clairvoyant_shooting clairvoyant_ahead"),
            ("learned_filter", "learned_shooting learned_beam"),
            (
                "learned_spatial_filter",
                "learned_spatial_shooting learned_spatial_beam",
            ),
            (
                "learned_own_filter",
                "learned_own_shooting learned_own_beam",
            ),
            (
                "learned_own_spatial_filter",
                "learned_own_spatial_shooting learned_own_spatial_beam",
            ),
            ("known_model", "known_policy"),
            ("spatial_filter", "spatial_policy"),
            ("learned_filter", "learned_policy"),
            ("learned_spatial_filter", "learned_spatial_policy"),
            ("learned_own_filter", "learned_own_policy"),
            ("learned_own_spatial_filter", "learned_own_spatial_policy"),
            (
                "autoencoder",
                "autoencoder_explore autoencoder_exploit autoencoder_policy autoencoder_beam",
            ),
            (
                "known_model",
                "shooting_fire beam_normal beam_latent beam_fire",
            ),
        ];
        let expected = expected.iter().flat_map(|(estimator, names)| {
            let names = names.split_whitespace();
            names.map(move |name| (name.to_owned(), *estimator))
        });
        let policies = Policy::all(&Model::wildfire()).into_iter();
        let named = policies.filter(|policy| !policy.is_option());
        let named = named.map(|policy| (policy.name, policy.estimator.label()));
        assert_eq!(named.collect::<Vec<_>>(), expected.collect::<Vec<_>>());
    }

    #[test]
    fn a_name_is_checked_before_its_model_is_known() {
        for model in Model::built_in_names().filter_map(Model::built_in) {
            for policy in Policy::all(&model) {
                Policy::check_name(&policy.name).expect("known");
            }
        }
        for wrong in [
            "",
            "bem_exploit",
            "beam_",
            "learned_",
            "oracle_rule",
            "fire",
        ] {
            let error = Policy::check_name(wrong).expect_err(wrong).to_string();
            assert!(
                error.contains("coverage, shooting_explore, shooting_exploit, ")
                    && error.contains("shooting_STATE, beam_STATE, BELIEF_OPTION, got"),
                "{error}"
            );
        }
    }

    #[test]
    fn options_have_a_policy_each_on_every_belief() {
        let model = Model::wildfire();
        for (family, estimator) in EstimatorKind::FAMILIES {
            let table = Policy::table_of_options(&model, estimator);
            let names: Vec<&str> = table.iter().map(|policy| &*policy.name).collect();
            let exploit = format!("{family}_exploit");
            let policy = format!("{family}_policy");
            let expected = ["random_walk", &exploit, &policy];
            assert!(
                expected.iter().all(|name| names.contains(name)),
                "{names:?}"
            );
            let n_chosen = if estimator == EstimatorKind::Truth {
                1
            } else {
                2
            };
            assert_eq!(names.len(), 1 + OPTIONS.len() + n_chosen);
            let is_told = estimator == EstimatorKind::Truth;
            assert_eq!(
                estimator.label().parse().ok(),
                (!is_told).then_some(estimator)
            );
        }
        let error = "filter".parse::<EstimatorKind>().expect_err("no name");
        assert!(
            error.ends_with("learned_own_spatial_filter, got \"filter\""),
            "{error}"
        );
    }

    #[test]
    fn choices_are_the_policies_of_their_planner() {
        let model = Model::wildfire();
        for (family, planner) in [
            ("beam", PlannerKind::Beam),
            ("shooting", PlannerKind::Shooting),
        ] {
            let choices = Policy::choices(EstimatorKind::KnownModel, planner, &model.state_names());
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
