//! Models, tasks and recorded states that ship: each file of `config/models` and `config/tasks`, each folder of
//! `config/landscapes`, by its name. `build.rs` lists them.

/// Models: the text of the file.
pub(crate) static MODELS: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/models.rs"));

/// Tasks: the text of the file.
pub(crate) static TASKS: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/tasks.rs"));

/// Recorded states: the archive of sequences, and the description.
pub static STATES: &[(&str, &[u8], &str)] = include!(concat!(env!("OUT_DIR"), "/states.rs"));

/// The names of the recorded states.
pub fn state_names() -> impl Iterator<Item = &'static str> {
    STATES.iter().map(|(name, ..)| *name)
}

/// Names as errors and `--help` list them: `wildfire, small`.
pub fn listed(names: impl Iterator<Item = &'static str>) -> String {
    names.collect::<Vec<_>>().join(", ")
}
