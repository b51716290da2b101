//! The server's settings as flags.

use clap::Args;
use emberwatch_protocol::program::Flags;
use emberwatch_sim::config::{ConfigError, ServerConfig};
use std::path::PathBuf;

/// Where settings come from: flags override the file, and the file overrides the defaults.
#[derive(Debug, Args)]
pub struct ServerFlags {
    /// Read settings from this TOML file
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    #[command(flatten)]
    pub settings: Flags<ServerConfig>,
}

impl ServerFlags {
    /// Returns the effective settings: defaults, overridden by the file, overridden by flags.
    pub fn effective(&self) -> Result<ServerConfig, ConfigError> {
        let config = match &self.config {
            None => ServerConfig::default(),
            Some(path) => ServerConfig::read(path)?,
        };
        config.with(self.settings.given())
    }
}
