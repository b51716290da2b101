//! Kinds of belief: how to build each estimator, and its names and properties for commands, tables and charts.
//!
//! Each kind is a constant in a file of this folder, and has an entry in [`BELIEFS`].

pub mod autoencoder;
pub mod first_belief;
mod kind;
mod known;
pub mod learned;
pub mod neural;
mod truth;
mod world_form;

pub use self::autoencoder::AUTOENCODER;
pub use self::kind::{
    BeliefKind, Conditions, Input, LearnedBelief, LearnedBy, Traits, cast, numbered_states,
};
pub use self::known::{KNOWN, KNOWN_CAVITIES, KNOWN_SPATIAL, KNOWN_SPATIAL_CAVITIES};
pub use self::learned::{LEARNED, LEARNED_SPATIAL};
pub use self::neural::NEURAL;
pub use self::truth::{NONE, TRUTH};
pub use self::world_form::WorldForm;
use emberwatch_model::text::shortened;

/// The default where a model is known (measured in `docs/filters.md`). [`KNOWN`] is the paper's filter.
pub const RECOMMENDED: &BeliefKind = &KNOWN_SPATIAL_CAVITIES;

/// All kinds.
pub const BELIEFS: &[&BeliefKind] = &[
    &NONE,
    &KNOWN,
    &KNOWN_SPATIAL,
    &KNOWN_CAVITIES,
    &KNOWN_SPATIAL_CAVITIES,
    &LEARNED,
    &LEARNED_SPATIAL,
    &NEURAL,
    &AUTOENCODER,
    &TRUTH,
];

/// Finds a kind by its name.
pub fn named(name: &str) -> Option<&'static BeliefKind> {
    BELIEFS.iter().copied().find(|kind| kind.name == name)
}

/// Finds a kind like [`named`], but only among the kinds of belief on which a DQN can learn to choose options.
///
/// # Errors
/// If there is no such kind. The error lists the names of all valid kinds.
pub fn of_options(name: &str) -> Result<&'static BeliefKind, String> {
    named(name).filter(|kind| kind.has_options).ok_or_else(|| {
        let kinds = BELIEFS.iter().filter(|kind| kind.has_options);
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
        let names = "known, known+spatial, known+cavities, known+spatial+cavities, learned, learned+spatial, neural";
        let error = of_options("filter").expect_err("no name");
        assert_eq!(error, format!("expected one of {names}, got \"filter\""));
        for name in names.split(", ") {
            assert_eq!(of_options(name).map(|kind| kind.name), Ok(name));
        }
        assert!(of_options("truth").is_err());
    }
}
