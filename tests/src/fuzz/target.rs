//! A decoder under attack, and its corpus.

use std::path::{Path, PathBuf};

/// A decoder under attack.
#[derive(Debug, Clone, Copy)]
pub struct Target {
    /// Also its folder in the corpus, and its program in `fuzz/`.
    pub name: &'static str,
    /// Decodes bytes and panics if something is wrong with the decoder; returns whether they were
    /// accepted.
    pub body: fn(&[u8]) -> bool,
    /// What the code makes of the corpus: names and bytes. Texts lie there as they were written.
    pub seeds: fn() -> Vec<Seed>,
}

pub type Seed = (&'static str, Vec<u8>);

impl Target {
    /// Its folder in the corpus.
    pub fn folder(&self) -> PathBuf {
        let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus");
        corpus.join(self.name)
    }

    /// The files of its corpus, in the order of their names.
    pub fn corpus(&self) -> std::io::Result<Vec<Vec<u8>>> {
        let entries = std::fs::read_dir(self.folder())?;
        let paths = entries.map(|entry| Ok(entry?.path()));
        let mut paths = paths.collect::<std::io::Result<Vec<PathBuf>>>()?;
        paths.sort();
        paths.iter().map(std::fs::read).collect()
    }

    /// Writes its seeds into its corpus.
    pub fn write_seeds(&self) -> std::io::Result<()> {
        std::fs::create_dir_all(self.folder())?;
        for (name, bytes) in (self.seeds)() {
            std::fs::write(self.folder().join(name), bytes)?;
        }
        Ok(())
    }
}
