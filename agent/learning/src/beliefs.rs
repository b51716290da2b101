//! Kinds of belief: how to build each estimator, and its names and properties for commands, tables and charts.
//!
//! Each kind is a constant in a file of this folder, and has an entry in [`BELIEFS`].

pub mod autoencoder;
pub mod first_belief;
mod follower;
mod kind;
mod known;
pub mod learned;
pub mod neural;
mod truth;
mod world_form;

pub use self::autoencoder::AUTOENCODER;
pub use self::kind::{BeliefKind, Conditions, Input, LearnedBelief, LearnedBy, numbered_states};
pub use self::known::{
    KNOWN, KNOWN_CAVITIES, KNOWN_SECOND_ORDER, KNOWN_SPATIAL, KNOWN_SPATIAL_CAVITIES,
};
pub use self::learned::{LEARNED, LEARNED_CAVITIES, LEARNED_SPATIAL, LEARNED_SPATIAL_CAVITIES};
pub use self::neural::{NEURAL, NEURAL_SENSOR};
pub use self::truth::{NONE, TRUTH};
pub use self::world_form::WorldForm;

use emberwatch_model::text::shortened;

/// All kinds, ordered by how much they know about the world.
pub const BELIEFS: &[&BeliefKind] = &[
    &NONE,
    &KNOWN,
    &KNOWN_SPATIAL,
    &KNOWN_SECOND_ORDER,
    &KNOWN_CAVITIES,
    &KNOWN_SPATIAL_CAVITIES,
    &LEARNED,
    &LEARNED_SPATIAL,
    &LEARNED_CAVITIES,
    &LEARNED_SPATIAL_CAVITIES,
    &NEURAL,
    &NEURAL_SENSOR,
    &AUTOENCODER,
    &TRUTH,
];

/// Finds a kind by its name.
pub fn named(name: &str) -> Option<&'static BeliefKind> {
    BELIEFS.iter().copied().find(|kind| kind.name == name)
}

/// Finds a kind like [`named`], but only among the kinds of belief on which a DQN can learn to choose options.
///
/// Such a belief is corrected by frames, and it either knows the model or is learned, but not both. Kinds whose learner
/// already learns which objective to plan for are excluded.
///
/// # Errors
/// If there is no such kind. The error lists the names of all valid kinds.
pub fn of_options(name: &str) -> Result<&'static BeliefKind, String> {
    let serves = |kind: &&BeliefKind| {
        let has_one_source = !kind.knows_model || kind.learned_by.is_none();
        kind.input == Input::Frames && has_one_source && !kind.decides()
    };
    named(name).filter(serves).ok_or_else(|| {
        let kinds = BELIEFS.iter().copied().filter(serves);
        let names: Vec<&str> = kinds.map(|kind| kind.name).collect();
        format!(
            "expected one of {}, got {:?}",
            names.join(", "),
            shortened(name)
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_name_and_text_identifies_one_kind() {
        for &kind in BELIEFS {
            assert_eq!(named(kind.name), Some(kind));
            let same = BELIEFS
                .iter()
                .filter(|it| it.name == kind.name || it.about == kind.about);
            assert_eq!(same.count(), 1, "{kind:?}");
        }
    }

    #[test]
    fn options_are_learned_on_beliefs_that_frames_correct() {
        let names = [
            "known, known+spatial, known+second-order, known+cavities, known+spatial+cavities",
            "learned, learned+spatial, learned+cavities, learned+spatial+cavities, neural",
        ]
        .join(", ");
        let error = of_options("filter").expect_err("no name");
        assert_eq!(error, format!("expected one of {names}, got \"filter\""));
        for name in names.split(", ") {
            assert_eq!(of_options(name).map(|kind| kind.name), Ok(name));
        }
        assert!(of_options("truth").is_err());
    }
}
