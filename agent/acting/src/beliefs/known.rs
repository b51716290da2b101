//! Bayes filters with the true model (paper section III.A, masked as in III.C).
//!
//! The kinds differ in their prediction of models of hazards (with or without cavities), and in whether corrections
//! reach the neighbours of visited cells.

use super::kind::{BeliefKind, Conditions, Input};
use anyhow::Result;
use emberwatch_belief::estimation::{BayesFilter, Correlations, SpatialFilter};
use emberwatch_model::Model;

pub const KNOWN: BeliefKind = BeliefKind {
    name: "known",
    about: "the Bayes filter with the true model",
    input: Input::Frames,
    knows_model: true,
    has_options: true,
    is_parallel: false,
    learned_by: None,
    chart: ("known model", [0x00, 0x72, 0xb2]),
    handover: Some(|model| BayesFilter::handover_of_known(model, false)),
    build: |conditions| Ok(Box::new(filter(conditions, false)?)),
};

pub const KNOWN_CAVITIES: BeliefKind = BeliefKind {
    name: "known+cavities",
    about: "known, without a cell's influence on itself; with a kernel, the same as known",
    handover: Some(|model| BayesFilter::handover_of_known(model, true)),
    build: |conditions| Ok(Box::new(filter(conditions, true)?)),
    ..KNOWN
};

pub const KNOWN_SPATIAL: BeliefKind = BeliefKind {
    name: "known+spatial",
    about: "known, where observations also correct neighbouring cells",
    handover: Some(|model| spatial_handover(model, false)),
    build: |conditions| Ok(Box::new(spatial(conditions, false)?)),
    ..KNOWN
};

pub const KNOWN_SPATIAL_CAVITIES: BeliefKind = BeliefKind {
    name: "known+spatial+cavities",
    about: "known+spatial, without a cell's influence on itself; with a kernel, the same as known+spatial",
    handover: Some(|model| spatial_handover(model, true)),
    build: |conditions| Ok(Box::new(spatial(conditions, true)?)),
    ..KNOWN
};

/// Builds the filter with the true model.
fn filter(conditions: &Conditions<'_>, cavities: bool) -> Result<BayesFilter> {
    let model = conditions.model()?;
    Ok(BayesFilter::known(model, conditions.prior()?, cavities)?)
}

/// Builds a filter with the true model. Its corrections reach the neighbours of visited cells.
fn spatial(conditions: &Conditions<'_>, cavities: bool) -> Result<SpatialFilter> {
    let (filter, state) = (
        filter(conditions, cavities)?,
        conditions.model()?.target_state(),
    );
    Ok(SpatialFilter::new(filter, state, Correlations::default()))
}

/// Returns the name of the format in which an agent hands over a spatial filter, see `Handover::kind`.
fn spatial_handover(model: &Model, cavities: bool) -> String {
    SpatialFilter::handover_of(
        &BayesFilter::handover_of_known(model, cavities),
        model.target_state(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::learned::Learned;
    use emberwatch_belief::estimation::belief::Belief;
    use emberwatch_model::Shape;

    #[test]
    fn handover_names_match_the_estimators() {
        let (model, shape) = (Model::wildfire(), Shape::new(4, 5).expect("test shape"));
        let conditions = Conditions {
            model: Some(&model),
            shape,
            prior: Some(&Belief::uniform(3, shape)),
            learned: &Learned::default(),
        };
        for kind in [
            &KNOWN,
            &KNOWN_CAVITIES,
            &KNOWN_SPATIAL,
            &KNOWN_SPATIAL_CAVITIES,
        ] {
            let estimator = (kind.build)(&conditions).expect("a filter");
            let expected = estimator.handover().map(|it| it.kind());
            assert_eq!(kind.handover.map(|name| name(&model)), expected);
        }
    }
}
