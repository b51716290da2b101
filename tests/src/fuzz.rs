//! Hostile bytes for every decoder: one function per format, which checks what must hold of any bytes.
//!
//! A [`Target`] is a line of [`TARGETS`]. [`campaign`] runs it on stable Rust over mutations
//! ([`mutation`]) of its corpus, `fuzz/corpus/<name>/`; `fuzz/` runs the same functions under libFuzzer.

pub mod campaign;
mod files;
mod messages;
pub mod mutation;
mod requests;
mod worlds;

use std::path::{Path, PathBuf};

/// What bytes claim to be; a campaign counts the two apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Something that arrives over shared memory.
    Message,
    /// Something that is read from a file.
    File,
}

/// A decoder under attack.
#[derive(Debug, Clone, Copy)]
pub struct Target {
    /// Also its folder in the corpus, and its program in `fuzz/`.
    pub name: &'static str,
    /// Message or file.
    pub kind: Kind,
    /// Decodes bytes and panics if something is wrong with the decoder; returns whether they were
    /// accepted.
    pub body: fn(&[u8]) -> bool,
    /// What the corpus begins with: names and bytes.
    pub seeds: fn() -> Vec<Seed>,
}

/// A file of the corpus.
pub type Seed = (&'static str, Vec<u8>);

/// All of them.
pub const TARGETS: [Target; 11] = [
    message("step_request", requests::step, requests::step_seeds),
    message(
        "control_request",
        requests::control,
        requests::control_seeds,
    ),
    message(
        "step_answer",
        messages::step_answer,
        messages::step_answer_seeds,
    ),
    message("frame", messages::frame, messages::frame_seeds),
    message("outlook", messages::outlook, messages::outlook_seeds),
    message(
        "control_reply",
        messages::control_reply,
        messages::control_reply_seeds,
    ),
    message("decision", messages::decision, messages::decision_seeds),
    file("model", files::model, files::model_seeds),
    file("checkpoint", files::checkpoint, files::checkpoint_seeds),
    file("snapshot", worlds::snapshot, worlds::snapshot_seeds),
    file("recording", worlds::recording, worlds::recording_seeds),
];

type Body = fn(&[u8]) -> bool;
type Seeds = fn() -> Vec<Seed>;

const fn message(name: &'static str, body: Body, seeds: Seeds) -> Target {
    Target {
        name,
        kind: Kind::Message,
        body,
        seeds,
    }
}

const fn file(name: &'static str, body: Body, seeds: Seeds) -> Target {
    Target {
        name,
        kind: Kind::File,
        body,
        seeds,
    }
}

/// Decodes bytes as a target of a name does.
///
/// # Panics
/// If something is wrong with its decoder, or there is no such target.
pub fn decode(name: &str, bytes: &[u8]) -> bool {
    let target = Target::named(name).expect("a target of this name");
    (target.body)(bytes)
}

impl Target {
    /// The target of a name.
    pub fn named(name: &str) -> Option<&'static Self> {
        TARGETS.iter().find(|target| target.name == name)
    }

    /// Its folder in the corpus.
    pub fn folder(&self) -> PathBuf {
        let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus");
        corpus.join(self.name)
    }

    /// The files of its corpus, in the order of their names.
    ///
    /// # Errors
    /// The system's.
    pub fn corpus(&self) -> std::io::Result<Vec<Vec<u8>>> {
        let entries = std::fs::read_dir(self.folder())?;
        let paths = entries.map(|entry| Ok(entry?.path()));
        let mut paths = paths.collect::<std::io::Result<Vec<PathBuf>>>()?;
        paths.sort();
        paths.iter().map(std::fs::read).collect()
    }

    /// Writes its seeds into its corpus.
    ///
    /// # Errors
    /// The system's.
    pub fn write_seeds(&self) -> std::io::Result<()> {
        std::fs::create_dir_all(self.folder())?;
        for (name, bytes) in (self.seeds)() {
            std::fs::write(self.folder().join(name), bytes)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_corpus_holds_the_seeds_of_this_release() {
        for target in TARGETS {
            for (name, bytes) in (target.seeds)() {
                let path = target.folder().join(name);
                let kept = std::fs::read(&path).unwrap_or_default();
                assert!(
                    sorted(kept) == sorted(bytes),
                    "{} is not what it was made of: run `cargo run -p tests --example fuzz -- --seeds`",
                    path.display()
                );
            }
        }
    }

    /// Whatever the order: safetensors writes texts in any.
    fn sorted(mut bytes: Vec<u8>) -> Vec<u8> {
        bytes.sort_unstable();
        bytes
    }

    #[test]
    fn every_target_has_a_program_and_every_program_a_target() {
        let programs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/fuzz_targets");
        for target in TARGETS {
            let program = std::fs::read_to_string(programs.join(format!("{}.rs", target.name)));
            let program = program.expect("a program of libFuzzer");
            assert!(program.contains(&format!("{:?}", target.name)), "{program}");
        }
        let n_programs = std::fs::read_dir(programs).expect("the programs").count();
        assert_eq!(n_programs, TARGETS.len());
    }
}
