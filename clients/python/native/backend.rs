//! The worlds behind a connection: either a server's worlds, or worlds in this process.

use crate::errors::{no_memory, no_threads, raise, warn};
use crate::refusal::failed;
use crate::wire::Connection;
use emberwatch_messages::backend::Backend;
use emberwatch_messages::limits::threads::spawn;
use emberwatch_sim::config::{Checked, ServerConfig};
use emberwatch_sim::embedded::{Embedded, wait_for};
use emberwatch_sim::snapshot::Settings;
use pyo3::prelude::*;
use serde_json::{Map, Value};
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

/// Starts worlds in this process. `settings` is JSON with the keys of `config/server.toml`. If `warns` is set, warns
/// about robots whose start cells are enclosed by no-fly cells.
pub fn embedded(py: Python<'_>, settings: &str, warns: bool) -> PyResult<Embedded> {
    let checked = checked(py, settings)?;
    if warns {
        warn_of_starts(py, &checked)?;
    }
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

/// Checks settings, given as JSON. Returns them as JSON with every default filled in.
#[pyfunction]
pub fn check_settings(py: Python<'_>, settings: &str) -> PyResult<String> {
    let checked = checked(py, settings)?;
    warn_of_starts(py, &checked)?;
    let settings = checked.config;
    Ok(serde_json::to_string(&settings).expect("invariant: settings serialise"))
}

/// Returns the fingerprint of the worlds with these settings, without simulating them.
#[pyfunction]
pub fn worlds_fingerprint(py: Python<'_>, settings: &str) -> PyResult<String> {
    Ok(Settings::of(&checked(py, settings)?).worlds_fingerprint())
}

/// Reads settings and the files that they name. A separate thread reads pipes, devices and other special files, so that
/// waiting for them can time out or be interrupted.
fn checked(py: Python<'_>, settings: &str) -> PyResult<Checked> {
    let given: Map<String, Value> =
        serde_json::from_str(settings).map_err(|error| refused(py, &error.to_string()))?;
    let may_block = may_block(&given);
    let read = move || {
        let settings = ServerConfig::default().with(&given);
        settings.and_then(ServerConfig::check)
    };
    let checked = if may_block {
        let (sender, receiver) = channel();
        let reader = spawn("settings", move || drop(sender.send(read())));
        reader.map_err(|short| no_threads(py, &short))?;
        let wait = move || wait_for(&receiver, Instant::now(), LONGEST_READ);
        let checked = py.detach(wait);
        checked.map_err(|error| raise(py, error, "settings", LONGEST_READ.as_secs_f64()))?
    } else {
        py.detach(read)
    };
    checked.map_err(|problem| refused(py, &problem.to_string()))
}

/// Returns whether a setting names a pipe, device or other special file, which can keep its reader waiting.
fn may_block(given: &Map<String, Value>) -> bool {
    let paths = given.values().filter_map(Value::as_str);
    let kinds = paths.filter_map(|path| std::fs::metadata(path).ok());
    let mut others = kinds.filter(|kind| !kind.is_file() && !kind.is_dir());
    others.next().is_some()
}

/// Warns about robots whose start cells are enclosed by no-fly cells.
fn warn_of_starts(py: Python<'_>, checked: &Checked) -> PyResult<()> {
    let mut starts = checked.reach.closed_in.iter();
    starts.try_for_each(|closed_in| warn(py, closed_in))
}

/// Refuses settings that apply only to a server.
fn check_embeddable(py: Python<'_>, settings: &ServerConfig) -> PyResult<()> {
    let of_servers = |settings: &ServerConfig| {
        [
            ("instance", settings.instance.clone()),
            ("deadline_millis", settings.deadline_millis.to_string()),
            ("restore", settings.restore.clone()),
            ("snapshot_every", settings.snapshot_every.to_string()),
            ("snapshot_dir", settings.snapshot_dir.clone()),
            ("snapshot_keep", settings.snapshot_keep.to_string()),
        ]
    };
    let (given, defaults) = (of_servers(settings), of_servers(&ServerConfig::default()));
    let wrong = given
        .into_iter()
        .zip(defaults)
        .find(|(one, other)| one != other);
    wrong.map_or(Ok(()), |((setting, got), _)| {
        let expected = "expected to be left out, as worlds in this process have no server";
        Err(refused(py, &format!("{setting}: {expected}, got {got}")))
    })
}

fn refused(py: Python<'_>, problem: &str) -> PyErr {
    crate::errors::error(py, "InvalidArgumentError", (problem.trim(),))
}
