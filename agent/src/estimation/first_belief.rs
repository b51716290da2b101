//! A filter's first belief. Simulating one takes seconds, so it is kept in a file for the next time.

use crate::file::{Readers, replace_file};
use crc::{CRC_64_XZ, Crc};
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::prior::Prior;
use emberwatch_protocol::model::ModelError;
use emberwatch_protocol::{Model, Shape};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Cells that a core moves by one step in a second: 64 x 64 of the wildfire in 3.4 us.
const CELLS_PER_SECOND: f64 = 1.2e9;

/// Simulations that take less are not kept, seconds.
const LEAST_SECONDS: f64 = 0.1;

/// Beliefs that are kept, 49 kB each of the wildfire on 64 x 64 cells; the oldest give way.
const MOST_KEPT: usize = 64;

const CHECKSUM: Crc<u64> = Crc::<u64>::new(&CRC_64_XZ);

/// The belief before the first frame, see [`Prior::belief`]. One that was simulated before, with the same model, grid,
/// settings and version, is read from the user's cache folder.
pub fn first_belief(
    prior: Prior,
    model: &Model,
    shape: Shape,
    seed: u64,
) -> Result<Belief, ModelError> {
    let Prior::Simulated { n_worlds, burn_in } = prior else {
        return prior.belief(model, shape, seed);
    };
    let cells = n_worlds as f64 * burn_in as f64 * shape.n_cells() as f64;
    let seconds = cells / CELLS_PER_SECOND / rayon::current_num_threads() as f64;
    let kept = cache_folder().filter(|_| seconds >= LEAST_SECONDS);
    let kept = kept.map(|folder| Kept::new(folder, prior, model, shape, seed));
    if let Some(belief) = kept.as_ref().and_then(|kept| kept.read(model, shape)) {
        return Ok(belief);
    }
    tracing::info!(
        worlds = n_worlds,
        steps = burn_in,
        about_seconds = seconds.ceil(),
        "simulating the first belief"
    );
    let belief = prior.belief(model, shape, seed)?;
    if let Some(Err(problem)) = kept.map(|kept| kept.write(&belief)) {
        tracing::debug!("the first belief is not kept: {problem:#}");
    }
    Ok(belief)
}

/// Where a first belief is kept: a file with all that it depends on, the belief, and a checksum.
struct Kept {
    path: PathBuf,
    key: String,
}

impl Kept {
    fn new(folder: PathBuf, prior: Prior, model: &Model, shape: Shape, seed: u64) -> Self {
        let version = env!("CARGO_PKG_VERSION");
        let key = format!("{version} {prior:?} {shape:?} {seed} {:?}\n", model.file());
        let name = format!("{:016x}.belief", CHECKSUM.checksum(key.as_bytes()));
        let path = folder.join(name);
        Self { path, key }
    }

    /// The belief; `None` if there is none, or the file is damaged or of something else.
    fn read(&self, model: &Model, shape: Shape) -> Option<Belief> {
        let bytes = std::fs::read(&self.path).ok()?;
        let (checked, checksum) = bytes.split_last_chunk()?;
        let is_whole = CHECKSUM.checksum(checked) == u64::from_le_bytes(*checksum);
        let belief = checked
            .strip_prefix(self.key.as_bytes())
            .filter(|_| is_whole)?;
        let (height, width) = shape.dim();
        Belief::from_bytes(belief, (model.n_states(), height, width))
    }

    fn write(&self, belief: &Belief) -> anyhow::Result<()> {
        let folder = self.path.parent().unwrap_or(Path::new(""));
        std::fs::create_dir_all(folder)?;
        remove_oldest(folder)?;
        let mut bytes = [self.key.as_bytes(), &belief.to_bytes()].concat();
        bytes.extend(CHECKSUM.checksum(&bytes).to_le_bytes());
        replace_file(&self.path, &bytes, Readers::Owner)
    }
}

/// Makes room for one more file.
fn remove_oldest(folder: &Path) -> std::io::Result<()> {
    let mut files: Vec<(SystemTime, PathBuf)> = Vec::new();
    for file in std::fs::read_dir(folder)? {
        let file = file?;
        files.push((file.metadata()?.modified()?, file.path()));
    }
    files.sort();
    let n_more = (files.len() + 1).saturating_sub(MOST_KEPT);
    files[..n_more]
        .iter()
        .try_for_each(|(_, path)| std::fs::remove_file(path))
}

/// The user's folder for what can be made again, as the XDG base directories say; `None` if the system names none.
fn cache_folder() -> Option<PathBuf> {
    let of = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty());
    let own = |home: OsString| PathBuf::from(home).join(".cache");
    let caches = of("XDG_CACHE_HOME")
        .map(PathBuf::from)
        .or_else(|| of("HOME").map(own))?;
    caches
        .is_absolute()
        .then(|| caches.join("emberwatch/beliefs"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_kept_belief_is_that_of_its_settings_alone() {
        let folder = tempfile::tempdir().expect("a folder");
        let (model, shape) = (Model::wildfire(), Shape::new(3, 4).expect("a shape"));
        let prior = |burn_in| Prior::Simulated {
            n_worlds: 2,
            burn_in,
        };
        let kept = |burn_in, seed| {
            Kept::new(
                folder.path().join("new"),
                prior(burn_in),
                &model,
                shape,
                seed,
            )
        };
        let belief = prior(5).belief(&model, shape, 1).expect("a belief");
        let own = kept(5, 1);
        assert_eq!(own.read(&model, shape), None);
        own.write(&belief).expect("written");
        assert_eq!(own.read(&model, shape).as_ref(), Some(&belief));
        for other in [kept(6, 1), kept(5, 2)] {
            assert_eq!(other.read(&model, shape), None);
            // Even in a file of its name.
            std::fs::copy(&own.path, &other.path).expect("copied");
            assert_eq!(other.read(&model, shape), None);
        }
        let mut bytes = std::fs::read(&own.path).expect("the file");
        for damaged in [bytes.len() - 9, bytes.len() - 1] {
            bytes[damaged] ^= 1;
            std::fs::write(&own.path, &bytes).expect("written");
            assert_eq!(own.read(&model, shape), None);
            bytes[damaged] ^= 1;
        }
        for wrong in [&[][..], &bytes[..7], &bytes[..bytes.len() - 1]] {
            std::fs::write(&own.path, wrong).expect("written");
            assert_eq!(own.read(&model, shape), None);
        }
    }

    #[test]
    fn the_oldest_give_way() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = |n: usize| folder.path().join(format!("{n}.belief"));
        for n in 0..MOST_KEPT + 3 {
            let file = std::fs::File::create(path(n)).expect("a file");
            let age = std::time::Duration::from_secs((MOST_KEPT + 3 - n) as u64);
            file.set_modified(SystemTime::now() - age).expect("a time");
        }
        remove_oldest(folder.path()).expect("removed");
        let left = (0..MOST_KEPT + 3).filter(|&n| path(n).exists());
        assert_eq!(
            left.collect::<Vec<_>>(),
            (4..MOST_KEPT + 3).collect::<Vec<_>>()
        );
    }
}
