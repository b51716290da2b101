//! `prior`: writes a filter's first belief to a file, for filters in other languages.

use super::shared::model_named;
use anyhow::{Result, ensure};
use clap::Args;
use emberwatch_belief::estimation::Prior;
use emberwatch_learning::beliefs::first_belief::first_belief;
use emberwatch_learning::file::{Readers, replace_file};
use emberwatch_protocol::built_in::listed;
use emberwatch_protocol::{Model, Shape};
use ndarray_npy::WriteNpyExt;
use rustix::fs::{Access, access};
use std::path::{Path, PathBuf};

/// Write a filter's first belief to a file.
#[derive(Args)]
pub struct PriorCommand {
    #[arg(long, value_name = "NAME|FILE", help = format!("Model: {}, or a model file", listed(Model::built_in_names())))]
    model: String,
    /// Grid height in cells
    #[arg(long)]
    height: usize,
    /// Grid width in cells
    #[arg(long)]
    width: usize,
    /// Burn-in of the server: steps simulated from the initial distribution
    #[arg(long, value_parser = clap::value_parser!(u64).range(0..=1 << 40))]
    burn_in: u64,
    /// Number of worlds to simulate
    #[arg(long, default_value_t = Prior::N_WORLDS as u64, value_parser = clap::value_parser!(u64).range(1..=10_000))]
    worlds: u64,
    /// Seed of these worlds; agents with the same --agent-seed have the same first belief
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Output file: NumPy .npy, 32-bit floats of shape [states, height, width]
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

impl PriorCommand {
    pub fn run(&self) -> Result<()> {
        let model = model_named(&self.model)?;
        let shape = Shape::new(self.height, self.width)?;
        check_place(&self.out)?;
        let prior = Prior::Simulated {
            n_worlds: self.worlds as usize,
            burn_in: self.burn_in,
        };
        let belief = first_belief(prior, &model, shape, self.seed)?;
        let mut bytes = Vec::new();
        belief.probabilities().write_npy(&mut bytes)?;
        replace_file(&self.out, &bytes, Readers::Any)?;
        let shape = belief.probabilities().shape();
        tracing::info!(?shape, file = %self.out.display(), "written");
        Ok(())
    }
}

/// Checks that the file can be written, so that errors come before a long simulation.
fn check_place(path: &Path) -> Result<()> {
    let place = path.display();
    // Only a regular file may be replaced, never a device.
    let free = path.metadata().map_or(true, |found| found.is_file());
    ensure!(
        free && path.file_name().is_some(),
        "--out: expected the path of a regular file, got {place}"
    );
    let folder = folder_of(path);
    ensure!(
        folder.is_dir() && access(folder, Access::WRITE_OK).is_ok(),
        "--out: expected a file in a writable folder, got {place}"
    );
    Ok(())
}

fn folder_of(path: &Path) -> &Path {
    let parent = path.parent().filter(|parent| *parent != Path::new(""));
    parent.unwrap_or(Path::new("."))
}
