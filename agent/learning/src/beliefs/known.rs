//! The Bayes filter of the true model (paper section III.A, masked as in III.C), and one whose corrections reach the
//! neighbours of visited cells.

use super::kind::{BeliefKind, Conditions, Input};
use anyhow::Result;
use emberwatch_belief::estimation::prediction::PredictionKind;
use emberwatch_belief::estimation::{BayesFilter, Correlations, SpatialFilter};
use emberwatch_model::Model;

pub const KNOWN: BeliefKind = BeliefKind {
    name: "known",
    label: "known_model",
    about: "the Bayes filter of the true model",
    input: Input::Frames,
    knows_model: true,
    learned_by: None,
    chart: ("known model", [0x00, 0x72, 0xb2]),
    handover: Some(|model| BayesFilter::handover_of_known(model, PredictionKind::MeanField)),
    build: |conditions| Ok(Box::new(filter(conditions, PredictionKind::MeanField)?)),
};

pub const KNOWN_SECOND_ORDER: BeliefKind = BeliefKind {
    name: "known+second-order",
    label: "second_order_filter",
    about: "the filter with the mean of eq. 3's ratio, not the ratio of means",
    handover: Some(|model| BayesFilter::handover_of_known(model, PredictionKind::SecondOrder)),
    build: |conditions| Ok(Box::new(filter(conditions, PredictionKind::SecondOrder)?)),
    ..KNOWN
};

pub const KNOWN_CAVITIES: BeliefKind = BeliefKind {
    name: "known+cavities",
    label: "cavity_filter",
    about: "the same; and no cell is predicted from its own echo in its neighbours",
    handover: Some(|model| BayesFilter::handover_of_known(model, PredictionKind::Cavities)),
    build: |conditions| Ok(Box::new(filter(conditions, PredictionKind::Cavities)?)),
    ..KNOWN
};

pub const KNOWN_SPATIAL: BeliefKind = BeliefKind {
    name: "known+spatial",
    label: "spatial_filter",
    about: "the same; what a cell shows corrects its neighbours, too",
    handover: Some(|model| spatial_handover(model, PredictionKind::MeanField)),
    build: |conditions| Ok(Box::new(spatial(conditions, PredictionKind::MeanField)?)),
    ..KNOWN
};

pub const KNOWN_SPATIAL_CAVITIES: BeliefKind = BeliefKind {
    name: "known+spatial+cavities",
    label: "spatial_cavity_filter",
    about: "cavities, and what a cell shows corrects its neighbours, too",
    handover: Some(|model| spatial_handover(model, PredictionKind::Cavities)),
    build: |conditions| Ok(Box::new(spatial(conditions, PredictionKind::Cavities)?)),
    ..KNOWN
};

fn filter(conditions: &Conditions<'_>, kind: PredictionKind) -> Result<BayesFilter> {
    let model = conditions.model()?;
    Ok(BayesFilter::known(model, conditions.prior()?)?.predicting_known(model, kind))
}

fn spatial(conditions: &Conditions<'_>, kind: PredictionKind) -> Result<SpatialFilter> {
    let (state, unknown) = (conditions.model()?.target_state(), Correlations::default());
    Ok(SpatialFilter::new(
        filter(conditions, kind)?,
        state,
        unknown,
    ))
}

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
    fn beliefs_that_agents_leave_are_named_without_an_agent() {
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
            let of_estimator = estimator.handover().map(|it| it.kind());
            assert_eq!(kind.handover.map(|of| of(&model)), of_estimator);
        }
    }
}
