//! Bayes filters with the true model (paper section III.A, masked as in III.C).
//!
//! The kinds differ in their prediction (mean field, second order or cavities), and in whether corrections reach the
//! neighbours of visited cells.

use super::kind::{BeliefKind, Conditions, Input};
use anyhow::Result;
use emberwatch_belief::estimation::prediction::PredictionKind;
use emberwatch_belief::estimation::{BayesFilter, Correlations, SpatialFilter};
use emberwatch_model::Model;

pub const KNOWN: BeliefKind = BeliefKind {
    name: "known",
    about: "the Bayes filter with the true model",
    input: Input::Frames,
    knows_model: true,
    learned_by: None,
    chart: ("known model", [0x00, 0x72, 0xb2]),
    handover: Some(|model| BayesFilter::handover_of_known(model, PredictionKind::MeanField)),
    build: |conditions| Ok(Box::new(filter(conditions, PredictionKind::MeanField)?)),
};

pub const KNOWN_SECOND_ORDER: BeliefKind = BeliefKind {
    name: "known+second-order",
    about: "known, with a second-order mean of the ratio in eq. 3",
    handover: Some(|model| BayesFilter::handover_of_known(model, PredictionKind::SecondOrder)),
    build: |conditions| Ok(Box::new(filter(conditions, PredictionKind::SecondOrder)?)),
    ..KNOWN
};

pub const KNOWN_CAVITIES: BeliefKind = BeliefKind {
    name: "known+cavities",
    about: "known, predicting a cell without its own influence on its neighbours",
    handover: Some(|model| BayesFilter::handover_of_known(model, PredictionKind::Cavities)),
    build: |conditions| Ok(Box::new(filter(conditions, PredictionKind::Cavities)?)),
    ..KNOWN
};

pub const KNOWN_SPATIAL: BeliefKind = BeliefKind {
    name: "known+spatial",
    about: "known, where observations also correct neighbouring cells",
    handover: Some(|model| spatial_handover(model, PredictionKind::MeanField)),
    build: |conditions| Ok(Box::new(spatial(conditions, PredictionKind::MeanField)?)),
    ..KNOWN
};

pub const KNOWN_SPATIAL_CAVITIES: BeliefKind = BeliefKind {
    name: "known+spatial+cavities",
    about: "known+spatial, predicting like known+cavities",
    handover: Some(|model| spatial_handover(model, PredictionKind::Cavities)),
    build: |conditions| Ok(Box::new(spatial(conditions, PredictionKind::Cavities)?)),
    ..KNOWN
};

/// Builds the filter with the true model.
fn filter(conditions: &Conditions<'_>, kind: PredictionKind) -> Result<BayesFilter> {
    let model = conditions.model()?;
    Ok(BayesFilter::known(model, conditions.prior()?)?.predicting_known(model, kind))
}

/// Builds a filter with the true model. Its corrections reach the neighbours of visited cells.
fn spatial(conditions: &Conditions<'_>, kind: PredictionKind) -> Result<SpatialFilter> {
    let (filter, state) = (
        filter(conditions, kind)?,
        conditions.model()?.target_state(),
    );
    Ok(SpatialFilter::new(filter, state, Correlations::default()))
}

/// Returns the name of the format in which an agent hands over a spatial filter, see `Handover::kind`.
fn spatial_handover(model: &Model, kind: PredictionKind) -> String {
    SpatialFilter::handover_of(
        &BayesFilter::handover_of_known(model, kind),
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
            &KNOWN_SECOND_ORDER,
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
