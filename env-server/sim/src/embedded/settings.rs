//! Reading the settings of worlds in this process. Files that could block their reader are read in a thread, so that
//! the wait can time out or be interrupted.

use super::wait::wait_for;
use crate::config::{Checked, ConfigError, ServerConfig};
use emberwatch_messages::errors::ConnectionError;
use emberwatch_messages::limits::threads::{NoThreads, spawn};
use emberwatch_model::settings::{SettingError, Settings as _};
use serde_json::{Map, Value};
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};
use thiserror::Error;

pub const LONGEST_READ: Duration = Duration::from_secs(20);

/// Milliseconds without use after which a lease on worlds in this process expires, unless a setting decides it: a day,
/// because no other client waits for their robots.
const LEASE_MILLIS: u64 = 86_400_000;

#[derive(Debug, Error)]
pub enum ReadError {
    #[error(transparent)]
    Config(#[from] ConfigError),
    #[error(transparent)]
    Threads(#[from] NoThreads),
    #[error(transparent)]
    Wait(#[from] ConnectionError),
}

/// Reads and checks settings of worlds in this process. `given` has keys of `config/server.toml`.
///
/// # Errors
/// If a setting is unknown, invalid or only for servers, or a file cannot be read within [`LONGEST_READ`].
pub fn read(given: Map<String, Value>) -> Result<Checked, ReadError> {
    let texts = given.values().filter_map(Value::as_str);
    let may_block = texts.map(String::from).any(|path| may_block(&path));
    let read = move || {
        let defaults = ServerConfig {
            lease_millis: LEASE_MILLIS,
            ..ServerConfig::default()
        };
        let config = defaults.with(&given)?;
        check_embeddable(&config)?;
        config.check()
    };
    Ok(in_time(may_block, read)??)
}

/// Returns whether a path names a pipe, device or other special file, which can keep its reader waiting.
pub fn may_block(path: &str) -> bool {
    let found = std::fs::metadata(path);
    found.is_ok_and(|kind| !kind.is_file() && !kind.is_dir())
}

pub fn in_time<T: Send + 'static>(
    may_block: bool,
    read: impl FnOnce() -> T + Send + 'static,
) -> Result<T, ReadError> {
    if !may_block {
        return Ok(read());
    }
    let (sender, receiver) = channel();
    spawn("settings", move || drop(sender.send(read())))?;
    Ok(wait_for(&receiver, Instant::now(), LONGEST_READ)?)
}

fn check_embeddable(settings: &ServerConfig) -> Result<(), SettingError> {
    let values = settings.values();
    let for_servers = ServerConfig::settings();
    let for_servers = for_servers.into_iter().filter(|it| it.for_servers);
    for setting in for_servers {
        let got = &values[setting.name];
        if *got != (setting.default)() {
            let expected = "to be left out, as worlds in this process have no server";
            return Err(SettingError::new(setting.name, expected, got.clone()));
        }
    }
    Ok(())
}
