//! What a filter's tensors alone tell of it in a checkpoint, zones of land and observation matrices, and whether a world has
//! the same.

use crate::checkpoint::{Part, check, wrong};
use anyhow::{Context, Result, ensure};
use emberwatch_belief::estimation::parameters::{Dimensions, Parameters, Tables, n_zones};
use emberwatch_model::{Grid, Shape};
use emberwatch_network::NamedTensor;
use std::sync::Arc;

/// The name of the tensor that holds the zone of each cell.
const ZONES: &str = "zones";

/// The tensors of parameters, or of their moments, whose names end alike.
pub fn named_tensors(parameters: &Parameters, suffix: &str) -> [NamedTensor; 3] {
    let shapes = parameters.dimensions.shapes();
    [0, 1, 2].map(|at| {
        let name = format!("{}{suffix}", Parameters::NAMES[at]);
        (name, shapes[at].clone(), parameters.tensors[at].clone())
    })
}

/// The zones that a filter was learned on, shape `[H, W]`, where it has kernels for each.
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
    /// That of a filter whose state says the other dimensions.
    ///
    /// # Errors
    /// If zones or matrices are none that a filter can have.
    pub fn read(dimensions: Dimensions, part: &Part<'_>) -> Result<Self> {
        let shape = part.shape(ZONES);
        let zones = shape.map(|shape| read_zones(shape, part)).transpose()?;
        let n_matrices = match part.shape(Parameters::NAMES[1]) {
            Some(&[_, n_matrices, _]) => n_matrices.max(1),
            _ => 1,
        };
        let dimensions = Dimensions {
            n_zones: zones.as_ref().map_or(0, n_zones),
            n_matrices,
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

/// What a world must have in common with that of a belief that was learned.
#[derive(Debug, Clone, Copy)]
pub struct WorldForm<'a> {
    /// Values that a cell may show, of all matrices together.
    pub n_observations: usize,
    /// Observation matrices of the sensor, at least 1.
    pub n_matrices: usize,
    /// The zone of each cell, shape `[H, W]`, if there are zones and they are known.
    pub zones: Option<&'a Grid<u8>>,
}

impl WorldForm<'_> {
    /// Refuses a belief about other observations.
    pub fn check_observations(&self, n_observations: usize, n_matrices: usize) -> Result<()> {
        let (expected, got) = (self.n_observations, n_observations);
        ensure!(
            got == expected,
            "checkpoint: expected {expected} observations as the world's, got {got}"
        );
        let (expected, got) = (self.n_matrices, n_matrices);
        ensure!(
            got == expected,
            "checkpoint: expected {expected} observation matrices as the world's sensor has, got {got}"
        );
        Ok(())
    }

    /// Refuses a filter about other observations, or learned on zones that are not the world's.
    pub fn check_filter(&self, filter: &Tables) -> Result<()> {
        let dimensions = filter.dimensions;
        self.check_observations(dimensions.n_observations, dimensions.n_matrices)?;
        match &filter.zones {
            None => Ok(()),
            zones => check_zones(self.zones, zones.as_deref()).context("checkpoint"),
        }
    }
}

/// Refuses another map of zones, or none, or any, than is expected.
pub fn check_zones(expected: Option<&Grid<u8>>, got: Option<&Grid<u8>>) -> Result<()> {
    let told = |map: Option<&Grid<u8>>| match map {
        None => "none".to_owned(),
        Some(map) => {
            let (height, width) = map.dim();
            format!("{} on {height} x {width} cells", n_zones(map))
        }
    };
    let (wants, has) = (told(expected), told(got));
    let has = if has == wants {
        "another map".into()
    } else {
        has
    };
    check(got == expected, ZONES, wants, has)
}
