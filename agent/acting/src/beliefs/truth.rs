//! Beliefs that ignore frames: oracles, which receive the hidden states, and the constant first belief.

use super::kind::{BeliefKind, Input, Traits, cast_mut};
use emberwatch_belief::estimation::truth::{Oracle, Unchanging};

pub const NONE: BeliefKind = BeliefKind {
    name: "none",
    about: "the first belief, never updated",
    input: Input::Nothing,
    knows_model: false,
    has_options: false,
    is_of_observations: false,
    is_parallel: false,
    learned_by: None,
    chart: ("no belief", [0xa3, 0xa3, 0xa3]),
    traits: Traits::NONE,
    build: |conditions| Ok(Box::new(Unchanging(conditions.prior()?))),
};

pub const TRUTH: BeliefKind = BeliefKind {
    name: "truth",
    about: "the hidden states, predicted one step ahead; needs a server with --publish-truth",
    input: Input::States,
    traits: Traits {
        told: Some(|it| cast_mut::<Oracle>(it)),
        ..Traits::NONE
    },
    chart: ("fed with the truth", [0xe6, 0x9f, 0x00]),
    build: |conditions| {
        let oracle = Oracle::new(conditions.model()?, conditions.prior()?)?;
        Ok(Box::new(oracle))
    },
    ..NONE
};
