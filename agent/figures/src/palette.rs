//! Colours of the figures, for a white background. They are distinguishable with all common kinds of colour blindness.

use std::fmt::{self, Display, Formatter};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Color(pub u8, pub u8, pub u8);

impl Display for Color {
    fn fmt(&self, out: &mut Formatter<'_>) -> fmt::Result {
        write!(out, "#{:02x}{:02x}{:02x}", self.0, self.1, self.2)
    }
}

/// Colour of text, error bars and the zero line.
pub const INK: Color = Color(0x33, 0x33, 0x33);

pub const MUTED: Color = Color(0x66, 0x66, 0x66);

pub const GRID: Color = Color(0xe4, 0xe4, 0xe4);

pub const PAPER: Color = Color(0xff, 0xff, 0xff);

/// Colour of the shaded area behind curves.
pub const SHADE: Color = Color(0xf7, 0xe6, 0xd8);

/// Colours of lines in order of use: Okabe and Ito (2008), but with brown instead of yellow, which is too light for a
/// line on white.
pub const LINES: [Color; 8] = [
    Color(0x00, 0x72, 0xb2),
    Color(0xd5, 0x5e, 0x00),
    Color(0x00, 0x9e, 0x73),
    Color(0xcc, 0x79, 0xa7),
    Color(0xe6, 0x9f, 0x00),
    Color(0x56, 0xb4, 0xe9),
    Color(0x33, 0x33, 0x33),
    Color(0x8c, 0x51, 0x0a),
];

/// ColorBrewer's YlGnBu (Apache-2.0), from light to dark. Its lightness decreases evenly, so it is readable in
/// greyscale.
const SEQUENTIAL: [Color; 9] = [
    Color(0xff, 0xff, 0xd9),
    Color(0xed, 0xf8, 0xb1),
    Color(0xc7, 0xe9, 0xb4),
    Color(0x7f, 0xcd, 0xbb),
    Color(0x41, 0xb6, 0xc4),
    Color(0x1d, 0x91, 0xc0),
    Color(0x22, 0x5e, 0xa8),
    Color(0x25, 0x34, 0x94),
    Color(0x08, 0x1d, 0x58),
];

/// Returns the colour of a probability, light for 0 and NaN. Values outside of `0..=1` are clamped.
pub fn sequential(probability: f32) -> Color {
    let last = SEQUENTIAL.len() - 1;
    let known = if probability.is_nan() {
        0.0
    } else {
        probability
    };
    let at = f64::from(known.clamp(0.0, 1.0)) * last as f64;
    let below = (at.floor() as usize).min(last - 1);
    blend(SEQUENTIAL[below], SEQUENTIAL[below + 1], at - below as f64)
}

/// Mixes two colours. The result is `from` if `fraction` is 0, and `to` if it is 1.
pub fn blend(from: Color, to: Color, fraction: f64) -> Color {
    let channel = |from: u8, to: u8| {
        let (from, to) = (f64::from(from), f64::from(to));
        (from + (to - from) * fraction).round() as u8
    };
    Color(
        channel(from.0, to.0),
        channel(from.1, to.1),
        channel(from.2, to.2),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn higher_probabilities_are_darker() {
        let light = |p: f32| {
            let Color(red, green, blue) = sequential(p);
            u32::from(red) * 2 + u32::from(green) * 7 + u32::from(blue)
        };
        for step in 0..20_u8 {
            let p = f32::from(step) / 20.0;
            assert!(light(p) > light(p + 0.05), "at {p}");
        }
        assert_eq!(sequential(7.0), SEQUENTIAL[8]);
        assert_eq!(sequential(f32::NAN), SEQUENTIAL[0]);
    }
}
