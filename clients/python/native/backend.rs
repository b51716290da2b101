//! The worlds behind a connection: either a server's worlds, or worlds in this process.

use crate::errors::{no_memory, no_threads, raise, warn};
use crate::model::shape_of;
use crate::refusal::{failed, refused};
use crate::wire::Connection;
use emberwatch_messages::backend::Backend;
use emberwatch_messages::limits::threads::spawn;
use emberwatch_model::Model;
use emberwatch_model::hazards::Hazards;
use emberwatch_model::settings::{SettingError, Settings as _};
use emberwatch_sim::config::{Checked, ServerConfig, model_named};
use emberwatch_sim::embedded::{Embedded, wait_for};
use emberwatch_sim::snapshot::Settings;
use pyo3::prelude::*;
use serde_json::{Map, Value};
use std::ops::Range;
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

/// Maximum time to read settings and the files that they name.
const LONGEST_READ: Duration = Duration::from_secs(20);

pub enum Worlds {
    Served(Box<Connection>),
    Embedded(Box<Embedded>),
}

impl Worlds {
    pub fn backend(&mut self) -> &mut dyn Backend {
        match self {
            Self::Served(connection) => &mut **connection,
            Self::Embedded(worlds) => &mut **worlds,
        }
    }
}

/// Milliseconds without use after which a lease on worlds in this process expires, unless a setting decides it: a day,
/// because no other client waits for their robots.
const LEASE_MILLIS: u64 = 86_400_000;

/// Settings of worlds in this process, with the files that they name, which are read only here.
#[pyclass(frozen, module = "emberwatch._native")]
pub struct CheckedSettings {
    /// The given settings as JSON.
    given: String,
    checked: Checked,
}

/// Name, moves, robots, steps, first and end of the test seeds, and prefix and version of the environments' ids.
type TaskFields<'a> = (&'a str, usize, u32, u64, u64, u64, &'a str, u32);

/// A call that makes a copy: the function and its arguments.
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

    /// Returns the same settings with another number of worlds.
    fn with_worlds(&self, py: Python<'_>, worlds: u32) -> PyResult<Self> {
        let checked = self.checked.clone().with_worlds(worlds);
        Ok(Self {
            given: self.given.clone(),
            checked: checked.map_err(|problem| refused(py, problem))?,
        })
    }

    /// The answer to `hello` of a server with these settings, as JSON.
    #[getter]
    fn info(&self) -> String {
        serde_json::to_string(&self.checked.info()).expect("invariant: replies serialise")
    }

    /// `None` if the settings have no task.
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
    ///
    /// # Errors
    /// If a setting applies only to a server, or there is too little memory.
    pub fn embed(&self, py: Python<'_>, seed: Option<u64>) -> PyResult<Embedded> {
        let mut checked = self.checked.clone();
        checked.config.seed = seed.unwrap_or(checked.config.seed);
        check_embeddable(py, &checked.config)?;
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
        let paths: Vec<String> = asked
            .values()
            .filter_map(Value::as_str)
            .map(Into::into)
            .collect();
        let read = move || {
            let settings = ServerConfig {
                lease_millis: LEASE_MILLIS,
                ..ServerConfig::default()
            };
            settings.with(&asked).and_then(ServerConfig::check)
        };
        let checked = in_time(py, &paths, read)?.map_err(|problem| refused(py, problem))?;
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
    let paths = [name.clone()];
    let model = in_time(py, &paths, move || model_named(&name))?;
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
    Ok(text_of(&model))
}

fn text_of(model: &Model) -> String {
    toml::to_string(model.file()).expect("invariant: a model was read from TOML")
}

/// Runs `read`. If one of the paths is a pipe, device or other special file, a separate thread runs it, so that the wait
/// can time out or be interrupted.
fn in_time<T: Send + 'static>(
    py: Python<'_>,
    paths: &[String],
    read: impl FnOnce() -> T + Send + 'static,
) -> PyResult<T> {
    if !paths.iter().any(may_block) {
        return Ok(py.detach(read));
    }
    let (sender, receiver) = channel();
    let reader = spawn("settings", move || drop(sender.send(read())));
    reader.map_err(|short| no_threads(py, &short))?;
    let read = py.detach(move || wait_for(&receiver, Instant::now(), LONGEST_READ));
    read.map_err(|error| raise(py, error, "settings", LONGEST_READ.as_secs_f64()))
}

/// Returns whether a path names a pipe, device or other special file, which can keep its reader waiting.
fn may_block(path: &String) -> bool {
    let found = std::fs::metadata(path);
    found.is_ok_and(|kind| !kind.is_file() && !kind.is_dir())
}

/// Refuses settings that apply only to a server.
fn check_embeddable(py: Python<'_>, settings: &ServerConfig) -> PyResult<()> {
    let values = settings.values();
    let settings = ServerConfig::settings().into_iter();
    for setting in settings.filter(|it| it.for_servers) {
        let got = &values[setting.name];
        if *got != (setting.default)() {
            let expected = "to be left out, as worlds in this process have no server";
            return Err(refused(
                py,
                SettingError::new(setting.name, expected, got.clone()),
            ));
        }
    }
    Ok(())
}
