//! Colours of the figures: few, apart under every common colour blindness, on white.

use plotters::style::RGBColor;

/// Text, error bars and the zero line.
pub const INK: RGBColor = RGBColor(0x33, 0x33, 0x33);

/// Secondary text.
pub const MUTED: RGBColor = RGBColor(0x66, 0x66, 0x66);

/// Grid lines.
pub const GRID: RGBColor = RGBColor(0xe4, 0xe4, 0xe4);

/// The figure's background.
pub const PAPER: RGBColor = RGBColor(0xff, 0xff, 0xff);

/// Light area behind a line plot.
pub const SHADE: RGBColor = RGBColor(0xf7, 0xe6, 0xd8);

/// Lines in the order of use: Okabe and Ito (2008), with brown for their yellow, which is too
/// light for a line on white.
pub const LINES: [RGBColor; 8] = [
    RGBColor(0x00, 0x72, 0xb2),
    RGBColor(0xd5, 0x5e, 0x00),
    RGBColor(0x00, 0x9e, 0x73),
    RGBColor(0xcc, 0x79, 0xa7),
    RGBColor(0xe6, 0x9f, 0x00),
    RGBColor(0x56, 0xb4, 0xe9),
    RGBColor(0x33, 0x33, 0x33),
    RGBColor(0x8c, 0x51, 0x0a),
];

/// ColorBrewer's YlGnBu (Apache-2.0), light to dark: its lightness falls evenly, so that it also
/// reads in grey.
const SEQUENTIAL: [RGBColor; 9] = [
    RGBColor(0xff, 0xff, 0xd9),
    RGBColor(0xed, 0xf8, 0xb1),
    RGBColor(0xc7, 0xe9, 0xb4),
    RGBColor(0x7f, 0xcd, 0xbb),
    RGBColor(0x41, 0xb6, 0xc4),
    RGBColor(0x1d, 0x91, 0xc0),
    RGBColor(0x22, 0x5e, 0xa8),
    RGBColor(0x25, 0x34, 0x94),
    RGBColor(0x08, 0x1d, 0x58),
];

/// Greys that may stand for "not observed", the preferred one first.
const NEUTRALS: [u8; 4] = [0xe2, 0xb8, 0x80, 0x48];

/// Squared distance at which two colours are told apart at a glance: 60 of 255 in each channel.
const APART: i32 = 3 * 60 * 60;

/// Colour of a probability, light for 0; values outside `0..=1` are clamped.
pub fn sequential(probability: f32) -> RGBColor {
    let last = SEQUENTIAL.len() - 1;
    let at = f64::from(probability.clamp(0.0, 1.0)) * last as f64;
    let below = (at.floor() as usize).min(last - 1);
    blend(SEQUENTIAL[below], SEQUENTIAL[below + 1], at - below as f64)
}

/// A grey unlike all the given colours: the first that is well apart from them, else the furthest.
pub fn unlike(colors: &[RGBColor]) -> RGBColor {
    let grey = |level: u8| RGBColor(level, level, level);
    let nearest = |level: u8| {
        let distances = colors.iter().map(|&color| distance(color, grey(level)));
        distances.min().unwrap_or(i32::MAX)
    };
    let apart = NEUTRALS.into_iter().find(|&level| nearest(level) >= APART);
    let level = apart.or_else(|| NEUTRALS.into_iter().max_by_key(|&level| nearest(level)));
    grey(level.expect("invariant: there are neutrals"))
}

/// `from` at `fraction` 0, `to` at 1.
pub fn blend(from: RGBColor, to: RGBColor, fraction: f64) -> RGBColor {
    let channel = |from: u8, to: u8| {
        let (from, to) = (f64::from(from), f64::from(to));
        (from + (to - from) * fraction).round() as u8
    };
    RGBColor(
        channel(from.0, to.0),
        channel(from.1, to.1),
        channel(from.2, to.2),
    )
}

fn distance(a: RGBColor, b: RGBColor) -> i32 {
    let channel = |a: u8, b: u8| (i32::from(a) - i32::from(b)).pow(2);
    channel(a.0, b.0) + channel(a.1, b.1) + channel(a.2, b.2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn higher_probabilities_are_darker() {
        let light = |p: f32| {
            let RGBColor(red, green, blue) = sequential(p);
            u32::from(red) * 2 + u32::from(green) * 7 + u32::from(blue)
        };
        for step in 0..20_u8 {
            let p = f32::from(step) / 20.0;
            assert!(light(p) > light(p + 0.05), "at {p}");
        }
        assert_eq!(sequential(f32::NAN.max(7.0)), SEQUENTIAL[8]);
    }

    #[test]
    fn the_unobserved_grey_avoids_the_states() {
        assert_eq!(unlike(&[RGBColor(0, 0, 0)]), RGBColor(0xe2, 0xe2, 0xe2));
        let greys = [RGBColor(0xff, 0xff, 0xff), RGBColor(0xb0, 0xb0, 0xb0)];
        assert_eq!(unlike(&greys), RGBColor(0x48, 0x48, 0x48));
    }
}
