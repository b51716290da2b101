//! What learns while it acts, as a training drives it. Pure: frames in, paths out.
//!
//! A learner is one file, with its constructor and its facts, and a line in [`LEARNERS`].

mod base;
pub mod decisions;
pub mod filter;
mod left;
pub mod network;
pub mod neural;
#[cfg(test)]
pub(crate) mod tests;
mod update;

pub use self::base::{Beginning, Learner, LearnerKind, Learning, Saving, Worlds};
pub use self::update::ModelUpdate;

use crate::checkpoint::{self, Contents};
use crate::learned::Learned;
use anyhow::{Context, Result, ensure};
use emberwatch_model::built_in::listed;
use emberwatch_network::Device;
use std::path::Path;

/// All learners.
pub const LEARNERS: &[&LearnerKind] = &[
    &filter::FILTER,
    &neural::NEURAL,
    &network::AUTOENCODER,
    &decisions::DECISIONS,
];

/// The learner of a name.
///
/// # Errors
/// Names them all.
pub fn named(name: &str) -> Result<&'static LearnerKind, String> {
    let found = LEARNERS.iter().copied().find(|kind| kind.name == name);
    found.ok_or_else(|| {
        let names = listed(LEARNERS.iter().map(|kind| kind.name));
        format!("learner: expected one of {names}, got {name:?}")
    })
}

/// The learner that writes checkpoints with a name.
///
/// # Errors
/// Lists the names of all checkpoints.
pub fn of_checkpoint(name: &str) -> Result<&'static LearnerKind> {
    let mut kinds = LEARNERS.iter().copied();
    let kind = kinds.find(|kind| kind.checkpoints.contains(&name));
    kind.with_context(|| {
        let names = listed(LEARNERS.iter().map(|kind| kind.checkpoints[0]));
        format!("expected a checkpoint of one of {names}, got one of {name}")
    })
}

/// What some checkpoints hold, of each kind one at most; networks compute on `device`.
pub fn read<'a>(paths: impl IntoIterator<Item = &'a Path>, device: &Device) -> Result<Learned> {
    let mut learned = Learned::default();
    for path in paths {
        let (kind, contents) = checkpoint::read(path)?;
        let added = add(&mut learned, &kind, &contents, device);
        added.with_context(|| format!("checkpoint {}", path.display()))?;
    }
    Ok(learned)
}

/// What one checkpoint holds, of whatever kind.
pub fn from_bytes(bytes: &[u8]) -> Result<Learned> {
    let (kind, contents) = checkpoint::decode(bytes)?;
    let mut learned = Learned::default();
    add(&mut learned, &kind, &contents, &Device::Cpu)?;
    Ok(learned)
}

fn add(learned: &mut Learned, name: &str, contents: &Contents, device: &Device) -> Result<()> {
    let kind = of_checkpoint(name)?;
    let is_other = (kind.read)(contents, device, learned)?;
    ensure!(!is_other, "expected one checkpoint of {name}, got two");
    learned.digests.push(contents.digest());
    Ok(())
}
