//! The names of policies under a model.

use crate::planning::action::ActionSet;
use protocol::Model;

/// The name that needs a checkpoint of decisions.
pub const OF_DECISIONS: [&str; 1] = ["dqn_beam"];

/// The names that need the checkpoint of a learned filter.
pub const OF_FILTER: [&str; 4] = [
    "learned_shooting",
    "learned_beam",
    "learned_spatial_shooting",
    "learned_spatial_beam",
];

/// The names that need the checkpoint of one whose kernels see the cell's own state.
pub const OF_OWN_FILTER: [&str; 4] = [
    "learned_own_shooting",
    "learned_own_beam",
    "learned_own_spatial_shooting",
    "learned_own_spatial_beam",
];

/// The names that need the checkpoint of an autoencoder.
pub const OF_AUTOENCODER: [&str; 4] = [
    "autoencoder_explore",
    "autoencoder_exploit",
    "autoencoder_policy",
    "autoencoder_beam",
];

/// The benchmark's, from the least to the most informed.
pub(super) fn ladder_names(model: &Model) -> Vec<String> {
    let others = model
        .file()
        .states
        .iter()
        .enumerate()
        .filter(|(state, _)| *state != model.target_state());
    let others = others.map(|(_, entry)| format!("shooting_{}", entry.name));
    let mut names: Vec<String> = ["random_walk", "coverage", "shooting_explore"]
        .map(String::from)
        .to_vec();
    names.extend(others);
    let rest = [
        "shooting_exploit",
        "shooting_exploit_only",
        "beam_exploit",
        "spatial_shooting",
        "spatial_beam",
        "oracle_shooting",
        "oracle_beam",
        "clairvoyant_beam",
    ];
    names.extend(rest.map(String::from));
    names
}

/// Those that each model has, and patterns of those that it may have.
pub(super) fn names_of_any_model() -> Vec<String> {
    let model = Model::wildfire();
    let is_of_state = |name: &String| {
        let (_, rest) = name.split_once('_').unwrap_or_default();
        model.state_named(rest).is_some()
    };
    let mut names = known_names(&model);
    names.retain(|name| !name.starts_with("act_") && !is_of_state(name));
    names.extend(["shooting_STATE", "beam_STATE", "act_ACTION"].map(String::from));
    names
}

/// Whether the name fits one of these patterns.
pub(super) fn is_of_model(name: &str) -> bool {
    let families = ["shooting_", "beam_", "act_"];
    let mut rests = families
        .iter()
        .filter_map(|family| name.strip_prefix(family));
    rests.any(|rest| !rest.is_empty())
}

pub(super) fn known_names(model: &Model) -> Vec<String> {
    let mut names = ladder_names(model);
    names.extend(["beam_explore", "beam_exploit_only", "clairvoyant_shooting"].map(String::from));
    names.extend(OF_FILTER.map(String::from));
    names.extend(OF_OWN_FILTER.map(String::from));
    names.extend(OF_DECISIONS.map(String::from));
    names.extend(
        ActionSet::beam(model)
            .names()
            .iter()
            .map(|name| format!("act_{name}")),
    );
    names.extend(OF_AUTOENCODER.map(String::from));
    let states = model.state_names();
    let target = &states[model.target_state()];
    names.push(format!("shooting_{target}"));
    names.extend(states.iter().map(|state| format!("beam_{state}")));
    names
}
