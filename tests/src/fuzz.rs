//! Fuzz targets: one function per format, which decodes hostile bytes and checks properties that must always hold.
//!
//! [`TARGETS`] lists all targets. `tests/decoders.rs` runs each target on damaged copies of its corpus,
//! `fuzz/corpus/<name>/`. `fuzz/` runs the same functions under libFuzzer.

mod files;
mod messages;
mod requests;

use std::path::{Path, PathBuf};

/// A decoder under attack.
#[derive(Debug, Clone, Copy)]
pub struct Target {
    /// Name of the target, of its folder in the corpus, and of its program in `fuzz/`.
    pub name: &'static str,
    /// Decodes bytes and returns whether they were accepted. Panics if it finds an error in the decoder.
    pub body: fn(&[u8]) -> bool,
}

/// All targets.
pub const TARGETS: [Target; 8] = [
    target("step_request", requests::step),
    target("control_request", requests::control),
    target("step_answer", messages::step_answer),
    target("frame", messages::frame),
    target("outlook", messages::outlook),
    target("control_reply", messages::control_reply),
    target("model", files::model),
    target("checkpoint", files::checkpoint),
];

const fn target(name: &'static str, body: fn(&[u8]) -> bool) -> Target {
    Target { name, body }
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
    /// Reads the files of the target's corpus, sorted by name.
    pub fn corpus(&self) -> std::io::Result<Vec<Vec<u8>>> {
        let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus");
        let entries = std::fs::read_dir(corpus.join(self.name))?;
        let paths = entries.map(|entry| Ok(entry?.path()));
        let mut paths = paths.collect::<std::io::Result<Vec<PathBuf>>>()?;
        paths.sort();
        paths.iter().map(std::fs::read).collect()
    }
}
