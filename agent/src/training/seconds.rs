//! Processor seconds of a training, kept in a file in its folder.

use anyhow::{Context, Result, ensure};
use emberwatch_learning::file::replace_file;
use rustix::time::{ClockId, clock_gettime};
use std::path::{Path, PathBuf};

const SECONDS: &str = "processor_seconds.txt";

/// Counts the processor seconds of a training, including earlier runs that it resumes.
pub struct Stopwatch {
    path: PathBuf,
    before: Option<f64>,
    start: f64,
}

impl Stopwatch {
    pub fn start(folder: &Path, resume: bool) -> Result<Self> {
        let before = if resume { read(folder)? } else { Some(0.0) };
        Ok(Self {
            path: folder.join(SECONDS),
            before,
            start: processor_seconds(),
        })
    }

    /// Writes the seconds so far, unless earlier runs have no record.
    pub fn write(&self) -> Result<()> {
        let Some(before) = self.before else {
            return Ok(());
        };
        let text = format!("{:.1}\n", before + processor_seconds() - self.start);
        replace_file(&self.path, text.as_bytes())
    }
}

/// Reads the processor seconds of the training in a folder; `None` if it recorded none.
pub fn read(folder: &Path) -> Result<Option<f64>> {
    let path = folder.join(SECONDS);
    if !path.exists() {
        return Ok(None);
    }
    let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    let seconds = text.trim().parse().ok();
    let seconds = seconds.filter(|seconds: &f64| seconds.is_finite() && *seconds >= 0.0);
    ensure!(
        seconds.is_some(),
        "{}: expected a number of seconds, got {text:?}",
        path.display()
    );
    Ok(seconds)
}

fn processor_seconds() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}
