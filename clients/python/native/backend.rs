//! What answers requests: a server, or worlds in this process.

use crate::errors::{no_memory, no_threads, raise, warn};
use crate::refusal::failed;
use clap::{Args, Command, FromArgMatches};
use emberwatch_protocol::connection::{Connection, ConnectionError};
use emberwatch_protocol::control::ServerInfo;
use emberwatch_protocol::limits::threads::spawn;
use emberwatch_protocol::message::{StepReply, StepRequest};
use emberwatch_server::config::{Checked, ServerConfig};
use emberwatch_server::embedded::{Embedded, wait_for};
use emberwatch_server::flags::ServerFlags;
use pyo3::prelude::*;
use std::ffi::OsString;
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

/// How long it may take to read settings and their files.
const LONGEST_READ: Duration = Duration::from_secs(20);

pub enum Backend {
    Server(Box<Connection>),
    Embedded(Box<Embedded>),
}

impl Backend {
    pub fn info(&self) -> ServerInfo {
        match self {
            Self::Server(wire) => wire.info().clone(),
            Self::Embedded(worlds) => worlds.info(),
        }
    }

    pub fn control_text(
        &mut self,
        text: &[u8],
        timeout: Duration,
    ) -> Result<Vec<u8>, ConnectionError> {
        match self {
            Self::Server(wire) => wire.control_text(text, timeout),
            Self::Embedded(worlds) => worlds.control_text(text, timeout),
        }
    }

    pub fn step_payload(
        &mut self,
        request: StepRequest,
        body: &[u8],
        timeout: Duration,
    ) -> Result<(StepReply, Vec<u8>), ConnectionError> {
        match self {
            Self::Server(wire) => wire.step_payload(request, body, timeout),
            Self::Embedded(worlds) => worlds.step_payload(request, body),
        }
    }
}

/// Worlds in this process, with the flags of `emberwatch-server`.
pub fn embedded(py: Python<'_>, flags: Vec<OsString>) -> PyResult<Embedded> {
    let checked = checked(py, flags)?;
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

/// The settings that a server with these flags would have, as TOML.
#[pyfunction]
pub fn check_settings(py: Python<'_>, flags: Vec<OsString>) -> PyResult<String> {
    let settings = checked(py, flags)?.config;
    Ok(toml::to_string(&settings).expect("invariant: settings serialise"))
}

/// Reads files on a thread of its own: one may be a pipe.
fn checked(py: Python<'_>, flags: Vec<OsString>) -> PyResult<Checked> {
    let (sender, receiver) = channel();
    let read = move || {
        let command = Command::new("emberwatch-server").no_binary_name(true);
        let matches = ServerFlags::augment_args(command).try_get_matches_from(flags)?;
        let settings = ServerFlags::from_arg_matches(&matches)?.effective();
        Ok::<_, clap::Error>(settings.and_then(ServerConfig::check))
    };
    let reader = spawn("settings", move || drop(sender.send(read())));
    reader.map_err(|short| no_threads(py, &short))?;
    let wait = move || wait_for(&receiver, Instant::now(), LONGEST_READ);
    let checked = py.detach(wait);
    match checked.map_err(|error| raise(py, error, "settings", LONGEST_READ.as_secs_f64()))? {
        Ok(Ok(checked)) => {
            for closed_in in &checked.reach.closed_in {
                warn(py, closed_in)?;
            }
            Ok(checked)
        }
        Ok(Err(problem)) => Err(refused(py, &problem.to_string())),
        Err(problem) => Err(refused(py, &problem.to_string())),
    }
}

/// Refuses settings that only a server can have.
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
    let (given, usual) = (of_servers(settings), of_servers(&ServerConfig::default()));
    let wrong = given
        .into_iter()
        .zip(usual)
        .find(|(one, other)| one != other);
    wrong.map_or(Ok(()), |((setting, got), _)| {
        let expected = "expected none, as embedded worlds have no server";
        Err(refused(py, &format!("{setting}: {expected}, got {got}")))
    })
}

fn refused(py: Python<'_>, problem: &str) -> PyErr {
    // Without the hint at flags of commands.
    let problem = problem.split("\n\nFor more information").next();
    let problem = problem.unwrap_or_default().trim_start_matches("error: ");
    crate::errors::error(py, "InvalidArgumentError", (problem.trim(),))
}
