//! `record`: records what an instance publishes.

use anyhow::{Context, Result};
use clap::Args;
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::program::stop_on_signals;
use emberwatch_server::recording::{RecordOptions, RecordSummary, record};
use std::path::PathBuf;

/// Records the frames that an instance publishes to a file.
#[derive(Args)]
pub struct RecordCommand {
    /// Instance name of the server; the server may start later and may restart
    #[arg(long, default_value = "default")]
    instance: String,
    /// The file to write
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Overwrite an existing file
    #[arg(long)]
    force: bool,
    /// Record hidden states too, where the server publishes them (`--publish-truth`)
    #[arg(long)]
    truth: bool,
    /// Number of world steps to record, 0 for no limit
    #[arg(long, default_value_t = 0)]
    steps: u64,
    /// The worlds to record, such as 0,2,3 [default: all]
    #[arg(long, value_delimiter = ',', value_name = "WORLD,...")]
    worlds: Vec<u32>,
}

impl RecordCommand {
    pub fn run(&self) -> Result<()> {
        let stop = stop_on_signals().context("handle signals")?;
        let options = RecordOptions {
            instance: Instance::new(&self.instance)?,
            out: self.out.clone(),
            overwrite: self.force,
            truth: self.truth,
            n_steps: self.steps,
            worlds: self.worlds.clone(),
        };
        report(&record(&options, &stop)?);
        Ok(())
    }
}

fn report(summary: &RecordSummary) {
    let totals = &summary.totals;
    tracing::info!(
        records = totals.n_servers + totals.n_frames + totals.n_truths,
        servers = totals.n_servers,
        frames = totals.n_frames,
        truths = totals.n_truths,
        steps = summary.n_steps,
        bytes = summary.n_bytes,
        "recorded"
    );
    if totals.n_lost_frames + totals.n_lost_truths > 0 {
        tracing::warn!(
            frames = totals.n_lost_frames,
            truths = totals.n_lost_truths,
            "samples were lost: they arrived faster than they could be read"
        );
    }
    if summary.n_unknown > 0 {
        tracing::warn!(
            samples = summary.n_unknown,
            "samples were not recorded: their server did not answer `hello`"
        );
    }
}
