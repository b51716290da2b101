//! Runs every decoder on the files of its corpus and on damaged copies of these files. This is a separate test program,
//! because it measures the memory of its process.
//!
//! Each decoder gets 10 * `PROPTEST_CASES` copies, by default 2,560. `fuzz/` has coverage-guided fuzzers of the same
//! decoders.

use proptest::collection::vec;
use proptest::prelude::*;
use proptest::sample::select;
use proptest::test_runner::{Config, FileFailurePersistence, TestCaseError, TestRng, TestRunner};
use rustix::time::{ClockId, Timespec, clock_gettime};
use std::cell::Cell;
use tests::fuzz::{TARGETS, Target};
use tests::meter::memory;

/// Maximum length of a damaged file, in bytes. Every undamaged file of the corpus is shorter.
const MAX_BYTES: usize = 1 << 15;

/// Maximum processor time for one input, in seconds.
const MAX_SECONDS: i64 = 1;

/// Maximum growth of the process's peak memory over all inputs of a decoder, in KiB.
const MAX_GROWTH: u64 = 64 << 10;

/// Integers at the limits of lengths, counts and signs. For each integer n, the tests also use n + 1 and n + 2.
#[rustfmt::skip]
const INTEGERS: [u64; 9] =
    [0, 7, 0x7f, 0xff, 0x7fff, 0xffff, 0x7fff_ffff, 0xffff_ffff, u64::MAX >> 1];

/// Tokens that are difficult for parsers of TOML, JSON and numbers.
const WORDS: &str = r#"0 1 -1 -0.0 255 65536 4294967296 9007199254740993 9223372036854775807 18446744073709551615 1e400
    1e-400 1e308 1e100 1e30 1e-30 1e-320 nan -inf inf null true " \u0000 \ud800 """ { } [ ] [[ = , é"#;

/// Replaces a range of bytes with other bytes. The position is any integer, taken modulo the length of the file.
#[derive(Debug, Clone)]
struct Change {
    at: usize,
    n_removed: usize,
    inserted: Vec<u8>,
}

fn change(files: Vec<Vec<u8>>) -> impl Strategy<Value = Change> + Clone {
    let words: Vec<&str> = WORDS.split_whitespace().collect();
    let word = select(words).prop_map(|word| word.as_bytes().to_vec());
    let part = (select(files), any::<usize>(), 1..64_usize).prop_map(|(file, at, length)| {
        let at = at % (file.len() + 1);
        file[at..file.len().min(at + length)].to_vec()
    });
    let integer = (select(&INTEGERS), 0..3_u64, 0..4_u32).prop_map(|(number, more, power)| {
        number.wrapping_add(more).to_ne_bytes()[..1 << power].to_vec()
    });
    let inserted = prop_oneof![4 => vec(any::<u8>(), 0..9), 3 => word, 1 => part];
    let n_removed = prop_oneof![4 => Just(0_usize), 8 => 0..9_usize, 1 => 9..MAX_BYTES];
    let overwritten = integer.prop_map(|inserted| (inserted.len(), inserted));
    let replaced = prop_oneof![3 => (n_removed, inserted), 2 => overwritten];
    (any::<usize>(), replaced).prop_map(|(at, (n_removed, inserted))| Change {
        at,
        n_removed,
        inserted,
    })
}

fn apply(change: &Change, bytes: &mut Vec<u8>) {
    let at = change.at % (bytes.len() + 1);
    let end = bytes.len().min(at + change.n_removed);
    bytes.splice(at..end, change.inserted.iter().copied());
    bytes.truncate(MAX_BYTES);
}

/// Decodes one input and returns whether the decoder accepted it.
fn decode(target: &Target, bytes: &[u8]) -> Result<bool, TestCaseError> {
    let start = clock_gettime(ClockId::ThreadCPUTime);
    let is_accepted = (target.body)(bytes);
    let Timespec { tv_sec, .. } = clock_gettime(ClockId::ThreadCPUTime) - start;
    prop_assert!(tv_sec < MAX_SECONDS, "{} took over a second", target.name);
    Ok(is_accepted)
}

fn attack(target: &Target) {
    let name = target.name;
    let files = target.corpus().expect(name);
    // Resets the peak of the memory. If that is not allowed, the old peak, which is at least as large, remains.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
    let before = memory("VmHWM:", std::process::id());
    let is_good = |file: &&Vec<u8>| decode(target, file).expect(name);
    let n_good = files.iter().filter(is_good).count();
    assert!(
        2 * n_good >= files.len(),
        "{name}: {n_good} of {} files are accepted",
        files.len()
    );
    let config = Config {
        cases: 10 * Config::default().cases,
        failure_persistence: Some(Box::new(FileFailurePersistence::Off)),
        ..Config::default()
    };
    let rng = TestRng::deterministic_rng(config.rng_algorithm);
    let (n_inputs, n_accepted) = (config.cases, Cell::new(0));
    let inputs =
        (select(files.clone()), vec(change(files), 1..5)).prop_map(|(mut file, changes)| {
            changes.iter().for_each(|change| apply(change, &mut file));
            file
        });
    let outcome = TestRunner::new_with_rng(config, rng).run(&inputs, |input| {
        n_accepted.set(n_accepted.get() + u32::from(decode(target, &input)?));
        Ok(())
    });
    outcome.unwrap_or_else(|failure| panic!("{name}: {failure}"));
    let growth = memory("VmHWM:", std::process::id()).saturating_sub(before);
    assert!(growth <= MAX_GROWTH, "{name}: memory grew by {growth} KiB");
    let n_accepted = n_accepted.get();
    assert!(
        (n_inputs / 500..n_inputs).contains(&n_accepted),
        "{name}: {n_accepted} accepted"
    );
}

#[test]
fn every_decoder_survives_damaged_files() {
    TARGETS.iter().for_each(attack);
}
