//! The Bayes filter of the true model (paper section III.A, masked as in III.C), and one whose corrections reach the
//! neighbours of visited cells.

use super::kind::{BeliefKind, Conditions, Input};
use anyhow::Result;
use emberwatch_belief::estimation::{BayesFilter, Correlations, SpatialFilter};

pub const KNOWN: BeliefKind = BeliefKind {
    name: "known",
    label: "known_model",
    about: "the Bayes filter of the true model",
    input: Input::Frames,
    knows_model: true,
    learned_by: None,
    chart: ("known model", [0x00, 0x72, 0xb2]),
    handover: Some(BayesFilter::handover_of_known),
    build: |conditions| Ok(Box::new(filter(conditions)?)),
};

pub const KNOWN_SPATIAL: BeliefKind = BeliefKind {
    name: "known+spatial",
    label: "spatial_filter",
    about: "the same; what a cell shows corrects its neighbours, too",
    handover: Some(|model| {
        SpatialFilter::handover_of(&BayesFilter::handover_of_known(model), model.target_state())
    }),
    build: |conditions| {
        let (state, unknown) = (conditions.model()?.target_state(), Correlations::default());
        let filter = filter(conditions)?;
        Ok(Box::new(SpatialFilter::new(filter, state, unknown)))
    },
    ..KNOWN
};

fn filter(conditions: &Conditions<'_>) -> Result<BayesFilter> {
    Ok(BayesFilter::known(
        conditions.model()?,
        conditions.prior()?,
    )?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::learned::Learned;
    use emberwatch_belief::estimation::belief::Belief;
    use emberwatch_model::{Model, Shape};

    #[test]
    fn beliefs_that_agents_leave_are_named_without_an_agent() {
        let (model, shape) = (Model::wildfire(), Shape::new(4, 5).expect("test shape"));
        let conditions = Conditions {
            model: Some(&model),
            shape,
            prior: Some(&Belief::uniform(3, shape)),
            learned: &Learned::default(),
        };
        for kind in [&KNOWN, &KNOWN_SPATIAL] {
            let estimator = (kind.build)(&conditions).expect("a filter");
            let of_estimator = estimator.handover().map(|it| it.kind());
            assert_eq!(kind.handover.map(|of| of(&model)), of_estimator);
        }
    }
}
