//! Everything that the page can show. Some threads fill the scene, and the web server reads it to answer browsers.

use crate::album::Album;
use crate::entry::States;
use emberwatch_protocol::control::{CoverageRule, ServerInfo, ServerStatus};
use emberwatch_protocol::model::{Description, Hazards};
use emberwatch_protocol::{Airspace, Grid, Model};
use ndarray::{ArrayD, Axis, Ix4, s};
use serde::Serialize;
use std::sync::{Mutex, MutexGuard, PoisonError};
use tokio::sync::watch;

#[derive(Debug)]
pub struct Scene {
    pub album: Album,
    /// The instance's name, or the recording's file.
    pub instance: String,
    /// Whether a server answers. Always true for a recording.
    pub is_serving: bool,
    /// Why the server's status cannot be requested, in one sentence for people.
    pub note: Option<String>,
    /// Why some of the server's channels cannot be read.
    pub trouble: Option<String>,
    pub info: Option<Info>,
    pub status: Option<ServerStatus>,
    pub lost: Lost,
    pub player: Option<Player>,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Lost {
    pub frames: u64,
    pub truth: u64,
    pub agent: u64,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Player {
    pub file: String,
    /// Time since the beginning of the recording, in seconds.
    pub seconds: f64,
    /// Speed relative to the recording's own; 0 for as fast as possible.
    pub speed: f64,
    pub playing: bool,
    /// Whether the end was reached. Playing then starts from the beginning.
    pub ended: bool,
    pub error: Option<String>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Info {
    pid: u32,
    height: usize,
    width: usize,
    n_moves: usize,
    n_worlds: u32,
    task: Option<String>,
    model: Option<String>,
    states: Option<Vec<String>>,
    state_colours: Option<Vec<String>>,
    target_state: Option<usize>,
    observations: Vec<String>,
    observation_colours: Option<Vec<String>>,
    /// Number of rows and columns that robots see beyond their path.
    radius: usize,
    maps: Vec<MapInfo>,
    /// For each map, a level of 0 to 255 for each cell, from its smallest to its largest factor.
    #[serde(skip)]
    pub levels: Vec<Grid<u8>>,
    /// Where robots may fly; `None` if the server's description of it is invalid.
    #[serde(skip)]
    pub airspace: Option<Airspace>,
    burn_in: u64,
    max_steps: u64,
    coverage: CoverageRule,
    publish_truth: bool,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MapInfo {
    name: String,
    range: [f32; 2],
}

impl MapInfo {
    /// Describes a map, and returns its levels. A map with factors for each place of a neighbour is averaged over the
    /// places other than the centre.
    fn of((name, map): (&String, &ArrayD<f32>)) -> (Self, Grid<u8>) {
        let of_cells = match map.view().into_dimensionality::<Ix4>() {
            Ok(of_neighbours) => {
                let (height, width, ..) = of_neighbours.dim();
                let all = of_neighbours.sum_axis(Axis(0)).sum_axis(Axis(0));
                let centre = of_neighbours.slice(s![height / 2, width / 2, .., ..]);
                (all - centre) / (height * width - 1).max(1) as f32
            }
            Err(_) => map
                .clone()
                .into_dimensionality()
                .expect("invariant: two or four axes"),
        };
        let least = of_cells.fold(f32::MAX, |least, factor| factor.min(least));
        let most = of_cells.fold(0.0_f32, |most, factor| factor.max(most));
        let scale = 255.0 / (most - least).max(f32::MIN_POSITIVE);
        let levels = of_cells.mapv(|factor| ((factor - least) * scale) as u8);
        let range = [least, most];
        (
            Self {
                name: name.clone(),
                range,
            },
            levels,
        )
    }
}

#[derive(Debug)]
pub struct Stage {
    scene: Mutex<Scene>,
    changes: watch::Sender<u64>,
}

impl Scene {
    pub fn new(instance: &str) -> Self {
        Self {
            album: Album::default(),
            instance: instance.into(),
            is_serving: false,
            note: None,
            trouble: None,
            info: None,
            status: None,
            lost: Lost::default(),
            player: None,
        }
    }

    pub fn states(&self) -> Option<States> {
        let info = self.info.as_ref()?;
        Some(States {
            names: info.states.clone()?,
            target: info.target_state?,
        })
    }
}

impl Info {
    /// Reads a server's description. If the server reveals its model or a description of its recorded worlds, also
    /// reads that. Treats an invalid model or description as hidden.
    pub fn new(info: &ServerInfo) -> Self {
        let recorded = info.recorded_world.as_ref();
        let description = recorded.and_then(|recorded| recorded.description.as_deref());
        let model = match info.model.as_deref() {
            Some(model) => Some(Model::from_toml(model)),
            None => description.map(Description::model_of),
        };
        let model = model.and_then(Result::ok);
        let file = model.as_ref().map(Model::file);
        let names = |of: fn(&emberwatch_protocol::model::StateEntry) -> &String| {
            file.map(|file| file.states.iter().map(of).cloned().collect())
        };
        let airspace = info.airspace().ok();
        let maps = model.as_ref().and_then(Model::hazards).map(Hazards::maps);
        let (maps, levels) = maps.into_iter().flatten().map(MapInfo::of).unzip();
        let colours = file.map(|file| file.observations.iter().map(|one| one.color.clone()));
        Self {
            pid: info.pid,
            height: info.height,
            width: info.width,
            n_moves: info.n_moves,
            n_worlds: info.n_worlds,
            task: info.task.clone(),
            model: model.as_ref().map(|model| model.name().to_owned()),
            states: names(|state| &state.name),
            state_colours: names(|state| &state.color),
            target_state: model.as_ref().map(Model::target_state),
            observations: info.observations.clone(),
            observation_colours: colours.map(Iterator::collect),
            radius: airspace.as_ref().map_or(0, Airspace::radius),
            maps,
            levels,
            airspace,
            burn_in: info.burn_in,
            max_steps: info.max_steps,
            coverage: info.coverage,
            publish_truth: info.publish_truth,
        }
    }
}

impl Stage {
    pub fn new(scene: Scene) -> Self {
        Self {
            scene: Mutex::new(scene),
            changes: watch::Sender::new(0),
        }
    }

    pub fn look(&self) -> MutexGuard<'_, Scene> {
        // A panic during a change can at worst leave wrong counts or pictures, and nothing relies on these.
        self.scene.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn change<T>(&self, act: impl FnOnce(&mut Scene) -> T) -> T {
        let done = act(&mut self.look());
        self.changes.send_modify(|n| *n += 1);
        done
    }

    pub fn changes(&self) -> watch::Receiver<u64> {
        self.changes.subscribe()
    }
}
