//! Settings of worlds in this process, and the texts of models.

use crate::errors::{no_memory, no_threads, raise, warn};
use crate::model::shape_of;
use crate::records;
use crate::refusal::{failed, refused};
use emberwatch_model::Model;
use emberwatch_model::hazards::Hazards;
use emberwatch_sim::config::{Checked, model_named};
use emberwatch_sim::embedded::Embedded;
use emberwatch_sim::embedded::settings::{self, LONGEST_READ, ReadError};
use emberwatch_sim::snapshot::Settings;
use pyo3::prelude::*;
use serde_json::{Map, Value};
use std::ops::Range;

/// Settings of worlds in this process, with the files that they name, which are read only here.
#[pyclass(frozen, module = "emberwatch._native")]
pub struct CheckedSettings {
    given: String,
    checked: Checked,
}

type TaskFields<'a> = (&'a str, usize, u32, u64, u64, u64, &'a str, u32);

type Copying<'a, 'py> = (Bound<'py, PyAny>, (&'a str, u32, String));

#[pymethods]
impl CheckedSettings {
    /// Reads and checks settings, given as JSON with the keys of `config/server.toml`. Warns about robots whose start
    /// cells are enclosed by no-fly cells.
    #[new]
    fn new(py: Python<'_>, settings: &str) -> PyResult<Self> {
        let it = Self::read(py, settings)?;
        let mut starts = it.checked.reach.closed_in.iter();
        starts.try_for_each(|closed_in| warn(py, closed_in))?;
        Ok(it)
    }

    fn with_worlds(&self, py: Python<'_>, worlds: u32) -> PyResult<Self> {
        let checked = self.checked.clone().with_worlds(worlds);
        Ok(Self {
            given: self.given.clone(),
            checked: checked.map_err(|problem| refused(py, problem))?,
        })
    }

    #[getter]
    fn info<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        records::server_info(py, &self.checked.info())
    }

    #[getter]
    fn task(&self) -> Option<TaskFields<'_>> {
        let task = self.checked.task.as_ref()?;
        let listing = task.listing.as_ref();
        let (ids, version) = listing.map_or(("", 0), |it| (&it.ids, it.version));
        let Range { start, end } = task.test_seeds;
        let world = &task.world;
        let (moves, robots, steps) = (world.moves, world.robots, world.max_steps);
        Some((&task.name, moves, robots, steps, start, end, ids, version))
    }

    #[getter]
    fn worlds_fingerprint(&self) -> String {
        Settings::of(&self.checked).worlds_fingerprint()
    }

    fn __deepcopy__<'py>(slf: Bound<'py, Self>, _memo: &Bound<'py, PyAny>) -> Bound<'py, Self> {
        slf
    }

    fn __reduce__<'py>(&self, py: Python<'py>) -> PyResult<Copying<'_, 'py>> {
        let again = py.import("emberwatch._native")?.getattr("read_again")?;
        let worlds = self.checked.config.worlds;
        Ok((again, (&self.given, worlds, self.worlds_fingerprint())))
    }
}

impl CheckedSettings {
    /// Starts the worlds in this process. `seed` is the first world's; `None`: the seed in the settings.
    pub fn embed(&self, py: Python<'_>, seed: Option<u64>) -> PyResult<Embedded> {
        let mut checked = self.checked.clone();
        checked.config.seed = seed.unwrap_or(checked.config.seed);
        let worlds = py.detach(|| Embedded::new(checked));
        worlds.map_err(|error| match error.downcast_ref() {
            Some(short) => no_memory(py, short),
            None => match error.downcast_ref() {
                Some(short) => no_threads(py, short),
                None => failed(py, &format!("{error:#}"), "embedded"),
            },
        })
    }

    fn read(py: Python<'_>, settings: &str) -> PyResult<Self> {
        let asked: Map<String, Value> =
            serde_json::from_str(settings).map_err(|error| refused(py, error))?;
        let checked = py.detach(|| settings::read(asked));
        let checked = checked.map_err(|problem| unread(py, problem))?;
        let given = settings.into();
        Ok(Self { given, checked })
    }
}

/// Reads settings again for a copy in another process. Refuses files that have changed since `fingerprint` was made.
#[pyfunction]
pub fn read_again(
    py: Python<'_>,
    settings: &str,
    worlds: u32,
    fingerprint: &str,
) -> PyResult<CheckedSettings> {
    let read = CheckedSettings::read(py, settings)?.with_worlds(py, worlds)?;
    if read.worlds_fingerprint() == fingerprint {
        return Ok(read);
    }
    let problem = "worlds: the file of their task, model or states has changed since they were made: make them again";
    Err(refused(py, problem))
}

/// Returns the text of a model: of the built-in one with this name, of the file at this path with the maps from other
/// files included, or of `name` itself if it is the text of a file.
#[pyfunction]
pub fn model_text(py: Python<'_>, name: String) -> PyResult<String> {
    if let Some((_, text)) = Model::built_in_files().find(|(known, _)| *known == name) {
        return Ok(text.into());
    }
    let may_block = settings::may_block(&name);
    let model = py.detach(|| settings::in_time(may_block, move || model_named(&name)));
    let model = model.map_err(|problem| unread(py, problem))?;
    let model = model.map_err(|problem| refused(py, problem))?;
    let no_fly = model.file().no_fly.as_ref().and_then(|map| map.grid().ok());
    let shape = match model.hazards().and_then(Hazards::shape) {
        Some(shape) => shape,
        None => {
            let (height, width) = no_fly.map_or((64, 64), |map| map.dim());
            shape_of(py, height, width)?
        }
    };
    model
        .check_on(shape)
        .map_err(|problem| refused(py, problem))?;
    Ok(toml::to_string(model.file()).expect("invariant: a model was read from TOML"))
}

fn unread(py: Python<'_>, problem: ReadError) -> PyErr {
    match problem {
        ReadError::Config(problem) => refused(py, problem),
        ReadError::Threads(short) => no_threads(py, &short),
        ReadError::Wait(error) => raise(py, error, "settings", LONGEST_READ.as_secs_f64()),
    }
}
