//! A learned filter as others need it: its estimator, and as part of their checkpoints.

use crate::learning::checkpoint::{Part, check, wrong};
use crate::learning::learners::filter::fit::LearnedModel;
use anyhow::Result;
use emberwatch_belief::estimation::parameters::{Dimensions, Parameters, n_zones};
use emberwatch_belief::estimation::{BayesFilter, Correlations, Estimator, correcting};
use emberwatch_network::NamedTensor;
use emberwatch_protocol::{Grid, Shape};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The name of the tensor that holds the zone of each cell.
const ZONES: &str = "zones";

/// Before the names of the tensors of the filter that a neural belief corrects.
const FILTER: &str = "filter.";

impl LearnedModel {
    /// Before the first frame. `is_spatial`: whether its corrections reach the neighbours of visited cells.
    ///
    /// # Errors
    /// If it was learned on land of another grid.
    pub fn estimator(&self, is_spatial: bool, shape: Shape) -> Result<Box<dyn Estimator>> {
        let of_zones = self.tables.zones.as_ref().map(|zones| zones.dim());
        let got = of_zones.unwrap_or(shape.dim());
        check(
            got == shape.dim(),
            ZONES,
            format!("those of a {shape} grid"),
            format!("{got:?}"),
        )?;
        let filter = BayesFilter::learned(&self.tables, self.tables.prior(shape));
        let neighbours = || (self.target, self.correlations.clone());
        Ok(correcting(filter, is_spatial.then(neighbours)))
    }

    pub fn tensors(&self) -> Vec<NamedTensor> {
        let shapes = self.parameters.dimensions.shapes().into_iter();
        let names = Parameters::NAMES.iter().map(|name| (*name).to_owned());
        let tensors = names.zip(shapes).zip(self.parameters.tensors.clone());
        let tensors = tensors.map(|((name, shape), numbers)| (name, shape, numbers));
        tensors.chain(zones_tensor(&self.parameters)).collect()
    }

    /// Those of a filter that a neural belief corrects.
    pub fn corrected_tensors(&self) -> impl Iterator<Item = NamedTensor> + use<> {
        let named = |(name, shape, numbers)| (format!("{FILTER}{name}"), shape, numbers);
        self.tensors().into_iter().map(named)
    }
}

/// A learned filter, without its tensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedModel {
    dimensions: Dimensions,
    target: usize,
    correlations: Correlations,
}

impl SavedModel {
    pub fn of(model: &LearnedModel) -> Self {
        Self {
            dimensions: model.parameters.dimensions,
            target: model.target,
            correlations: model.correlations.clone(),
        }
    }

    pub fn read(&self, sees_own_state: bool, part: &Part<'_>) -> Result<LearnedModel> {
        let dimensions = Dimensions {
            sees_own_state,
            ..self.dimensions
        };
        let parameters = Form::read(dimensions, part)?.parameters(part, "")?;
        check_target(self.target, parameters.dimensions.n_states)?;
        let correlations = self.correlations.clone();
        Ok(LearnedModel::new(parameters, self.target, correlations))
    }

    /// One that a neural belief corrects, about so many observations.
    pub fn read_corrected(&self, n_observations: usize, part: &Part<'_>) -> Result<LearnedModel> {
        let (name, got) = ("filter.n_observations", self.dimensions.n_observations);
        check(got == n_observations, name, n_observations, got)?;
        self.read(false, &part.part(FILTER))
    }
}

/// The zones that a filter was learned on, where it has kernels for each.
pub fn zones_tensor(parameters: &Parameters) -> Option<NamedTensor> {
    let map = parameters.zones.as_ref()?;
    let (height, width) = map.dim();
    let numbers = map.iter().map(|&zone| f32::from(zone)).collect();
    Some((ZONES.into(), vec![height, width], numbers))
}

/// A filter's dimensions with what its tensors alone tell of: zones of land, and observation matrices.
#[derive(Debug, Clone, PartialEq)]
pub struct Form {
    pub dimensions: Dimensions,
    /// The zone of each cell, where zones have kernels of their own.
    pub zones: Option<Arc<Grid<u8>>>,
}

impl Form {
    pub fn read(dimensions: Dimensions, part: &Part<'_>) -> Result<Self> {
        let shape = part.shape(ZONES);
        let zones = shape.map(|shape| read_zones(shape, part)).transpose()?;
        let n_rings = match part.shape(Parameters::NAMES[1]) {
            Some(&[_, n_rings, _]) => n_rings,
            _ => 0,
        };
        let dimensions = Dimensions {
            n_zones: zones.as_ref().map_or(0, n_zones),
            n_rings,
            ..dimensions
        };
        let dimensions = dimensions.check();
        let dimensions =
            dimensions.map_err(|error| wrong("dimensions", "those of a filter", error))?;
        Ok(Self {
            dimensions,
            zones: zones.map(Arc::new),
        })
    }

    /// Parameters or moments, whose names end alike.
    pub fn parameters(&self, part: &Part<'_>, suffix: &str) -> Result<Parameters> {
        let shapes = self.dimensions.shapes();
        let tensor =
            |at: usize| part.tensor(&format!("{}{suffix}", Parameters::NAMES[at]), &shapes[at]);
        Ok(Parameters {
            dimensions: self.dimensions,
            tensors: [tensor(0)?, tensor(1)?, tensor(2)?],
            zones: self.zones.clone(),
        })
    }
}

fn read_zones(shape: &[usize], part: &Part<'_>) -> Result<Grid<u8>> {
    let &[height, width] = shape else {
        return Err(wrong(ZONES, "a map of a grid", format!("{shape:?}")));
    };
    let grid = Shape::new(height, width).map_err(|error| wrong(ZONES, "a map of a grid", error))?;
    let numbers = part.tensor(ZONES, shape)?;
    let is_zone = |number: &f32| (0.0..256.0).contains(number) && number.fract() == 0.0;
    if let Some(got) = numbers.iter().find(|number| !is_zone(number)) {
        return Err(wrong(ZONES, "zones from 0 to 255", got));
    }
    let zones = numbers.iter().map(|&number| number as u8).collect();
    let zones = Grid::from_shape_vec(grid.dim(), zones);
    Ok(zones.expect("invariant: the tensor has this shape"))
}

pub fn check_target(target: usize, n_states: usize) -> Result<()> {
    let expected = format!("less than {n_states}");
    check(target < n_states, "target", expected, target)
}
