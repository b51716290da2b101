//! Trainings, each in a folder of its own.

use crate::commands::agent;
use std::path::PathBuf;
use tempfile::TempDir;
use tests::harness::Ended;

/// A folder with settings, in which trainings write into folders of theirs.
pub struct Place {
    folder: TempDir,
    /// Columns of the metrics.
    header: &'static str,
}

impl Place {
    pub fn new(settings: &str, header: &'static str) -> Self {
        let folder = TempDir::new().expect("a folder");
        let place = Self { folder, header };
        place.set(settings);
        place
    }

    /// Writes other settings.
    pub fn set(&self, settings: &str) {
        std::fs::write(self.path("agent.toml"), settings).expect("settings");
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub fn checkpoint(&self, out: &str) -> PathBuf {
        self.path(out).join("checkpoint.safetensors")
    }

    /// The command's words for training into a folder.
    pub fn words(&self, out: &str, flags: &str) -> String {
        let (config, out) = (self.path("agent.toml"), self.path(out));
        let (config, out) = (config.display(), out.display());
        format!("train --config {config} --out {out} {flags}")
    }

    pub fn train(&self, out: &str, flags: &str) -> Ended {
        agent(&self.words(out, flags))
    }

    /// Trains, and returns the rows of the metrics.
    pub fn learn(&self, out: &str, flags: &str) -> Vec<Vec<String>> {
        self.train(out, flags);
        self.rows(out)
    }

    /// The rows of the metrics.
    pub fn rows(&self, out: &str) -> Vec<Vec<String>> {
        let text =
            std::fs::read_to_string(self.path(out).join("metrics.csv")).expect("the metrics");
        let mut lines = text.lines();
        assert_eq!(lines.next(), Some(self.header));
        let rows = lines.map(|line| line.split(',').map(String::from).collect());
        rows.collect()
    }
}
