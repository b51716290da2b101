//! The models, tasks and recorded states that ship with the programs. Each is named after its file in `config/models`
//! or `config/tasks`, or its folder in `config/landscapes`. `build.rs` lists them.

/// Built-in models, as `(name, text of the file)`.
pub(crate) static MODELS: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/models.rs"));

pub(crate) static TASKS: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/tasks.rs"));

/// Built-in recorded states, as `(name, archive of sequences, text of the description)`.
pub static STATES: &[(&str, &[u8], &str)] = include!(concat!(env!("OUT_DIR"), "/states.rs"));

pub fn state_names() -> impl Iterator<Item = &'static str> {
    STATES.iter().map(|(name, ..)| *name)
}

/// Joins names with commas, for errors and `--help`: `wildfire, small`.
pub fn listed(names: impl Iterator<Item = &'static str>) -> String {
    names.collect::<Vec<_>>().join(", ")
}
