//! The policies that are compared by default.

use super::decisions::LearnedDecisions;
use super::goals::Goal;
use super::parts::Policy;
use super::planners::{AHEAD, BEAM, BY_OPTIONS, RANDOM, SHOOTING};
use crate::beliefs::{
    AUTOENCODER, BeliefKind, KNOWN, LEARNED, LEARNED_SPATIAL, NEURAL, NONE, RECOMMENDED, TRUTH,
};
use crate::learned::Learned;
use emberwatch_model::Model;

/// Returns the policies of the benchmark for a model and checkpoints, from the least to the most informed.
pub fn ladder(model: &Model, learned: &Learned) -> Vec<Policy> {
    use Goal::{Coverage, Exploit, ExploitOnly, Explore, Rule, State};
    let policy = |(belief, planner, goal)| Policy::new(belief, planner, goal, model);
    let states = (0..model.n_states()).filter(|state| *state != model.target_state());
    let states = states.map(|state| (&KNOWN, &SHOOTING, State(state)));
    let first = [
        (&NONE, &RANDOM, Coverage),
        (&NONE, &SHOOTING, Coverage),
        (&KNOWN, &SHOOTING, Explore),
    ];
    let known = [
        (&KNOWN, &SHOOTING, Exploit),
        (&KNOWN, &SHOOTING, ExploitOnly),
        (&KNOWN, &BEAM, Exploit),
        (RECOMMENDED, &SHOOTING, Exploit),
        (RECOMMENDED, &BEAM, Exploit),
    ];
    let oracles = [
        (&TRUTH, &SHOOTING, Exploit),
        (&TRUTH, &BEAM, Exploit),
        (&TRUTH, &AHEAD, Exploit),
        (&TRUTH, &BY_OPTIONS, Rule),
    ];
    let known = first.into_iter().chain(states).chain(known).map(policy);
    let of_learned = of_learned(learned, model).into_iter();
    known.chain(of_learned).chain(oracles.map(policy)).collect()
}

/// Learned beliefs that are compared by default, each in its best variant (`docs/filters.md`).
const LEARNED_BELIEFS: [&BeliefKind; 4] = [&LEARNED, &LEARNED_SPATIAL, &NEURAL, &AUTOENCODER];

fn of_learned(learned: &Learned, model: &Model) -> Vec<Policy> {
    use Goal::{Exploit, Explore};
    let mut all = Vec::new();
    for belief in LEARNED_BELIEFS {
        if belief.decides() {
            let goals = [Explore, Goal::Learned];
            all.extend(goals.map(|goal| (belief, &SHOOTING, goal)));
        }
        all.extend([&SHOOTING, &BEAM].map(|planner| (belief, planner, Exploit)));
    }
    let decisions = learned.get::<LearnedDecisions>();
    all.extend(decisions.map(|it| (it.belief, &BY_OPTIONS, Goal::Learned)));
    let policies = all.into_iter();
    let policies =
        policies.map(|(belief, planner, goal)| Policy::new(belief, planner, goal, model));
    policies
        .filter(|policy| policy.check(learned).is_ok())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_wildfire_ladder_has_these_policies() {
        let policies = ladder(&Model::wildfire(), &Learned::default());
        let names: Vec<&str> = policies.iter().map(|policy| &*policy.name).collect();
        let expected = "random_walk coverage known/shooting/explore known/shooting/normal known/shooting/latent \
             shooting known/shooting/exploit_only known/beam/exploit known+spatial+cavities/shooting/exploit beam \
             truth/shooting/exploit oracle_beam oracle_ahead oracle_policy";
        assert_eq!(names.join(" "), expected);
    }
}
