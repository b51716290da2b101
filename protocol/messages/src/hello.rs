//! The answer to `hello`: a server's settings and airspace.

use emberwatch_model::grid::{Grid, Shape, ShapeError};
use emberwatch_model::{Airspace, Description, MAX_RADIUS, Model};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The settings of a server: everything that a client needs to know to fly robots.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ServerInfo {
    pub protocol: u32,
    pub build: String,
    pub pid: u32,
    /// The number of the PID namespace to which `pid` belongs, on Linux. A client can watch the process only from
    /// within this namespace.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pid_namespace: Option<u64>,
    pub height: usize,
    pub width: usize,
    pub n_moves: usize,
    pub n_worlds: u32,
    /// Number of robots R of each world.
    pub n_robots: u32,
    /// Number of observations O. The values in frames are below O, or 255 for unobserved cells.
    pub n_observations: usize,
    pub observations: Vec<String>,
    /// The model as TOML, if there is one and the server reveals it.
    pub model: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task: Option<String>,
    /// Identifies the worlds: 16 hexadecimal digits of a hash over every setting that affects rewards, except the seed
    /// and the policy. Servers before release 0.3 do not send it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub worlds_fingerprint: Option<String>,
    /// Where robots may fly and what they see. If absent, robots may fly everywhere and see only the cells of their
    /// path.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub airspace: Option<AirspaceInfo>,
    /// The recorded sequences, if the hidden states were recorded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recorded_world: Option<RecordedWorld>,
    /// Number of steps simulated from the initial distribution before k = 0.
    pub burn_in: u64,
    /// 0 if episodes are never truncated.
    pub max_steps: u64,
    pub max_clients: usize,
    pub coverage: CoverageRule,
    /// Whether the `truth` channel exists.
    pub publish_truth: bool,
    /// Default time from the last use of a lease until it ends.
    pub lease_millis: u64,
    /// Time that a world waits, after it has received the first path, for the paths of its other held robots; 0 for no
    /// deadline.
    pub deadline_millis: u64,
}

impl ServerInfo {
    /// Returns the height and width of the grid.
    ///
    /// # Errors
    /// If a side is outside `1..=MAX_SIDE`.
    pub fn shape(&self) -> Result<Shape, ShapeError> {
        Shape::new(self.height, self.width)
    }

    /// Returns where robots may fly and what they see.
    ///
    /// # Errors
    /// If the map does not fit the grid, or a number is out of range. The error contains the expected value.
    pub fn airspace(&self) -> Result<Airspace, String> {
        let shape = self.shape().map_err(|error| error.to_string())?;
        match &self.airspace {
            Some(info) => info.airspace(shape),
            None => Ok(Airspace::open(shape)),
        }
    }

    /// Returns the model, or the model of a recorded world's description, if the server reveals a valid one.
    pub fn revealed_model(&self) -> Option<Model> {
        let model = match &self.recorded_world {
            Some(recorded) => Description::model_of(recorded.description.as_deref()?),
            None => Model::from_toml(self.model.as_deref()?),
        };
        model.ok()
    }

    /// Returns the number of steps of the shortest episode, or `None` if episodes are never truncated.
    pub fn shortest_episode(&self) -> Option<u64> {
        let recorded = self.recorded_world.as_ref().map(|it| it.n_steps);
        let truncated = Some(self.max_steps).filter(|&steps| steps > 0);
        recorded.into_iter().chain(truncated).min()
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecordedWorld {
    /// The description of its states as TOML, if the server reveals it.
    pub description: Option<String>,
    pub n_sequences: usize,
    /// Number of steps of the shortest episode.
    pub n_steps: u64,
}

/// The rule that decides which cells a server's steps observe.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum CoverageRule {
    /// The cells on the path.
    Path,
    /// Every cell.
    Full,
    /// The cells on the path, or every cell if the request asks for it.
    Client,
}

/// Where robots may fly and what they see.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct AirspaceInfo {
    /// Number of rows and columns that robots see beyond each cell of their path, 0 to 8.
    pub radius: usize,
    /// No-fly map, row by row: 1 for each cell closed to robots.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub no_fly: Option<Vec<Vec<u8>>>,
}

impl AirspaceInfo {
    /// Returns where robots on a grid may fly and what they see.
    ///
    /// # Errors
    /// If the map does not fit the grid, or a number is out of range. The error contains the expected value.
    pub fn airspace(&self, shape: Shape) -> Result<Airspace, String> {
        let radius = self.radius;
        if radius > MAX_RADIUS {
            return Err(format!(
                "airspace: expected a radius up to {MAX_RADIUS}, got {radius}"
            ));
        }
        let no_fly = self
            .no_fly
            .as_ref()
            .map(|rows| of_grid("no_fly", shape, rows))
            .transpose()?;
        let no_fly = no_fly.map(|map| Arc::new(map.mapv(|flag| flag != 0)));
        Ok(Airspace::new(shape, no_fly, radius))
    }
}

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
