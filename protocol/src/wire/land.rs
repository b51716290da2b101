//! What the answer to `hello` says of airspace and land.

use crate::model::grid::{Grid, Shape};
use crate::model::{Airspace, MAX_RADIUS, Pays, parse_color};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Where robots may fly and what they see.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct AirspaceInfo {
    /// Rows and columns that robots see beyond each cell of their path, 0 to 8.
    pub radius: usize,
    /// Observation matrices: of the path, then of each ring around it; the last holds for the rings beyond. An
    /// observation of matrix m has the number `m * n_observations / n_rings` plus that which it would have on the path.
    pub n_rings: usize,
    /// Which distinct cells pay.
    pub pays: Pays,
    /// 1 for each cell where no robot may be, row by row.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub no_fly: Option<Vec<Vec<u8>>>,
}

/// Zones of land, which differ in how states change.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ZonesInfo {
    /// The name of each zone.
    pub names: Vec<String>,
    /// Its colour in pictures, `#rrggbb`.
    pub colors: Vec<String>,
    /// The zone of each cell, row by row.
    pub map: Vec<Vec<u8>>,
}

impl AirspaceInfo {
    /// Where robots of a grid may fly and what they see.
    ///
    /// # Errors
    /// If that is not of the grid, or out of range; the error says what was expected.
    pub fn airspace(&self, shape: Shape) -> Result<Airspace, String> {
        let (radius, n_rings) = (self.radius, self.n_rings);
        if radius > MAX_RADIUS || !(1..=radius + 1).contains(&n_rings) {
            let expected = format!("a radius up to {MAX_RADIUS} and 1 to radius + 1 rings");
            return Err(format!(
                "airspace: expected {expected}, got {radius} and {n_rings}"
            ));
        }
        let no_fly = self.no_fly.as_ref();
        let no_fly = no_fly
            .map(|rows| of_grid("no_fly", shape, rows))
            .transpose()?;
        let no_fly = no_fly.map(|map| Arc::new(map.mapv(|flag| flag != 0)));
        Ok(Airspace::new(shape, no_fly, radius, n_rings, self.pays))
    }
}

impl ZonesInfo {
    /// The zone of each cell of a grid, shape `[H, W]`.
    ///
    /// # Errors
    /// If that is not of the grid, or a zone has no name; the error says what was expected.
    pub fn zone_map(&self, shape: Shape) -> Result<Grid<u8>, String> {
        let map = of_grid("zones", shape, &self.map)?;
        let n_zones = self.names.len();
        let is_color = |color: &String| parse_color(color).is_some();
        if self.colors.len() != n_zones || !self.colors.iter().all(is_color) {
            let got = &self.colors;
            return Err(format!(
                "zones: expected {n_zones} colours #rrggbb, got {got:?}"
            ));
        }
        match map.iter().find(|&&zone| usize::from(zone) >= n_zones) {
            None => Ok(map),
            Some(got) => Err(format!("zones: expected values below {n_zones}, got {got}")),
        }
    }
}

/// The numbers of a map, if it is of a grid.
fn of_grid(what: &str, shape: Shape, rows: &[Vec<u8>]) -> Result<Grid<u8>, String> {
    let fits = rows.len() == shape.height() && rows.iter().all(|row| row.len() == shape.width());
    if !fits {
        let got = format!("{} x {:?}", rows.len(), rows.first().map(Vec::len));
        return Err(format!(
            "{what}: expected a map of the {shape} grid, got {got}"
        ));
    }
    let map = Grid::from_shape_vec(shape.dim(), rows.concat());
    Ok(map.expect("invariant: as many numbers as cells"))
}
