//! Names of policies: the names of their parts, `BELIEF/PLANNER/GOAL`, and short names for some policies.

use super::goals::{Goal, GoalEntry};
use super::parts::Policy;
use super::planners::{BY_OPTIONS, PLANNERS, PlannerKind};
use crate::beliefs::{BELIEFS, BeliefKind, numbered_states};
use anyhow::{Result, bail};
use emberwatch_belief::planning::options;
use emberwatch_model::Model;
use emberwatch_model::built_in::listed;
use emberwatch_model::text::shortened;

/// Short names of policies, each with its parts. A short name never changes its meaning.
pub(super) const NAMED: &[(&str, &str)] = &[
    ("random_walk", "none/random"),
    ("coverage", "none/shooting/coverage"),
    ("shooting", "known/shooting/exploit"),
    ("beam", "known+spatial+cavities/beam/exploit"),
    ("learned_beam", "learned/beam/exploit"),
    ("learned_policy", "learned/options/learned"),
    ("neural_beam", "neural/beam/exploit"),
    ("neural_policy", "neural/options/learned"),
    ("oracle_beam", "truth/beam/exploit"),
    ("oracle_ahead", "truth/ahead/exploit"),
    ("oracle_policy", "truth/options/rule"),
];

fn name(belief: &BeliefKind, planner: &'static PlannerKind, goal: Goal, model: &Model) -> String {
    let mut parts = format!("{}/{}", belief.name, planner.name);
    if !planner.goals.is_empty() {
        parts = format!("{parts}/{}", goal_name(planner, goal, model));
    }
    let short = NAMED.iter().find(|(_, named)| *named == parts);
    short.map_or(parts, |(name, _)| (*name).into())
}

fn goal_name(planner: &PlannerKind, goal: Goal, model: &Model) -> String {
    match goal {
        Goal::Option(option) => option.name.into(),
        Goal::State(state) => {
            let names = model.state_names().into_iter();
            let mut names = names.chain(
                numbered_states(state + 1)
                    .into_iter()
                    .skip(model.n_states()),
            );
            names
                .nth(state)
                .expect("invariant: numbered names follow the names of the model's states")
        }
        _ => {
            let found = planner.goals.iter().find(|(other, ..)| *other == goal);
            let (_, name, _) = found.expect("invariant: each goal has a name");
            (*name).into()
        }
    }
}

impl Policy {
    /// Creates a policy from its parts. Its name is its short name if it has one, otherwise the names of its parts.
    pub fn new(
        belief: &'static BeliefKind,
        planner: &'static PlannerKind,
        goal: Goal,
        model: &Model,
    ) -> Self {
        Self {
            name: name(belief, planner, goal, model),
            belief,
            planner,
            goal,
        }
    }

    /// Parses a policy from its short name or the names of its parts.
    ///
    /// # Errors
    /// If a part is unknown. The error lists the valid names.
    pub fn named(name: &str, model: &Model) -> Result<Self> {
        let states = model.state_names().join(", ");
        let parts = parse(name, &|state| model.state_named(state), &states);
        parts.map(|(belief, planner, goal)| Self::new(belief, planner, goal, model))
    }
}

/// Checks a policy's name without a model. Any word is accepted as the name of a state.
///
/// # Errors
/// If the name is invalid under every model. The error lists the valid names.
pub fn check_name(name: &str) -> Result<()> {
    // Any word can be the name of a state.
    let is_word = |state: &str| (!state.is_empty()).then_some(0);
    parse(name, &is_word, "a state of the model").map(drop)
}

/// Returns the planner of the policy with this name. `None` if the name is unknown, as for an external agent's policy.
pub fn planner_of(name: &str) -> Option<&'static PlannerKind> {
    parse(name, &|_| Some(0), "").ok().map(|parts| parts.1)
}

type Parts = (&'static BeliefKind, &'static PlannerKind, Goal);

fn parse(name: &str, state: &dyn Fn(&str) -> Option<usize>, states: &str) -> Result<Parts> {
    let short = NAMED.iter().find(|(short, _)| *short == name);
    let parts = short.map_or(name, |(_, parts)| parts);
    let one_of = |names: &str| format!("one of {names}");
    let wrong = |what: &str, expected: &str, got: &str| {
        let (name, got) = (shortened(name), shortened(got));
        anyhow::anyhow!("policy {name:?}: {what}: expected {expected}, got {got:?}")
    };
    let words: Vec<&str> = parts.split('/').collect();
    let (belief, planner, goal) = match words.as_slice() {
        [belief, planner] => (*belief, *planner, None),
        [belief, planner, goal] => (*belief, *planner, Some(*goal)),
        _ => bail!(unknown(name)),
    };
    let mut kinds = BELIEFS.iter().copied();
    let found = kinds.find(|kind| kind.name == belief);
    let names = one_of(&listed(BELIEFS.iter().map(|kind| kind.name)));
    let belief = found.ok_or_else(|| wrong("belief", &names, belief))?;
    let mut planners = PLANNERS.iter().copied();
    let found = planners.find(|kind| kind.name == planner);
    let names = one_of(&listed(PLANNERS.iter().map(|kind| kind.name)));
    let planner = found.ok_or_else(|| wrong("planner", &names, planner))?;
    let found = goal_of(belief, planner, goal, state);
    let mut goals = goals_of(belief, planner, states);
    if !planner.goals.is_empty() {
        goals = one_of(&goals);
    }
    let goal = found.ok_or_else(|| wrong("goal", &goals, goal.unwrap_or_default()))?;
    Ok((belief, planner, goal))
}

fn unknown(name: &str) -> String {
    let got = shortened(name);
    format!(
        "policy: expected one of {}, or BELIEF/PLANNER/GOAL such as learned+spatial/beam/exploit (see `compare \
         --help`), got {got:?}",
        listed(NAMED.iter().map(|(name, _)| *name))
    )
}

fn goals(
    belief: &BeliefKind,
    planner: &PlannerKind,
) -> impl Iterator<Item = &'static GoalEntry> + use<> {
    let is_learned = belief.decides() || *planner == BY_OPTIONS;
    let goals = planner.goals.iter();
    goals.filter(move |(goal, ..)| *goal != Goal::Learned || is_learned)
}

fn goal_of(
    belief: &BeliefKind,
    planner: &PlannerKind,
    name: Option<&str>,
    state: &dyn Fn(&str) -> Option<usize>,
) -> Option<Goal> {
    if planner.goals.is_empty() {
        return name.is_none().then_some(Goal::Coverage);
    }
    let mut own = goals(belief, planner);
    if let Some((goal, ..)) = own.find(|(_, known, _)| Some(*known) == name) {
        return Some(*goal);
    }
    if *planner == BY_OPTIONS {
        let mut options = options::OPTIONS.iter();
        let option = options.find(|option| Some(option.name) == name);
        return option.map(Goal::Option);
    }
    // Learned states have no names.
    let state = (belief.learned_by.is_none()).then(|| name.and_then(state));
    state.flatten().map(Goal::State)
}

fn goals_of(belief: &BeliefKind, planner: &PlannerKind, states: &str) -> String {
    if planner.goals.is_empty() {
        return "no goal".into();
    }
    let mut names: Vec<&str> = goals(belief, planner).map(|(_, name, _)| *name).collect();
    if *planner == BY_OPTIONS {
        names.extend(options::OPTIONS.map(|option| option.name));
    } else {
        names.extend(belief.learned_by.is_none().then_some(states));
    }
    names.join(", ")
}

#[cfg(test)]
mod tests {
    use super::super::goals::GOALS;
    use super::*;

    #[test]
    fn each_short_name_stands_for_its_parts() {
        let model = Model::wildfire();
        for &(name, parts) in NAMED {
            let policy = Policy::named(name, &model).expect("a policy");
            assert_eq!(policy.name, name);
            assert_eq!(Policy::named(parts, &model).expect("the same"), policy);
        }
    }

    #[test]
    fn each_combination_of_parts_is_found_by_its_name() {
        let model = Model::wildfire();
        let mut n_policies = 0;
        for &belief in BELIEFS {
            for &planner in PLANNERS {
                let goals = goals_of(belief, planner, &model.state_names().join(", "));
                for goal in goals.split(", ") {
                    let mut parts = format!("{}/{}", belief.name, planner.name);
                    if !planner.goals.is_empty() {
                        parts = format!("{parts}/{goal}");
                    }
                    let policy = Policy::named(&parts, &model).expect("a policy");
                    assert_eq!(Policy::named(&policy.name, &model).expect(&parts), policy);
                    check_name(&policy.name).expect("known before its model");
                    assert_eq!(planner_of(&policy.name), Some(planner));
                    n_policies += 1;
                }
            }
        }
        assert!(n_policies > 200, "{n_policies}");
    }

    #[test]
    fn no_state_has_the_name_of_a_goal() {
        let mut files = Model::built_in_files();
        let (_, text) = files.find(|it| it.0 == "wildfire").expect("built in");
        for &(_, goal, _) in GOALS {
            let error = Model::from_toml(&text.replace("normal", goal));
            let error = error.expect_err(goal).to_string();
            assert!(error.contains("state name"), "{error}");
        }
    }

    #[test]
    fn errors_explain_what_is_wrong_with_a_name() {
        let model = Model::wildfire();
        for (name, words) in [
            ("", "expected one of random_walk, coverage, "),
            ("rule", "or BELIEF/PLANNER/GOAL such as learned+"),
            ("knwon/beam/exploit", "belief: expected one of none, "),
            ("known/beem/exploit", "planner: expected one of random, "),
            ("known/beam/ash", ", normal, latent, fire, got \"ash\""),
            ("known/options/fire", "goal: expected one of rule, learned,"),
            ("none/random/exploit", "goal: expected no goal, got \"ex"),
            ("known/beam/learned", "latent, fire, got \"learned\""),
            ("learned/beam/fire", "goal: expected one of coverage, "),
            ("learned_", "got \"learned_\""),
        ] {
            let error = Policy::named(name, &model).expect_err(name).to_string();
            assert!(error.contains(words), "{error}");
        }
        check_name("known/beam/ash").expect("a state of some model");
        assert!(check_name("bem_exploit").is_err());
    }
}
