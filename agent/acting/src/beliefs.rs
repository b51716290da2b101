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

/// Finds a kind of belief on which a DQN can learn to choose options. The error lists the names of all valid kinds.
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
    use crate::beliefs::learned::LearnedModel;
    use crate::beliefs::neural::NeuralModel;
    use crate::learned::Learned;
    use crate::testing::learned_filter;
    use emberwatch_belief::Belief;
    use emberwatch_model::{Frame, Model, Shape};
    use emberwatch_network::{Device, NeuralBelief};

    #[test]
    fn a_refused_frame_changes_no_kind_of_belief() {
        // With an exact sensor, a cell that was seen in one state cannot be seen in another.
        let mut file = Model::wildfire().file().clone();
        for (state, entry) in file.states.iter_mut().enumerate() {
            entry.observed_as = (0..3).map(|seen| f64::from(seen == state)).collect();
        }
        let (model, shape) = (
            Model::new(file).expect("a model"),
            Shape::new(5, 6).expect("a shape"),
        );
        let frame = |seen: &[(usize, u8)]| {
            let mut values = [255; 30];
            seen.iter().for_each(|&(cell, value)| values[cell] = value);
            Frame::from_bytes(shape, 3, &values).expect("a frame")
        };
        let prior = Belief::uniform(3, shape);
        let refuses = |kind: &BeliefKind, filter: Option<LearnedModel>| {
            let mut learned = Learned::default();
            learned.put(NeuralModel {
                network: NeuralBelief::new(3, 1, &Device::Cpu).expect("a network"),
                filter: filter.map(Box::new),
                target: 1,
            });
            let conditions = Conditions {
                shape,
                model: Some(&model),
                prior: Some(&prior),
                learned: &learned,
            };
            let mut both = [(); 2].map(|()| (kind.build)(&conditions).expect("a belief"));
            for step in 0..3 {
                for one in &mut both {
                    one.correct(&frame(&[(step, 0), (29, 1)]))
                        .expect("possible");
                }
                // The first cells are possible, the last one is not.
                let refused = both[0].correct(&frame(&[(9, 2), (20, 0), (29, 2)]));
                assert!(refused.is_err(), "{kind:?}");
                for _ in 0..2 {
                    let bytes = both
                        .each_ref()
                        .map(|one| kind.traits.handover.map(|it| it(&**one).to_bytes()));
                    assert_eq!(bytes[0], bytes[1], "{kind:?}");
                    let beliefs = both.each_ref().map(|one| one.belief().to_bytes());
                    assert_eq!(beliefs[0], beliefs[1], "{kind:?}");
                    both.iter_mut().for_each(|one| one.predict());
                }
            }
        };
        let knowing = BELIEFS
            .iter()
            .filter(|kind| kind.knows_model && kind.input == Input::Frames);
        for kind in knowing.copied().filter(|kind| kind.learned_by.is_none()) {
            refuses(kind, None);
        }
        refuses(&NEURAL, None);
        refuses(&NEURAL, Some(learned_filter()));
    }

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
