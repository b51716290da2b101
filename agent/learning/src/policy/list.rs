//! What each policy does, in a line.

use super::kinds::{Choice, EstimatorKind, PlannerKind, Policy};
use emberwatch_belief::planning::objective::Target;
use emberwatch_belief::planning::options::OPTIONS;
use emberwatch_model::Model;

/// All policies of a model, a line each: name, planner, objective, belief; those of single options together.
pub fn list(model: &Model) -> String {
    let mut policies = Policy::all(model);
    policies.retain(|policy| !policy.is_option());
    let width = policies.iter().map(|policy| policy.name.len()).max();
    let width = width.unwrap_or(0);
    let lines = policies.iter().map(|policy| {
        let (name, words) = (&policy.name, description(policy, model));
        format!("  {name:width$}  {words}\n")
    });
    lines.collect::<String>() + &options()
}

/// How the policies of single options are called.
fn options() -> String {
    let beliefs: Vec<&str> = EstimatorKind::all_of_options()
        .map(EstimatorKind::family)
        .collect();
    let beliefs = beliefs.join(", ");
    let names = OPTIONS.map(|option| option.name).join(", ");
    format!(
        "  BELIEF_OPTION: one option of BELIEF_policy, always\n    BELIEF: {beliefs}\n    OPTION: {names}\n    \
         or rule: the best region if it promises more than here, else exploit\n"
    )
}

fn description(policy: &Policy, model: &Model) -> String {
    let planner = match policy.planner {
        PlannerKind::RandomWalk => return "random moves, the paper's baseline".into(),
        PlannerKind::Shooting => "best of random paths",
        PlannerKind::Beam => "beam search",
        PlannerKind::BeamAhead => "beam search six paths ahead",
    };
    let belief = match policy.estimator {
        EstimatorKind::None => String::new(),
        EstimatorKind::Known { is_spatial } => filter(policy, false, is_spatial),
        EstimatorKind::Learned { is_own, is_spatial } => filter(policy, is_own, is_spatial),
        EstimatorKind::Neural => "; neural belief, needs --checkpoint".into(),
        EstimatorKind::Autoencoder => "; autoencoder, needs --checkpoint".into(),
        EstimatorKind::Truth => "; told the states, needs --publish-truth".into(),
        EstimatorKind::NextTruth => "; told the next states, only in `compare`".into(),
    };
    format!("{planner} for {}{belief}", goal(policy, model))
}

fn filter(policy: &Policy, is_own: bool, is_spatial: bool) -> String {
    let words = [
        (policy.estimator.is_learned(), "learned"),
        (is_own, "by own state"),
        (is_spatial, "reaches neighbours"),
        (policy.needs_checkpoint(), "needs --checkpoint"),
    ];
    let said = words.into_iter().filter(|(is_so, _)| *is_so);
    let said: Vec<&str> = said.map(|(_, words)| words).collect();
    let start = if said.is_empty() { "" } else { "; " };
    start.to_owned() + &said.join(", ")
}

fn goal(policy: &Policy, model: &Model) -> String {
    match policy.choice {
        Choice::Network => return "what a learned DQN chooses".into(),
        Choice::Scorer => return "the option of most value".into(),
        Choice::Rule => return "what is near, or the best region".into(),
        Choice::Option(option) => return format!("the option {}, always", option.name),
        Choice::Objective => (),
    }
    let is_learned = policy.estimator.is_learned();
    let goal = match policy.objective.target {
        Target::Coverage => return "new cells".into(),
        Target::Entropy => "the belief's entropy".into(),
        Target::State(_) if is_learned => "what pays most".into(),
        Target::State(state) if state == model.target_state() => {
            format!("{}, which pays most", model.file().states[state].name)
        }
        Target::State(state) => model.file().states[state].name.clone(),
    };
    if policy.objective.coverage_bonus > 0.0 {
        goal
    } else {
        format!("{goal}, and nothing else")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_list_has_a_line_for_every_policy() {
        let model = Model::wildfire();
        let list = list(&model);
        let (lines, options) = list.split_once("  BELIEF_OPTION").expect("options");
        assert!(options.contains("best_region") && options.contains("learned_spatial"));
        let named: Vec<&str> = lines
            .lines()
            .filter_map(|line| line.split_whitespace().next())
            .collect();
        let policies = Policy::all(&model).into_iter();
        let policies = policies.filter(|policy| !policy.is_option());
        let names = policies.map(|policy| policy.name);
        assert_eq!(named, names.collect::<Vec<_>>());
        let line = |name: &str| list.lines().find(|line| line.trim().starts_with(name));
        assert_eq!(
            line("clairvoyant_beam").map(str::trim),
            Some(
                "clairvoyant_beam              beam search for fire, which pays most; told the next \
                 states, only in `compare`"
            )
        );
        assert!(list.lines().all(|line| line.len() <= 135), "{list}");
    }
}
