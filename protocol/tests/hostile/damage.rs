//! Damage done to valid texts, which gets further into a decoder than noise does.

use proptest::prelude::*;
use proptest::sample::{Index, select};
use std::ops::Range;

/// Numbers that break what is not checked.
pub const NUMBERS: [&str; 20] = [
    "nan",
    "-nan",
    "inf",
    "-inf",
    "1e308",
    "1e200",
    "1e101",
    "1e100",
    "1e30",
    "1e-30",
    "1e-45",
    "1e-100",
    "1e-101",
    "1e-320",
    "-1e-320",
    "-0.0",
    "0",
    "1",
    "-1",
    "9223372036854775807",
];

/// Words that TOML and JSON readers trip over.
const SNIPPETS: [&str; 14] = [
    "[[[[",
    "]]]]",
    "{",
    "}",
    "\"",
    "\u{0}",
    "\u{feff}",
    "é",
    "\n[[kernel]]\n",
    "= =",
    "null",
    "\"\"\"",
    "\\u0000",
    "kernel_size = [15, 15]\n",
];

/// What to do to a text: replace a range by a snippet or a number.
#[derive(Debug, Clone)]
pub struct Damage {
    at: Index,
    length: usize,
    by: String,
    /// Replace the first number from there on, rather than a range.
    number: bool,
}

/// Random damage.
pub fn damage() -> impl Strategy<Value = Damage> {
    let by = prop_oneof![
        6 => select(&NUMBERS[..]).prop_map(str::to_owned),
        2 => select(&SNIPPETS[..]).prop_map(str::to_owned),
        1 => ".{0,4}",
    ];
    (any::<Index>(), 0usize..6, by, prop::bool::weighted(0.7)).prop_map(
        |(at, length, by, number)| Damage {
            at,
            length,
            by,
            number,
        },
    )
}

/// A text after damage.
pub fn damaged(text: String, damage: &Damage) -> String {
    let mut chars: Vec<char> = text.chars().collect();
    let start = damage.at.index(chars.len() + 1);
    let range = match damage.number {
        true => number_after(&chars, start),
        false => start..(start + damage.length).min(chars.len()),
    };
    chars.splice(range, damage.by.chars());
    chars.into_iter().collect()
}

fn number_after(chars: &[char], start: usize) -> Range<usize> {
    let is_number = |c: &char| c.is_ascii_digit() || *c == '.';
    let first = chars[start..].iter().position(is_number);
    let first = first.map_or(chars.len(), |offset| start + offset);
    let length = chars[first..].iter().take_while(|c| is_number(c)).count();
    first..first + length
}
