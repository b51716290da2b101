//! The palette of films: every colour there is in them, and its number.

use crate::report::figures::palette::{INK, LINES, MUTED, PAPER, blend, sequential, unlike};
use plotters::style::RGBColor;
use protocol::Model;
use protocol::model::parse_color;

/// What was shown before stays: for what changes between two pictures.
pub const CLEAR: u8 = 0;
/// The background.
pub const BACKGROUND: u8 = 1;
/// Outlines.
pub const FRAME: u8 = 2;
/// Text from hardly there to full, of which the last is that of paths and robots.
const TEXT: u8 = 3;
/// Text that warns, likewise.
const WARNING: u8 = TEXT + LEVELS;
/// Probabilities and entropies from 0 to their most.
const SCALE: u8 = WARNING + LEVELS;
/// Not observed, or not recorded.
pub const UNKNOWN: u8 = SCALE + SHADES;
/// States, and behind them observations.
const STATES: u8 = UNKNOWN + 1;

/// Steps of a letter's edge.
const LEVELS: u8 = 6;
/// Steps of a probability: fewer make smaller files, more are not told apart.
const SHADES: u8 = 32;

/// How a text looks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Tone {
    /// As usual.
    Plain,
    /// As a warning.
    Warning,
}

/// The ink of paths and robots.
pub const PEN: u8 = TEXT + LEVELS - 1;

/// The colours of a model's films.
#[derive(Debug, Clone)]
pub struct Colors {
    palette: Vec<RGBColor>,
    n_states: u8,
    /// Whether observations are named and coloured as states are.
    pub is_plain: bool,
}

impl Colors {
    /// Those that a model names, and the films' own.
    pub fn of(model: &Model) -> Self {
        let file = model.file();
        let states: Vec<_> = file.states.iter().map(|it| (&it.name, &it.color)).collect();
        let seen = file.observations.iter();
        let seen: Vec<_> = seen.map(|it| (&it.name, &it.color)).collect();
        let of_model: Vec<RGBColor> = states.iter().chain(&seen).map(|it| color(it.1)).collect();
        let mut palette = vec![PAPER, PAPER, MUTED];
        let level = |level: u8| f64::from(level + 1) / f64::from(LEVELS);
        for ink in [INK, LINES[1]] {
            palette.extend((0..LEVELS).map(|at| blend(PAPER, ink, level(at))));
        }
        let shade = |at: u8| sequential(f32::from(at) / f32::from(SHADES - 1));
        palette.extend((0..SHADES).map(shade));
        palette.push(unlike(&of_model));
        palette.extend(of_model);
        Self {
            palette,
            n_states: states.len() as u8,
            is_plain: states == seen,
        }
    }

    /// All of them, by number.
    pub fn palette(&self) -> &[RGBColor] {
        &self.palette
    }

    /// Of a state; of none, that of what is not known.
    pub fn state(&self, state: u8) -> u8 {
        if state < self.n_states {
            STATES + state
        } else {
            UNKNOWN
        }
    }

    /// Of an observed value; of none, that of what is not known.
    pub fn observed(&self, value: u8) -> u8 {
        let n_values = self.palette.len() - usize::from(STATES + self.n_states);
        if usize::from(value) < n_values {
            STATES + self.n_states + value
        } else {
            UNKNOWN
        }
    }
}

/// Of a part of the most, `0..=1`.
pub fn shade(part: f32) -> u8 {
    SCALE + (part.clamp(0.0, 1.0) * f32::from(SHADES - 1)).round() as u8
}

/// Of a letter's edge that covers a part of a pixel; nothing where that is hardly any.
pub fn letter(coverage: f32, tone: Tone) -> Option<u8> {
    let first = match tone {
        Tone::Plain => TEXT,
        Tone::Warning => WARNING,
    };
    let level = (coverage.clamp(0.0, 1.0) * f32::from(LEVELS)).round() as u8;
    level.checked_sub(1).map(|level| first + level)
}

fn color(text: &str) -> RGBColor {
    let [red, green, blue] = parse_color(text).expect("invariant: a model's colours are checked");
    RGBColor(red, green, blue)
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::UNOBSERVED;
    use protocol::model::MAX_VALUES;

    #[test]
    fn every_palette_fits_a_byte() {
        assert!(usize::from(STATES) + 2 * MAX_VALUES <= 256);
        let colors = Colors::of(&Model::wildfire());
        assert_eq!(colors.palette().len(), usize::from(STATES) + 6);
        assert!(colors.is_plain);
    }

    #[test]
    fn numbers_stand_for_their_colours() {
        let colors = Colors::of(&Model::wildfire());
        let of = |number: u8| colors.palette()[usize::from(number)];
        assert_eq!([of(shade(0.0)), of(shade(2.0))], [0.0, 1.0].map(sequential));
        assert_eq!(of(letter(1.0, Tone::Plain).expect("ink")), INK);
        assert_eq!(of(letter(1.0, Tone::Warning).expect("ink")), LINES[1]);
        assert_eq!(letter(0.0, Tone::Plain), None);
        let fire = parse_color(&Model::wildfire().file().states[2].color).expect("a colour");
        let expected = RGBColor(fire[0], fire[1], fire[2]);
        assert_eq!([of(colors.state(2)), of(colors.observed(2))], [expected; 2]);
        assert_eq!([colors.state(3), colors.observed(UNOBSERVED)], [UNKNOWN; 2]);
    }
}
