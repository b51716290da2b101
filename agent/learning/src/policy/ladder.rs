//! The policies that are compared by default.

use super::decisions::LearnedDecisions;
use super::parts::{Goal, Policy};
use super::planners::{self, AHEAD, BEAM, RANDOM, SHOOTING};
use crate::beliefs::{
    AUTOENCODER, BeliefKind, Input, KNOWN, KNOWN_SPATIAL, LEARNED, LEARNED_SPATIAL, NEURAL, NONE,
    TRUTH,
};
use crate::learned::Learned;
use emberwatch_belief::planning::options::OPTIONS;
use emberwatch_model::Model;

/// Returns the policies of the benchmark for a model, from the least to the most informed.
pub fn ladder(model: &Model) -> Vec<Policy> {
    use Goal::{Coverage, Exploit, ExploitOnly, Explore, Rule, State};
    let states = (0..model.n_states()).filter(|state| *state != model.target_state());
    let states = states.map(|state| (&KNOWN, &SHOOTING, State(state)));
    let first = [
        (&NONE, &RANDOM, Coverage),
        (&NONE, &SHOOTING, Coverage),
        (&KNOWN, &SHOOTING, Explore),
    ];
    let rest = [
        (&KNOWN, &SHOOTING, Exploit),
        (&KNOWN, &SHOOTING, ExploitOnly),
        (&KNOWN, &BEAM, Exploit),
        (&KNOWN_SPATIAL, &SHOOTING, Exploit),
        (&KNOWN_SPATIAL, &BEAM, Exploit),
        (&TRUTH, &SHOOTING, Exploit),
        (&TRUTH, &BEAM, Exploit),
        (&TRUTH, &AHEAD, Exploit),
        (&TRUTH, &planners::BY_OPTIONS, Rule),
    ];
    let all = first.into_iter().chain(states).chain(rest);
    all.map(|(belief, planner, goal)| Policy::new(belief, planner, goal, model))
        .collect()
}

/// Learned beliefs that are compared by default, each in its best variant (`docs/filters.md`).
const LEARNED_BELIEFS: [&BeliefKind; 4] = [&LEARNED, &LEARNED_SPATIAL, &NEURAL, &AUTOENCODER];

/// Returns the default policies for checkpoints: shooting and beam search on learned beliefs, and a DQN's decisions.
pub fn of_learned(learned: &Learned, model: &Model) -> Vec<Policy> {
    use Goal::{Exploit, Explore};
    let policy = |belief, planner, goal| Policy::new(belief, planner, goal, model);
    let mut policies = Vec::new();
    for belief in LEARNED_BELIEFS {
        if belief.decides() {
            policies.push(policy(belief, &SHOOTING, Explore));
        }
        policies.push(policy(belief, &SHOOTING, Exploit));
        if belief.decides() {
            policies.push(policy(belief, &SHOOTING, Goal::Learned));
        }
        policies.push(policy(belief, &BEAM, Exploit));
    }
    if let Some(decisions) = learned.get::<LearnedDecisions>() {
        policies.push(policy(
            decisions.belief,
            &planners::BY_OPTIONS,
            Goal::Learned,
        ));
    }
    policies.retain(|policy| policy.check(learned).is_ok());
    policies
}

/// Returns the policies for a table of all options on one belief: random moves, then each option, the rule, and, if
/// frames correct the belief, the learned choice.
pub fn options_table(belief: &'static BeliefKind, model: &Model) -> Vec<Policy> {
    let options = OPTIONS.iter().map(Goal::Option).chain([Goal::Rule]);
    let learned = (belief.input == Input::Frames).then_some(Goal::Learned);
    let goals = options.chain(learned);
    let first = Policy::new(&NONE, &RANDOM, Goal::Coverage, model);
    let rest = goals.map(|goal| Policy::new(belief, &planners::BY_OPTIONS, goal, model));
    std::iter::once(first).chain(rest).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_wildfire_ladder_has_these_policies() {
        let policies = ladder(&Model::wildfire());
        let names: Vec<&str> = policies.iter().map(|policy| &*policy.name).collect();
        let expected = "random_walk coverage shooting_explore shooting_normal shooting_latent shooting_exploit \
             shooting_exploit_only beam_exploit spatial_shooting spatial_beam oracle_shooting oracle_beam oracle_ahead \
             oracle_policy";
        assert_eq!(names.join(" "), expected);
    }

    #[test]
    fn options_tables_have_one_policy_per_option() {
        let model = Model::wildfire();
        for (belief, n_chosen) in [(&KNOWN, 2), (&TRUTH, 1)] {
            let table = options_table(belief, &model);
            assert_eq!(table.len(), 1 + OPTIONS.len() + n_chosen);
            assert!(table[1..].iter().all(|policy| policy.belief == belief));
        }
    }
}
