//! Simulated first beliefs of earlier runs, kept in the user's cache folder: a file each, of the key, the probabilities
//! and a checksum. Where anything is wrong with a file or the folder, the belief is simulated again.

use crate::estimation::belief::Belief;
use crate::estimation::prior::Prior;
use emberwatch_model::grid::{Probabilities, Shape};
use emberwatch_model::{Model, ModelFile};
use std::fs::OpenOptions;
use std::io::Write;
#[cfg(unix)]
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Most files that are kept.
const MAX_FILES: usize = 32;

/// Most bytes of a belief: one about 512 x 512 cells in four states.
const MAX_BYTES: usize = 4 << 20;

const CHECKSUM_BYTES: usize = 4;

/// Where a prior is kept.
#[derive(Debug)]
pub struct KeptBelief {
    path: PathBuf,
    /// All that the belief depends on, as text.
    key: String,
    /// S, H and W.
    dim: (usize, usize, usize),
}

impl KeptBelief {
    /// `None` if there is no cache folder, or the belief is too large for it.
    pub fn new(prior: Prior, model: &Model, shape: Shape, seed: u64) -> Option<Self> {
        let version = env!("CARGO_PKG_VERSION");
        // What robots see changes no world.
        let file = ModelFile {
            sensor: None,
            no_fly: None,
            ..model.file().clone()
        };
        let file = toml::to_string(&file).expect("invariant: model files serialise");
        let key = format!("emberwatch {version}: {prior:?}, {shape}, seed {seed}\n{file}\n");
        let dim = (model.n_states(), shape.height(), shape.width());
        let name = format!("{:08x}.belief", crc32fast::hash(key.as_bytes()));
        let path = cache_folder()?.join("emberwatch/beliefs").join(name);
        (n_value_bytes(dim) <= MAX_BYTES).then_some(Self { path, key, dim })
    }

    /// The belief, if it was kept.
    pub fn read(&self) -> Option<Belief> {
        let found = self.path.metadata().ok()?;
        // Nothing is read of a file of another length, or of what is no file.
        if !found.is_file() || found.len() != self.n_bytes() as u64 {
            return None;
        }
        let bytes = std::fs::read(&self.path).ok()?;
        let (content, checksum) = bytes.split_last_chunk::<CHECKSUM_BYTES>()?;
        if crc32fast::hash(content) != u32::from_le_bytes(*checksum) {
            return None;
        }
        let values = content.strip_prefix(self.key.as_bytes())?;
        let values = values.as_chunks().0.iter().copied().map(f32::from_le_bytes);
        let values = Probabilities::from_shape_vec(self.dim, values.collect()).ok()?;
        Belief::from_probabilities(values).ok()
    }

    /// Keeps the belief for later runs; the oldest go where there are too many.
    ///
    /// # Errors
    /// If the system does not let it write there.
    pub fn write(&self, belief: &Belief) -> std::io::Result<()> {
        let mut bytes = self.key.clone().into_bytes();
        let values = belief.probabilities().iter();
        bytes.extend(values.flat_map(|value| value.to_le_bytes()));
        bytes.extend(crc32fast::hash(&bytes).to_le_bytes());
        let folder = self.path.parent().unwrap_or(Path::new("/"));
        std::fs::create_dir_all(folder)?;
        replace(&self.path, &bytes)?;
        remove_oldest(folder, MAX_FILES);
        Ok(())
    }

    fn n_bytes(&self) -> usize {
        self.key.len() + n_value_bytes(self.dim) + CHECKSUM_BYTES
    }
}

fn n_value_bytes((n_states, height, width): (usize, usize, usize)) -> usize {
    n_states * height * width * size_of::<f32>()
}

/// `XDG_CACHE_HOME`, or `.cache` in the home folder; relative paths do not count.
fn cache_folder() -> Option<PathBuf> {
    let folder = |name| std::env::var_os(name).map(PathBuf::from);
    let is_absolute = |path: &PathBuf| path.is_absolute();
    let of_home = || folder("HOME").map(|home| home.join(".cache"));
    folder("XDG_CACHE_HOME")
        .filter(is_absolute)
        .or_else(|| of_home().filter(is_absolute))
}

/// Writes a file of the user alone beside the path and renames it; a checksum in it finds what a crash leaves.
fn replace(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let beside = path.with_extension(std::process::id().to_string());
    // What an earlier process of this number left may have other readers.
    let _ = std::fs::remove_file(&beside);
    let mut options = OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    options.mode(0o600);
    let opened = options.open(&beside);
    let written = opened
        .and_then(|mut file| file.write_all(bytes))
        .and_then(|()| std::fs::rename(&beside, path));
    if written.is_err() {
        // The first error is the one to tell.
        let _ = std::fs::remove_file(&beside);
    }
    written
}

fn remove_oldest(folder: &Path, most: usize) {
    let Ok(entries) = std::fs::read_dir(folder) else {
        return;
    };
    let age = |entry: std::io::Result<std::fs::DirEntry>| {
        let path = entry.ok()?.path();
        let changed = path.metadata().and_then(|found| found.modified());
        Some((changed.unwrap_or(SystemTime::UNIX_EPOCH), path))
    };
    let mut files: Vec<_> = entries.filter_map(age).collect();
    files.sort();
    let n_too_many = files.len().saturating_sub(most);
    for (_, path) in &files[..n_too_many] {
        // Another agent may have removed it.
        let _ = std::fs::remove_file(path);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_belief_of_the_most_bytes_is_kept_and_none_above() {
        // It has four states.
        let model = Model::built_in("road-ice").expect("built in");
        let is_kept = |width| {
            let shape = Shape::new(512, width).expect("test shape");
            KeptBelief::new(Prior::Initial, &model, shape, 0).is_some()
        };
        assert!(cache_folder().is_some(), "expected HOME");
        assert_eq!([512, 513].map(is_kept), [true, false]);
    }

    #[test]
    fn a_belief_is_kept_for_all_that_it_depends_on() {
        let kept = |seed, n_worlds, (height, width)| {
            let shape = Shape::new(height, width).expect("test shape");
            let burn_in = 40;
            let prior = Prior::Simulated { n_worlds, burn_in };
            KeptBelief::new(prior, &Model::wildfire(), shape, seed).expect("small")
        };
        let names = [
            kept(0, 9, (5, 7)),
            kept(1, 9, (5, 7)),
            kept(0, 8, (5, 7)),
            kept(0, 9, (7, 5)),
        ];
        let names = names.map(|it| it.path);
        for (at, name) in names.iter().enumerate() {
            assert!(!names[..at].contains(name), "{names:?}");
        }
        assert_eq!(kept(0, 9, (5, 7)).path, names[0]);
    }

    #[test]
    fn what_was_written_is_read_and_anything_else_is_not() {
        let folder = tempfile::TempDir::new().expect("a folder");
        let kept = |key: &str| KeptBelief {
            path: folder.path().join("new/a.belief"),
            key: key.into(),
            dim: (3, 1, 2),
        };
        let belief = Belief::uniform(3, Shape::new(1, 2).expect("test shape"));
        assert_eq!(kept("key").read(), None, "not there");
        kept("key").write(&belief).expect("written");
        assert_eq!(kept("key").read(), Some(belief.clone()));
        assert_eq!(kept("kez").read(), None, "another key");
        let path = kept("key").path;
        let whole = std::fs::read(&path).expect("the file");
        let mut flipped = whole.clone();
        flipped[whole.len() - 9] ^= 1;
        for wrong in [&whole[1..], &flipped, b"", &[0; 100]] {
            std::fs::write(&path, wrong).expect("written");
            assert_eq!(kept("key").read(), None, "{wrong:?}");
        }
        std::fs::remove_file(&path).expect("removed");
        std::fs::create_dir(&path).expect("a folder in its place");
        assert_eq!(kept("key").read(), None);
        kept("key")
            .write(&belief)
            .expect_err("a folder in its place");
        let left = std::fs::read_dir(folder.path().join("new"));
        assert_eq!(left.expect("listed").count(), 1, "the folder alone");
    }

    #[test]
    fn the_oldest_files_go() {
        let folder = tempfile::TempDir::new().expect("a folder");
        for (name, seconds) in [("a", 20), ("b", 10), ("c", 30)] {
            let file = std::fs::File::create(folder.path().join(name)).expect("a file");
            let changed = SystemTime::UNIX_EPOCH + std::time::Duration::from_secs(seconds);
            file.set_modified(changed).expect("a time");
        }
        remove_oldest(folder.path(), 2);
        let is_there = |name| folder.path().join(name).exists();
        assert_eq!(["a", "b", "c"].map(is_there), [true, false, true]);
    }
}
