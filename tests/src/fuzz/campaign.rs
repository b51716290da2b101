//! Many mutations of a target's corpus, watched: an input that panics, hangs or grows is named and saved.
//!
//! Input `i` of a seed is the same on every run, so that the same command meets the same failure.

use super::mutation::mutated;
use super::target::Target;
use crate::meter::memory;
use anyhow::{Result, bail, ensure};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rustix::time::{ClockId, clock_gettime};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::{Builder, park_timeout};
use std::time::{Duration, Instant};

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
    pub n_inputs: u64,
    pub n_accepted: u64,
    pub elapsed: Duration,
    /// Memory resident after the first tenth, KiB.
    pub resident_before: u64,
    /// Memory resident at the end, KiB.
    pub resident_after: u64,
}

impl Campaign {
    pub fn new(target: Target, seed: u64) -> Result<Self> {
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
    /// If one makes the decoder panic or keep memory, or a file cannot be read or written.
    pub fn run(&self, n_inputs: u64) -> Result<Report> {
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

    fn decode_all(&self, n_inputs: u64, index: &AtomicU64) -> Result<Report> {
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
                    let path = path.display();
                    bail!("{name}: input {number} panics; it is in {path}");
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
            ensure!(
                got <= most,
                "{name}: expected memory to grow by at most {most} KiB, got {got} {when}"
            );
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

#[cfg(test)]
mod tests {
    use super::super::Kind;
    use super::*;
    use std::cell::RefCell;

    /// A target that is no decoder; its corpus is another's.
    fn target(body: fn(&[u8]) -> bool) -> Campaign {
        let target = Target {
            name: "control_request",
            kind: Kind::Message,
            body,
            seeds: Vec::new,
        };
        Campaign::new(target, 1).expect("its corpus")
    }

    #[test]
    fn a_panic_is_told_and_its_input_saved() {
        let campaign = target(|bytes| {
            assert!(!bytes.contains(&b'\xff'), "no such byte");
            true
        });
        let failure = campaign.run(100_000).expect_err("a panic").to_string();
        let (told, path) = failure.split_once(" panics; it is in ").expect(&failure);
        let (_, index) = told.rsplit_once(' ').expect("its number");
        let index = index.parse().expect("a number");
        let saved = std::fs::read(path).expect("the input");
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
