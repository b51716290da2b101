//! Learners: agents that learn while they act. The command `train` runs them. They perform no I/O: they receive frames
//! and return paths.
//!
//! Each kind of learner is a constant in its own file, and has an entry in [`LEARNERS`].

mod base;
pub mod decisions;
pub mod filter;
pub mod network;
pub mod neural;
#[cfg(test)]
pub(crate) mod tests;
mod update;

pub use self::base::{Learner, LearnerInputs, LearnerKind, Worlds};
pub use self::update::ModelUpdate;

use crate::checkpoint::{self, Contents};
use anyhow::{Context, Result, ensure};
use emberwatch_acting::learned::Learned;
use emberwatch_model::built_in::listed;
use emberwatch_model::text::shortened;
use emberwatch_network::Device;
use std::path::Path;

/// All kinds of learner.
pub const LEARNERS: &[&LearnerKind] = &[
    &filter::FILTER,
    &neural::NEURAL,
    &network::AUTOENCODER,
    &decisions::DECISIONS,
];

/// Finds a kind of learner by its name.
///
/// # Errors
/// If there is no such learner. The error lists the names of all learners.
pub fn named(name: &str) -> Result<&'static LearnerKind, String> {
    let found = LEARNERS.iter().copied().find(|kind| kind.name == name);
    found.ok_or_else(|| {
        let names = listed(LEARNERS.iter().map(|kind| kind.name));
        format!(
            "learner: expected one of {names}, got {:?}",
            shortened(name)
        )
    })
}

/// Reads the learned values from checkpoints, at most one checkpoint of each kind. Networks compute on `device`.
pub fn read<'a>(paths: impl IntoIterator<Item = &'a Path>, device: &Device) -> Result<Learned> {
    let mut learned = Learned::default();
    for path in paths {
        let (kind, contents) = checkpoint::read(path)?;
        let added = add(&mut learned, &kind, &contents, device);
        added.with_context(|| checkpoint::named(path))?;
    }
    Ok(learned)
}

/// Decodes the learned values of one checkpoint of any kind.
pub fn from_bytes(bytes: &[u8]) -> Result<Learned> {
    let (kind, contents) = checkpoint::decode(bytes)?;
    let mut learned = Learned::default();
    add(&mut learned, &kind, &contents, &Device::Cpu)?;
    Ok(learned)
}

fn add(learned: &mut Learned, name: &str, contents: &Contents, device: &Device) -> Result<()> {
    let mut kinds = LEARNERS.iter();
    let kind = kinds.find(|kind| kind.checkpoint == name);
    let kind = kind.with_context(|| {
        let names = listed(LEARNERS.iter().map(|kind| kind.checkpoint));
        format!("expected a checkpoint of one of the kinds {names}, got {name}: train it again")
    })?;
    let is_other = (kind.read)(contents, device, learned)?;
    ensure!(!is_other, "expected one checkpoint of {name}, got two");
    learned.worlds.push(contents.worlds.clone());
    Ok(())
}
