//! The settings in a checkpoint.

use crate::config::AgentConfig;
use crate::learning::checkpoint::{Contents, Problem};

/// The settings that a checkpoint was trained with.
///
/// # Errors
/// [`Problem`] for none, or others than an agent's.
pub fn settings(contents: &Contents) -> Result<AgentConfig, Problem> {
    const SETTINGS: &str = "settings";
    let text = contents.texts.get(SETTINGS);
    let text = text.ok_or_else(|| Problem::Missing(SETTINGS.into()))?;
    let wrong = |got: String| Problem::Value {
        name: SETTINGS.into(),
        expected: "those of an agent".into(),
        got,
    };
    let config: AgentConfig = toml::from_str(text).map_err(|error| wrong(error.to_string()))?;
    config.check().map_err(|error| wrong(error.to_string()))
}
