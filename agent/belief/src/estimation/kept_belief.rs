//! A cache of simulated priors in the user's cache folder. Each file contains a key, the probabilities and a checksum.
//! While one process simulates a prior, others that need it wait. If a file or the folder is unusable, each simulates
//! the prior itself.

use crate::estimation::belief::Belief;
use crate::estimation::prior::Prior;
use emberwatch_model::grid::{Probabilities, Shape};
use emberwatch_model::{Model, ModelFile};
use std::fs::{File, OpenOptions, TryLockError};
use std::io::Write;
#[cfg(unix)]
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime};

const MAX_FILES: usize = 32;

/// Maximum size of a cached belief in bytes: 512 x 512 cells with four states.
const MAX_BYTES: usize = 4 << 20;

const CHECKSUM_BYTES: usize = 4;

const LONGEST_WAIT: Duration = Duration::from_secs(300);

const PAUSE: Duration = Duration::from_millis(20);

/// The right to make a belief. It ends with its process, unless a forked child has a copy of the descriptor.
struct Making {
    file: File,
}

impl Drop for Making {
    fn drop(&mut self) {
        // The file stays, as others may wait for it. Closing the file is not enough, because the child of a fork may
        // have a copy of the descriptor.
        let _ = self.file.unlock();
    }
}

/// The cache file of one prior.
#[derive(Debug)]
pub struct KeptBelief {
    path: PathBuf,
    /// Everything that the belief depends on, as text.
    key: String,
    /// The belief's shape `[S, H, W]`.
    dim: (usize, usize, usize),
}

impl KeptBelief {
    /// Returns the cache file of a prior, or `None` if there is no cache folder or the belief exceeds the maximum size.
    pub fn new(prior: Prior, model: &Model, shape: Shape, seed: u64) -> Option<Self> {
        let version = env!("CARGO_PKG_VERSION");
        // Sensors and no-fly zones do not influence the hidden states, so the key omits them.
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

    /// Returns the cached belief, or makes and caches it. If another process is making it, first waits until that
    /// is done, for at most five minutes; `pause` sleeps for the given time.
    ///
    /// # Errors
    /// Those of `make` and `pause`.
    pub fn read_or_make<E>(
        &self,
        pause: impl Fn(Duration) -> Result<(), E>,
        make: impl FnOnce() -> Result<Belief, E>,
    ) -> Result<Belief, E> {
        if let Some(belief) = self.read() {
            return Ok(belief);
        }
        let _making = self.lock(pause)?;
        if let Some(belief) = self.read() {
            return Ok(belief);
        }
        let belief = make()?;
        // If the file cannot be written, a later process makes the belief again.
        let _ = self.write(&belief);
        Ok(belief)
    }

    /// Waits for the right to make the belief. Returns `None` if the wait was too long, or files cannot be locked here.
    fn lock<E>(&self, pause: impl Fn(Duration) -> Result<(), E>) -> Result<Option<Making>, E> {
        let path = self.path.with_extension("lock");
        let mut options = OpenOptions::new();
        options.write(true).create(true).truncate(false);
        #[cfg(unix)]
        options.mode(0o600);
        let _ = path.parent().map(std::fs::create_dir_all);
        let Ok(file) = options.open(&path) else {
            return Ok(None);
        };
        let start = Instant::now();
        while start.elapsed() < LONGEST_WAIT {
            match file.try_lock() {
                Ok(()) => return Ok(Some(Making { file })),
                Err(TryLockError::WouldBlock) => pause(PAUSE)?,
                Err(TryLockError::Error(_)) => break,
            }
        }
        Ok(None)
    }

    /// Returns the cached belief, if there is a valid file.
    pub fn read(&self) -> Option<Belief> {
        let found = self.path.metadata().ok()?;
        // Check the type and the length first, so that neither a device nor a huge file is read.
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

    /// Writes the belief for later runs, and removes the oldest files beyond the maximum number.
    ///
    /// # Errors
    /// If the folder or the file cannot be written.
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

/// Returns `XDG_CACHE_HOME`, or `.cache` in the home folder. Relative paths are ignored.
fn cache_folder() -> Option<PathBuf> {
    let folder = |name| std::env::var_os(name).map(PathBuf::from);
    let is_absolute = |path: &PathBuf| path.is_absolute();
    let of_home = || folder("HOME").map(|home| home.join(".cache"));
    folder("XDG_CACHE_HOME")
        .filter(is_absolute)
        .or_else(|| of_home().filter(is_absolute))
}

/// Writes a user-only temporary file next to the path and renames it. The checksum in `bytes` reveals files cut short
/// by a crash.
fn replace(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let temporary = path.with_extension(std::process::id().to_string());
    // An earlier process with the same id may have left a temporary file with other permissions.
    let _ = std::fs::remove_file(&temporary);
    let mut options = OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    options.mode(0o600);
    let opened = options.open(&temporary);
    let written = opened
        .and_then(|mut file| file.write_all(bytes))
        .and_then(|()| std::fs::rename(&temporary, path));
    if written.is_err() {
        // Return the error of the write, not an error of this cleanup.
        let _ = std::fs::remove_file(&temporary);
    }
    written
}

fn remove_oldest(folder: &Path, max_files: usize) {
    let Ok(entries) = std::fs::read_dir(folder) else {
        return;
    };
    let age = |entry: std::io::Result<std::fs::DirEntry>| {
        let path = entry.ok()?.path();
        let changed = path.metadata().and_then(|found| found.modified());
        Some((changed.unwrap_or(SystemTime::UNIX_EPOCH), path))
    };
    let mut files: Vec<_> = entries.filter_map(age).collect();
    files.retain(|(_, path)| path.extension().is_some_and(|end| end == "belief"));
    files.sort();
    let n_too_many = files.len().saturating_sub(max_files);
    for (_, path) in &files[..n_too_many] {
        // Ignore errors, because another agent may have removed the file already.
        let _ = std::fs::remove_file(path);
        let _ = std::fs::remove_file(path.with_extension("lock"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};

    #[test]
    fn every_input_of_a_small_belief_changes_its_file_name() {
        assert!(cache_folder().is_some(), "HOME must be set");
        let kept = |model, seed, n_worlds, (height, width)| {
            let shape = Shape::new(height, width).expect("test shape");
            let burn_in = 40;
            let prior = Prior::Simulated { n_worlds, burn_in };
            let model = Model::built_in(model).expect("built in");
            KeptBelief::new(prior, &model, shape, seed).map(|it| it.path)
        };
        let inputs = [
            ("wildfire", 0, 9, (5, 7)),
            ("wildfire", 1, 9, (5, 7)),
            ("wildfire", 0, 8, (5, 7)),
            ("wildfire", 0, 9, (7, 5)),
            ("road-ice", 0, 9, (512, 512)),
        ];
        let paths =
            || inputs.map(|(model, seed, n, dim)| kept(model, seed, n, dim).expect("small"));
        let distinct: std::collections::BTreeSet<_> = paths().into();
        assert_eq!(distinct.len(), inputs.len());
        assert_eq!(paths(), paths(), "equal inputs");
        // This model has four states.
        assert_eq!(kept("road-ice", 0, 9, (512, 513)), None, "too large");
    }

    fn kept(folder: &tempfile::TempDir, key: &str) -> KeptBelief {
        KeptBelief {
            path: folder.path().join("new/a.belief"),
            key: key.into(),
            dim: (3, 1, 2),
        }
    }

    #[test]
    fn only_intact_files_with_the_same_key_are_read() {
        let folder = tempfile::TempDir::new().expect("a folder");
        let kept = |key| kept(&folder, key);
        let belief = Belief::uniform(3, Shape::new(1, 2).expect("test shape"));
        assert_eq!(kept("key").read(), None, "no file yet");
        kept("key").write(&belief).expect("written");
        assert_eq!(kept("key").read(), Some(belief.clone()));
        assert_eq!(kept("kez").read(), None, "a different key");
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
        assert_eq!(left.expect("listed").count(), 1, "only the folder");
    }

    #[test]
    fn one_makes_a_belief_and_the_others_wait() {
        let folder = tempfile::TempDir::new().expect("a folder");
        let kept = kept(&folder, "key");
        let belief = Belief::uniform(3, Shape::new(1, 2).expect("test shape"));
        let n_made = AtomicUsize::new(0);
        let pause = |time| -> Result<(), String> {
            std::thread::sleep(time);
            Ok(())
        };
        let make = || {
            n_made.fetch_add(1, Ordering::SeqCst);
            pause(5 * PAUSE).map(|()| belief.clone())
        };
        std::thread::scope(|scope| {
            let threads = [(); 6].map(|()| scope.spawn(|| kept.read_or_make(pause, make)));
            for thread in threads {
                assert_eq!(thread.join().expect("no panic"), Ok(belief.clone()));
            }
        });
        assert_eq!(n_made.load(Ordering::SeqCst), 1);
        // A process that ends leaves the right to the next one; a wait can be interrupted.
        std::fs::remove_file(&kept.path).expect("removed");
        let failed = kept.read_or_make(pause, || Err("no".into()));
        assert_eq!(failed, Err("no".into()));
        let making = kept.lock(pause).expect("free").expect("a lock");
        let interrupted = kept.read_or_make(|_| Err("stop".into()), make);
        assert_eq!(interrupted, Err("stop".into()));
        drop(making);
        assert_eq!(kept.read_or_make(pause, make), Ok(belief.clone()));
    }

    #[test]
    fn the_oldest_files_are_removed() {
        let folder = tempfile::TempDir::new().expect("a folder");
        let names = ["a.belief", "b.belief", "c.belief", "d.lock"];
        for (name, seconds) in names.into_iter().zip([20, 10, 30, 1]) {
            let file = File::create(folder.path().join(name)).expect("a file");
            let changed = SystemTime::UNIX_EPOCH + Duration::from_secs(seconds);
            file.set_modified(changed).expect("a time");
        }
        remove_oldest(folder.path(), 2);
        let left = names.map(|name| folder.path().join(name).exists());
        assert_eq!(left, [true, false, true, true]);
    }
}
