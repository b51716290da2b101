//! What each policy does, in a line.

use super::named::{EstimatorKind, PlannerKind, Policy};
use crate::planning::objective::Target;
use protocol::Model;

/// All policies of a model, a line each: name, planner, objective, belief.
pub fn list(model: &Model) -> String {
    let policies = Policy::all(model);
    let width = policies.iter().map(|policy| policy.name.len()).max();
    let width = width.unwrap_or(0);
    let lines = policies.iter().map(|policy| {
        let (name, words) = (&policy.name, description(policy, model));
        format!("  {name:width$}  {words}\n")
    });
    lines.collect()
}

fn description(policy: &Policy, model: &Model) -> String {
    let planner = match policy.planner {
        PlannerKind::RandomWalk => return "random moves, the paper's baseline".into(),
        PlannerKind::Shooting => "best of random paths",
        PlannerKind::Beam => "beam search",
        PlannerKind::BeamAhead => "beam search six paths ahead",
    };
    let belief = match policy.estimator {
        EstimatorKind::KnownModel if policy.is_decided => ", needs --checkpoint",
        EstimatorKind::None | EstimatorKind::KnownModel => "",
        EstimatorKind::Spatial => "; corrections reach neighbours",
        EstimatorKind::Learned => "; learned filter, needs --checkpoint",
        EstimatorKind::LearnedSpatial => "; learned, reaches neighbours, needs --checkpoint",
        EstimatorKind::LearnedOwn => "; learned, by own state, needs --checkpoint",
        EstimatorKind::LearnedOwnSpatial => "; by own state and neighbours, needs --checkpoint",
        EstimatorKind::Autoencoder => "; autoencoder, needs --checkpoint",
        EstimatorKind::Truth => "; told the states, needs --publish-truth",
        EstimatorKind::NextTruth => "; told the next states, only in `compare`",
    };
    format!("{planner} for {}{belief}", goal(policy, model))
}

fn goal(policy: &Policy, model: &Model) -> String {
    if policy.is_decided {
        return "what a learned DQN chooses".into();
    }
    if let Some(action) = &policy.action {
        return format!("the action {:?} of dqn_beam, always", action.name);
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
    match policy.objective.coverage_bonus > 0.0 {
        true => goal,
        false => format!("{goal}, and nothing else"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_list_has_a_line_for_every_policy() {
        let model = Model::wildfire();
        let list = list(&model);
        let named: Vec<&str> = list
            .lines()
            .filter_map(|line| line.split_whitespace().next())
            .collect();
        let names = Policy::all(&model).into_iter().map(|policy| policy.name);
        assert_eq!(named, names.collect::<Vec<_>>());
        let line = |name: &str| list.lines().find(|line| line.trim().starts_with(name));
        assert_eq!(
            line("clairvoyant_beam").map(str::trim),
            Some(
                "clairvoyant_beam              beam search for fire, which pays most; told the next \
                 states, only in `compare`"
            )
        );
        assert!(list.lines().all(|line| line.len() <= 120), "{list}");
    }
}
