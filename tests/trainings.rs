//! Helpers for trainings, each in its own folder.

use crate::commands::{agent, check};
use emberwatch_learning::checkpoint::{self, Contents};
use std::path::PathBuf;
use tests::harness::{AGENT, Ended, Folder, Server};

/// Flags for small worlds.
pub const WORLDS: &str = "--worlds 2 --height 6 --width 9 --moves 5 --burn-in 60";

/// A folder with a settings file and the output folders of trainings.
pub struct Place {
    pub folder: Folder,
    /// Columns of the metrics.
    header: &'static str,
}

impl Place {
    pub fn new(settings: &str, header: &'static str) -> Self {
        let folder = Folder::default();
        let place = Self { folder, header };
        place.set(settings);
        place
    }

    /// Replaces the settings file.
    pub fn set(&self, settings: &str) {
        self.folder.write("agent.toml", settings);
    }

    pub fn checkpoint(&self, out: &str) -> PathBuf {
        self.folder.path(out).join("checkpoint.safetensors")
    }

    /// Returns the flag that names a checkpoint.
    pub fn flag(&self, out: &str) -> String {
        format!("--checkpoint {}", self.checkpoint(out).display())
    }

    pub fn bytes(&self, out: &str) -> Vec<u8> {
        std::fs::read(self.checkpoint(out)).expect("a checkpoint")
    }

    pub fn contents(&self, out: &str) -> Contents {
        checkpoint::read(&self.checkpoint(out))
            .expect("a checkpoint")
            .1
    }

    /// Returns the arguments of a training into a folder.
    pub fn words(&self, out: &str, flags: &str) -> String {
        let [config, out] = ["agent.toml", out].map(|name| self.folder.word(name));
        format!("train --config {config} --out {out} {flags}")
    }

    pub fn train(&self, out: &str, flags: &str) -> Ended {
        agent(&self.words(out, flags))
    }

    pub fn refuse(&self, out: &str, flags: &str, words: &str) {
        check(AGENT, &self.words(out, flags), words);
    }

    /// Checks that the flags in each line of a table are refused. Each line consists of flags, an arrow, and words of
    /// the error.
    pub fn refuse_all(&self, out: &str, flags: &str, table: &str) {
        for line in table.lines() {
            let (more, words) = line.split_once(" => ").expect("flags and words");
            self.refuse(out, &format!("{flags} {more}"), words);
        }
    }

    /// Trains, and returns the rows of the metrics.
    pub fn learn(&self, out: &str, flags: &str) -> Vec<Vec<String>> {
        self.train(out, flags);
        self.rows(out)
    }

    /// Returns the rows of the metrics.
    pub fn rows(&self, out: &str) -> Vec<Vec<String>> {
        let text = self.folder.text(&format!("{out}/metrics.csv"));
        let mut lines = text.lines();
        assert_eq!(lines.next(), Some(self.header));
        let rows = lines.map(|line| line.split(',').map(String::from).collect());
        rows.collect()
    }

    /// Runs `compare` on small worlds, with the checkpoint in folder `out`.
    pub fn compare(&self, out: &str, flags: &str) -> Ended {
        agent(&format!("compare {COMPARED} {} {flags}", self.flag(out)))
    }
}

/// Flags of a very short comparison or evaluation.
pub const COMPARED: &str = "--seeds 3..5 --steps 5 --height 6 --width 9 --moves 5 --burn-in 60 \
                            --beam-width 4 --shooting-samples 16";

/// Returns the flag that names a server.
pub fn on(server: &Server) -> String {
    format!("--instance {}", server.instance.name())
}
