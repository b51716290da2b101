//! What is done to bytes: small damage that gets further into a decoder than noise does.
//!
//! Written here, 100 lines, as the libraries that do this on stable Rust bring a fuzzer of their own
//! (libafl, bolero), mutate typed values rather than bytes (mutatis), or are no longer kept
//! (byte-mutator, fuzzmutator).

use rand::RngExt;
use rand::seq::IndexedRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;
use std::ops::Range;

/// Longest result, bytes: longer than each file of the corpus.
const MOST_BYTES: usize = 1 << 15;

/// Integers at which lengths, counts and signs break.
const INTEGERS: [u64; 16] = [
    0,
    1,
    2,
    3,
    7,
    8,
    0x7f,
    0xff,
    0x100,
    0x7fff,
    0xffff,
    0x7fff_ffff,
    0xffff_ffff,
    1 << 53,
    i64::MAX as u64,
    u64::MAX,
];

/// Words that readers of TOML, JSON and numbers trip over.
const WORDS: [&str; 35] = [
    "0",
    "1",
    "-1",
    "-0.0",
    "255",
    "65536",
    "4294967296",
    "9007199254740993",
    "9223372036854775807",
    "18446744073709551615",
    "1e400",
    "1e-400",
    "1e308",
    "1e100",
    "1e30",
    "1e-30",
    "1e-320",
    "nan",
    "-inf",
    "inf",
    "null",
    "true",
    "\"",
    "\\u0000",
    "\\ud800",
    "\"\"\"",
    "{",
    "}",
    "[",
    "]",
    "[[",
    "=",
    ",",
    "\u{feff}",
    "é",
];

/// A damaged copy of one of `entries`, of which there is one at least.
pub fn mutated(rng: &mut ChaCha8Rng, entries: &[Vec<u8>]) -> Vec<u8> {
    let one = |rng: &mut ChaCha8Rng| entries.choose(rng).cloned().unwrap_or_default();
    let mut bytes = one(rng);
    // One change in half of the cases, two in a quarter, and so on.
    loop {
        if rng.random_ratio(1, 16) {
            let other = one(rng);
            let (from, to) = (range(rng, &other), range(rng, &bytes));
            bytes.splice(to, other[from].iter().copied());
        } else {
            damage(rng, &mut bytes);
        }
        if rng.random() {
            break;
        }
    }
    bytes.truncate(MOST_BYTES);
    bytes
}

fn damage(rng: &mut ChaCha8Rng, bytes: &mut Vec<u8>) {
    let at = rng.random_range(0..=bytes.len());
    match rng.random_range(0..10) {
        0 => bytes.truncate(at),
        1 => {
            let copied = bytes[range(rng, bytes)].to_vec();
            bytes.splice(at..at, copied);
        }
        2 => drop(bytes.drain(range(rng, bytes))),
        3 => {
            let mut noise = vec![0; rng.random_range(1..9)];
            rng.fill_bytes(&mut noise);
            bytes.splice(at..at, noise);
        }
        4 => {
            let word = WORDS.choose(rng).copied().unwrap_or_default();
            bytes.splice(at..at, word.bytes());
        }
        5 | 6 => {
            let word = WORDS.choose(rng).copied().unwrap_or_default();
            bytes.splice(number_after(bytes, at), word.bytes());
        }
        7 => {
            let integer = INTEGERS.choose(rng).copied().unwrap_or_default();
            let integer = integer
                .wrapping_add(u64::from(rng.random_range(0..3_u8)))
                .to_ne_bytes();
            let width = 1_usize << rng.random_range(0..4_u32);
            let at = at - at % width;
            let end = (at + width).min(bytes.len());
            bytes[at.min(end)..end].copy_from_slice(&integer[..end - at.min(end)]);
        }
        kind => {
            let Some(byte) = bytes.get_mut(at) else {
                return;
            };
            match kind {
                8 => *byte ^= 1_u8 << rng.random_range(0..8_u32),
                _ => *byte = rng.random(),
            }
        }
    }
}

/// A part of some bytes, mostly a short one.
fn range(rng: &mut ChaCha8Rng, bytes: &[u8]) -> Range<usize> {
    let start = rng.random_range(0..=bytes.len());
    let most = if rng.random_ratio(1, 4) {
        bytes.len()
    } else {
        8
    };
    start..(start + rng.random_range(0..=most)).min(bytes.len())
}

/// The first run of digits and points from some place on.
fn number_after(bytes: &[u8], at: usize) -> Range<usize> {
    let is_number = |byte: &u8| byte.is_ascii_digit() || *byte == b'.';
    let before = bytes[at..]
        .iter()
        .take_while(|byte| !is_number(byte))
        .count();
    let start = at + before;
    let length = bytes[start..]
        .iter()
        .take_while(|byte| is_number(byte))
        .count();
    start..start + length
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_chacha::rand_core::SeedableRng;

    #[test]
    fn damage_of_every_kind_is_done_to_entries_of_every_length() {
        let entries = [
            vec![],
            vec![7],
            b"lease = 12.5, seed = 3".to_vec(),
            vec![1; MOST_BYTES],
        ];
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let all: Vec<Vec<u8>> = (0..20_000).map(|_| mutated(&mut rng, &entries)).collect();
        assert!(all.iter().all(|bytes| bytes.len() <= MOST_BYTES));
        let some = |holds: fn(&[u8]) -> bool| all.iter().any(|bytes| holds(bytes));
        assert!(some(|bytes| bytes.is_empty()));
        assert!(some(|bytes| bytes.len() == MOST_BYTES));
        assert!(some(|bytes| bytes == b"lease = null, seed = 3"));
        assert!(some(
            |bytes| bytes.starts_with(b"lease = 12.5") && bytes.ends_with(&[1; 9])
        ));
        assert!(some(|bytes| bytes.len() == 1 && bytes[0] != 7));
    }

    #[test]
    fn the_same_seed_does_the_same_damage() {
        let entries = [b"abc 123 def".to_vec()];
        let run = |seed| mutated(&mut ChaCha8Rng::seed_from_u64(seed), &entries);
        assert!((0..100).all(|seed| run(seed) == run(seed)));
        assert!((0..100).any(|seed| run(seed) != run(0)));
    }
}
