//! Fuzz targets: one function per format, which decodes hostile bytes and checks properties that must always hold.
//!
//! [`TARGETS`] lists all targets. `tests/decoders.rs` runs each target on damaged copies of its corpus,
//! `fuzz/corpus/<name>/`. `fuzz/` runs the same functions under libFuzzer.

mod files;
mod messages;
mod requests;
mod worlds;

use messages::Seed;
use std::path::{Path, PathBuf};

/// A decoder under attack.
#[derive(Debug, Clone, Copy)]
pub struct Target {
    /// Name of the target, of its folder in the corpus, and of its program in `fuzz/`.
    pub name: &'static str,
    /// Decodes bytes and returns whether they were accepted. Panics if it finds an error in the decoder.
    pub body: fn(&[u8]) -> bool,
    /// Generates the binary files of the corpus. Text files in the corpus are written by hand.
    pub seeds: fn() -> Vec<Seed>,
}

/// All targets.
pub const TARGETS: [Target; 11] = [
    target("step_request", requests::step, requests::step_seeds),
    target("control_request", requests::control, Vec::new),
    target(
        "step_answer",
        messages::step_answer,
        messages::step_answer_seeds,
    ),
    target("frame", messages::frame, messages::frame_seeds),
    target("outlook", messages::outlook, messages::outlook_seeds),
    target("control_reply", messages::control_reply, Vec::new),
    target("model", files::model, Vec::new),
    target("checkpoint", files::checkpoint, files::checkpoint_seeds),
    target("states", worlds::states, worlds::states_seeds),
    target("snapshot", worlds::snapshot, worlds::snapshot_seeds),
    target("recording", worlds::recording, worlds::recording_seeds),
];

const fn target(name: &'static str, body: fn(&[u8]) -> bool, seeds: fn() -> Vec<Seed>) -> Target {
    Target { name, body, seeds }
}

/// Runs the target of this name on bytes.
///
/// # Panics
/// If the target finds an error in its decoder, or if there is no such target.
pub fn decode(name: &str, bytes: &[u8]) -> bool {
    let target = TARGETS.iter().find(|target| target.name == name);
    (target.expect("a target of this name").body)(bytes)
}

impl Target {
    /// Returns the target's folder in the corpus.
    pub fn folder(&self) -> PathBuf {
        let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus");
        corpus.join(self.name)
    }

    /// Reads the files of the target's corpus, sorted by name.
    pub fn corpus(&self) -> std::io::Result<Vec<Vec<u8>>> {
        let entries = std::fs::read_dir(self.folder())?;
        let paths = entries.map(|entry| Ok(entry?.path()));
        let mut paths = paths.collect::<std::io::Result<Vec<PathBuf>>>()?;
        paths.sort();
        paths.iter().map(std::fs::read).collect()
    }

    /// Writes the generated files of the target's corpus.
    pub fn write_seeds(&self) -> std::io::Result<()> {
        std::fs::create_dir_all(self.folder())?;
        let mut seeds = (self.seeds)().into_iter();
        seeds.try_for_each(|(name, bytes)| std::fs::write(self.folder().join(name), bytes))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_target_has_a_program_and_the_seeds_of_this_release() {
        let programs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/fuzz_targets");
        for target in TARGETS {
            for (name, bytes) in (target.seeds)() {
                let path = target.folder().join(name);
                let is_kept = std::fs::read(&path).is_ok_and(|kept| kept == bytes);
                assert!(
                    is_kept,
                    "{path:?}: run `cargo run -p tests --example corpus`"
                );
            }
            let program = std::fs::read_to_string(programs.join(format!("{}.rs", target.name)));
            let program = program.expect("a program of libFuzzer");
            assert!(program.contains(&format!("{:?}", target.name)), "{program}");
        }
        let n_programs = std::fs::read_dir(programs).expect("the programs").count();
        assert_eq!(n_programs, TARGETS.len());
    }
}
