//! Many mutations of a target's corpus, watched: an input that panics, hangs or grows is named and saved.
//!
//! Input `i` of a seed is the same on every run, so that the same command meets the same failure.

use super::mutation::mutated;
use super::target::Target;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rustix::time::{ClockId, clock_gettime};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::{Builder, park_timeout};
use std::time::{Duration, Instant};
use thiserror::Error;

/// Processor time that one input may take. An input that sleeps instead takes no such time.
const MOST_WORK: Duration = Duration::from_secs(1);

/// Time of the clock that one input may take: this machine may be busy with other things.
const MOST_TIME: Duration = Duration::from_secs(60);

/// How much more memory may be resident at the end than after the first tenth, KiB.
const MOST_GROWTH: u64 = 4 << 10;

/// How much more may be resident at any time than at the beginning, KiB: what one input can make a
/// decoder ask for.
const MOST_AT_ONCE: u64 = 64 << 10;

/// A target, the seed of its mutations and its corpus.
#[derive(Debug)]
pub struct Campaign {
    target: Target,
    seed: u64,
    entries: Vec<Vec<u8>>,
}

/// What a campaign met.
#[derive(Debug, Clone, Copy)]
pub struct Report {
    /// Inputs decoded.
    pub n_inputs: u64,
    /// How many of them were accepted.
    pub n_accepted: u64,
    /// Time it took.
    pub elapsed: Duration,
    /// Memory resident after the first tenth, KiB.
    pub resident_before: u64,
    /// Memory resident at the end, KiB.
    pub resident_after: u64,
}

/// What is wrong with a decoder.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum Failure {
    /// The corpus or a failing input could not be read or written.
    #[error("{0}")]
    Io(#[from] std::io::Error),
    /// An input on which it panicked.
    #[error("{name}: input {index} panics; it is in {}", path.display())]
    Panic {
        /// The target.
        name: &'static str,
        /// Which input.
        index: u64,
        /// Where it was saved.
        path: PathBuf,
    },
    /// Inputs made it keep memory.
    #[error("{name}: expected memory to grow by at most {most} KiB, got {got} {when}")]
    Growth {
        /// The target.
        name: &'static str,
        /// The bound.
        most: u64,
        /// What it grew by.
        got: u64,
        /// In the end, or for a while.
        when: &'static str,
    },
}

impl Campaign {
    /// A campaign over a target's corpus.
    ///
    /// # Errors
    /// [`Failure::Io`].
    pub fn new(target: Target, seed: u64) -> Result<Self, Failure> {
        let entries = target.corpus()?;
        Ok(Self {
            target,
            seed,
            entries,
        })
    }

    /// An input: first the corpus as it is, then mutations of it.
    pub fn input(&self, index: u64) -> Vec<u8> {
        if let Some(entry) = self.entries.get(index as usize) {
            return entry.clone();
        }
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(index);
        mutated(&mut rng, &self.entries)
    }

    /// Decodes so many inputs, the corpus first. An input that takes too long ends the process.
    ///
    /// # Errors
    /// [`Failure`].
    pub fn run(&self, n_inputs: u64) -> Result<Report, Failure> {
        let (index, is_over) = (AtomicU64::new(0), AtomicBool::new(false));
        std::thread::scope(|scope| {
            let watch = || self.watch(&index, &is_over);
            let watcher = Builder::new()
                .name("watch".into())
                .spawn_scoped(scope, watch)?;
            let report = self.decode_all(n_inputs, &index);
            is_over.store(true, Ordering::Relaxed);
            watcher.thread().unpark();
            report
        })
    }

    fn decode_all(&self, n_inputs: u64, index: &AtomicU64) -> Result<Report, Failure> {
        let (started, warm) = (Instant::now(), n_inputs / 10);
        let (mut n_accepted, mut resident_before) = (0, 0);
        let resident_first = resident();
        forget_peak();
        for number in 0..n_inputs {
            index.store(number, Ordering::Relaxed);
            let input = self.input(number);
            match catch_unwind(AssertUnwindSafe(|| (self.target.body)(&input))) {
                Ok(accepted) => n_accepted += u64::from(accepted),
                Err(_) => {
                    let (name, path) = (self.target.name, self.save(number)?);
                    return Err(Failure::Panic {
                        name,
                        index: number,
                        path,
                    });
                }
            }
            if number == warm {
                resident_before = resident();
            }
        }
        let (resident_after, peak) = (resident(), memory("VmHWM:", std::process::id()));
        let kept = resident_after.saturating_sub(resident_before);
        let at_once = peak.saturating_sub(resident_first);
        for (most, got, when) in [
            (MOST_GROWTH, kept, "in the end"),
            (MOST_AT_ONCE, at_once, "for a while"),
        ] {
            let name = self.target.name;
            if got > most {
                return Err(Failure::Growth {
                    name,
                    most,
                    got,
                    when,
                });
            }
        }
        let elapsed = started.elapsed();
        Ok(Report {
            n_inputs,
            n_accepted,
            elapsed,
            resident_before,
            resident_after,
        })
    }

    /// Ends the process when an input takes too long: a loop without end cannot be stopped otherwise.
    fn watch(&self, index: &AtomicU64, is_over: &AtomicBool) {
        let mut last = (u64::MAX, Duration::ZERO, Instant::now());
        while !is_over.load(Ordering::Relaxed) {
            let (number, work) = (index.load(Ordering::Relaxed), processor_time());
            if number != last.0 {
                last = (number, work, Instant::now());
            } else if work.saturating_sub(last.1) > MOST_WORK || last.2.elapsed() > MOST_TIME {
                let path = self.save(number).unwrap_or_default();
                let (name, path) = (self.target.name, path.display());
                // Not a log: nobody is left to read one.
                let _ = std::io::Write::write_fmt(
                    &mut std::io::stderr(),
                    format_args!("{name}: input {number} takes too long; it is in {path}\n"),
                );
                std::process::exit(1);
            }
            park_timeout(Duration::from_millis(100));
        }
    }

    fn save(&self, index: u64) -> std::io::Result<PathBuf> {
        let name = format!("emberwatch-{}-{}-{index}", self.target.name, self.seed);
        let path = std::env::temp_dir().join(name);
        std::fs::write(&path, self.input(index))?;
        Ok(path)
    }
}

fn processor_time() -> Duration {
    let spent = clock_gettime(ClockId::ProcessCPUTime);
    Duration::try_from(spent).unwrap_or_default()
}

/// Memory of this process that is resident, KiB.
fn resident() -> u64 {
    memory("VmRSS:", std::process::id())
}

/// Lets the system count the most memory that was resident from here on.
fn forget_peak() {
    // Where this is not allowed the old peak stands, which is no smaller.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

/// A line of a process's `/proc/<pid>/status` that is in KiB; 0 if there is none.
pub fn memory(line: &str, pid: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let found = status.lines().find_map(|text| text.strip_prefix(line));
    found
        .and_then(|text| text.split_whitespace().next()?.parse().ok())
        .unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::super::{Kind, TARGETS};
    use super::*;
    use std::cell::RefCell;

    /// A target that is no decoder; its corpus is another's.
    fn target(body: fn(&[u8]) -> bool) -> Campaign {
        let (name, kind, seeds) = ("control_request", Kind::Message, TARGETS[0].seeds);
        Campaign::new(
            Target {
                name,
                kind,
                body,
                seeds,
            },
            1,
        )
        .expect("its corpus")
    }

    #[test]
    fn a_panic_is_told_and_its_input_saved() {
        let campaign = target(|bytes| {
            assert!(!bytes.contains(&b'\xff'), "no such byte");
            true
        });
        let Err(Failure::Panic { index, path, .. }) = campaign.run(100_000) else {
            panic!("expected a panic");
        };
        let saved = std::fs::read(&path).expect("the input");
        assert!(saved == campaign.input(index) && saved.contains(&b'\xff'));
        std::fs::remove_file(path).expect("clean up");
    }

    #[test]
    fn memory_that_is_kept_is_told() {
        thread_local! { static KEPT: RefCell<Vec<Vec<u8>>> = const { RefCell::new(Vec::new()) } }
        let keeps = |_: &[u8]| {
            KEPT.with_borrow_mut(|kept| kept.push(vec![1; 4 << 10]));
            true
        };
        let failure = target(keeps).run(4_000).expect_err("it grows");
        assert!(failure.to_string().contains("in the end"), "{failure}");
        KEPT.with_borrow_mut(Vec::clear);
    }
}
