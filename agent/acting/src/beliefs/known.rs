//! Bayes filters with the true model (paper section III.A, masked as in III.C).
//!
//! The kinds differ in their prediction of models of hazards (with or without cavities), and in whether corrections
//! reach the neighbours of visited cells.

use super::kind::{BeliefKind, Conditions, Input, Traits};
use anyhow::Result;
use emberwatch_belief::estimation::{BayesFilter, Correlations, SpatialFilter};

pub const KNOWN: BeliefKind = BeliefKind {
    name: "known",
    about: "the Bayes filter with the true model",
    input: Input::Frames,
    knows_model: true,
    has_options: true,
    is_of_observations: false,
    is_parallel: false,
    learned_by: None,
    chart: ("known model", [0x00, 0x72, 0xb2]),
    traits: Traits::of_filter::<BayesFilter>(),
    build: |conditions| Ok(Box::new(filter(conditions, false)?)),
};

pub const KNOWN_CAVITIES: BeliefKind = BeliefKind {
    name: "known+cavities",
    about: "known, without a cell's influence on itself; with a kernel, the same as known",
    build: |conditions| Ok(Box::new(filter(conditions, true)?)),
    ..KNOWN
};

pub const KNOWN_SPATIAL: BeliefKind = BeliefKind {
    name: "known+spatial",
    about: "known, where observations also correct neighbouring cells",
    traits: Traits::of_filter::<SpatialFilter>(),
    build: |conditions| Ok(Box::new(spatial(conditions, false)?)),
    ..KNOWN
};

pub const KNOWN_SPATIAL_CAVITIES: BeliefKind = BeliefKind {
    name: "known+spatial+cavities",
    about: "known+spatial, without a cell's influence on itself; with a kernel, the same as known+spatial",
    traits: Traits::of_filter::<SpatialFilter>(),
    build: |conditions| Ok(Box::new(spatial(conditions, true)?)),
    ..KNOWN
};

fn filter(conditions: &Conditions<'_>, cavities: bool) -> Result<BayesFilter> {
    let model = conditions.model()?;
    Ok(BayesFilter::known(model, conditions.prior()?, cavities)?)
}

fn spatial(conditions: &Conditions<'_>, cavities: bool) -> Result<SpatialFilter> {
    let (filter, state) = (
        filter(conditions, cavities)?,
        conditions.model()?.target_state(),
    );
    Ok(SpatialFilter::new(filter, state, Correlations::default()))
}
