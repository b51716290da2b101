//! Policies by name: the ladder of the benchmark, and all others.

use super::kinds::{Choice, EstimatorKind, PlannerKind, Policy, numbered_states};
use anyhow::{Context, Result, bail};
use emberwatch_belief::planning::objective::{Objective, Target};
use emberwatch_belief::planning::options::OPTIONS;
use emberwatch_model::Model;

impl Policy {
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
        use EstimatorKind::NextTruth;
        const KNOWN: EstimatorKind = EstimatorKind::KNOWN;
        use PlannerKind::{Beam, BeamAhead, Shooting};
        let target = Target::State(model.target_state());
        let mut all = Self::ladder(model);
        all.extend([
            Self::new("beam_explore", KNOWN, Beam, Target::Entropy),
            Self::exploit_only("beam_exploit_only", Beam, target),
            Self::new("clairvoyant_shooting", NextTruth, Shooting, target),
            Self::new("clairvoyant_ahead", NextTruth, BeamAhead, target),
        ]);
        for estimator in EstimatorKind::all_of_options().filter(|estimator| estimator.is_learned())
        {
            all.extend([Shooting, Beam].map(|planner| {
                let name = format!("{}_{}", estimator.family(), planner.label());
                Self::new(&name, estimator, planner, target)
            }));
        }
        let of_options = |estimator| Self::of_options(estimator, target);
        all.extend(EstimatorKind::all_of_options().flat_map(of_options));
        all.extend(Self::of_autoencoder(target));
        all.extend(Self::of_states(model));
        all
    }

    fn of_autoencoder(target: Target) -> [Self; 4] {
        use PlannerKind::{Beam, Shooting};
        let policy =
            |name, planner, target| Self::new(name, EstimatorKind::Autoencoder, planner, target);
        [
            policy("autoencoder_explore", Shooting, Target::Entropy),
            policy("autoencoder_exploit", Shooting, target),
            Self {
                choice: Choice::Network,
                ..policy("autoencoder_policy", Shooting, target)
            },
            policy("autoencoder_beam", Beam, target),
        ]
    }

    /// Of each state one on the known model, beside those of the ladder.
    fn of_states(model: &Model) -> impl Iterator<Item = Self> {
        let of_state = |planner: PlannerKind, state: usize, name: &str| {
            let name = format!("{}_{name}", planner.label());
            Self::new(&name, EstimatorKind::KNOWN, planner, Target::State(state))
        };
        let (target, states) = (model.target_state(), model.state_names());
        let shooting = of_state(PlannerKind::Shooting, target, &states[target]);
        let beam = states.into_iter().enumerate();
        let beam = beam.map(move |(state, name)| of_state(PlannerKind::Beam, state, &name));
        std::iter::once(shooting).chain(beam)
    }

    /// The benchmark's ladder under a model, from the least to the most informed.
    pub fn ladder(model: &Model) -> Vec<Self> {
        use EstimatorKind::{NextTruth, None, Truth};
        const KNOWN: EstimatorKind = EstimatorKind::KNOWN;
        const SPATIAL: EstimatorKind = EstimatorKind::Known { is_spatial: true };
        use PlannerKind::{Beam, BeamAhead, RandomWalk, Shooting};
        let target = Target::State(model.target_state());
        let states = model.state_names().into_iter().enumerate();
        let others = states.filter(|(state, _)| *state != model.target_state());
        let others = others.map(|(state, name)| {
            let target = Target::State(state);
            Self::new(&format!("shooting_{name}"), KNOWN, Shooting, target)
        });
        let first = [
            Self::new("random_walk", None, RandomWalk, Target::Coverage),
            Self::new("coverage", None, Shooting, Target::Coverage),
            Self::new("shooting_explore", KNOWN, Shooting, Target::Entropy),
        ];
        let rest = [
            Self::new("shooting_exploit", KNOWN, Shooting, target),
            Self::exploit_only("shooting_exploit_only", Shooting, target),
            Self::new("beam_exploit", KNOWN, Beam, target),
            Self::new("spatial_shooting", SPATIAL, Shooting, target),
            Self::new("spatial_beam", SPATIAL, Beam, target),
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
            ..Self::new(name, EstimatorKind::KNOWN, planner, target)
        }
    }

    /// Each option on a belief, the rule, and what was learned; of those who are told the states, the rule is the
    /// policy.
    fn of_options(estimator: EstimatorKind, target: Target) -> Vec<Self> {
        let policy = |name: &str, choice| Self {
            choice,
            ..Self::new(
                &format!("{}_{name}", estimator.family()),
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
            ("neural_belief", "neural_shooting neural_beam"),
            ("known_model", "known_policy"),
            ("spatial_filter", "spatial_policy"),
            ("learned_filter", "learned_policy"),
            ("learned_spatial_filter", "learned_spatial_policy"),
            ("learned_own_filter", "learned_own_policy"),
            ("learned_own_spatial_filter", "learned_own_spatial_policy"),
            ("neural_belief", "neural_policy"),
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
            names.map(move |name| (name.to_owned(), (*estimator).to_owned()))
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
        for estimator in EstimatorKind::all_of_options() {
            let family = estimator.family();
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
        assert!(error.ends_with("neural_belief, got \"filter\""), "{error}");
    }

    #[test]
    fn choices_are_the_policies_of_their_planner() {
        let model = Model::wildfire();
        for (family, planner) in [
            ("beam", PlannerKind::Beam),
            ("shooting", PlannerKind::Shooting),
        ] {
            let choices = Policy::choices(EstimatorKind::KNOWN, planner, &model.state_names());
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
