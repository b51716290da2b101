//! The page of a chart: its size, colours, texts and ticks.
//!
//! Plotters rounds coordinates to whole numbers. Lengths are therefore in half pixels, so that curves are smooth.

use anyhow::Result;
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use std::ops::Range;

/// A page, or a part of it.
pub type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

pub const WIDTH: i32 = 1800;
pub const MARGIN: i32 = 44;
/// Height of the title and the note.
pub const HEAD: i32 = 150;

pub const LABEL: f64 = 26.0;
pub const NOTE: f64 = 25.0;
const TITLE: f64 = 38.0;

/// Colour of labels, error bars and the zero line.
pub const INK: RGBColor = RGBColor(0x33, 0x33, 0x33);
pub const MUTED: RGBColor = RGBColor(0x66, 0x66, 0x66);
pub const GRID: RGBColor = RGBColor(0xe4, 0xe4, 0xe4);

/// Width of an average letter relative to the text size. Fonts differ: this is between Noto Sans and DejaVu Sans.
const LETTER: f64 = 0.55;

/// Minimum range of an axis, and maximum absolute value on it. Beyond these limits, plotters finds no ticks.
const MIN_RANGE: f64 = 1e-15;
pub const MAX_VALUE: f64 = 1e100;

/// Starts a page with a title and a line of small print.
pub fn titled<'a>(svg: &'a mut String, height: i32, title: &str, note: &str) -> Result<Area<'a>> {
    let page = SVGBackend::with_string(svg, (WIDTH as u32, height as u32)).into_drawing_area();
    page.fill(&WHITE)?;
    let mut bold = style(TITLE, INK, HPos::Left);
    bold.font = bold.font.style(FontStyle::Bold);
    let title = fit(title, TITLE, WIDTH - 2 * MARGIN);
    page.draw_text(&title, &bold, (MARGIN, 56))?;
    let note = fit(note, NOTE, WIDTH - 2 * MARGIN);
    page.draw_text(&note, &style(NOTE, MUTED, HPos::Left), (MARGIN, 108))?;
    Ok(page)
}

/// Returns a finished page, whose size in pixels is half its size in units.
pub fn finish(svg: &str, height: i32) -> String {
    let units = format!("width=\"{WIDTH}\" height=\"{height}\"");
    let pixels = format!("width=\"{}\" height=\"{}\"", WIDTH / 2, height / 2);
    // Mitred joins would have spikes at sharp angles.
    svg.replacen(&units, &format!("{pixels} stroke-linejoin=\"round\""), 1)
}

/// Returns the style of a text that is vertically centred at its position.
pub fn style(size: f64, color: RGBColor, align: HPos) -> TextStyle<'static> {
    TextStyle {
        // Plotters writes a font size of 1 / 1.24 of the given size.
        font: FontDesc::new(FontFamily::SansSerif, 1.24 * size, FontStyle::Normal),
        color: color.to_backend_color(),
        pos: Pos::new(align, VPos::Center),
    }
}

/// Returns about the width of a text.
pub fn width(text: &str, size: f64) -> i32 {
    (text.chars().count() as f64 * LETTER * size) as i32
}

/// Shortens a text to about `room`, with an ellipsis. Control characters, invalid in XML, become spaces.
pub fn fit(text: &str, size: f64, room: i32) -> String {
    let printable = |letter: char| match letter {
        '\u{fffe}' | '\u{ffff}' => ' ',
        letter if letter.is_control() => ' ',
        letter => letter,
    };
    let text: String = text.chars().map(printable).collect();
    let n_letters = (f64::from(room) / (LETTER * size)) as usize;
    if text.chars().count() <= n_letters {
        return text;
    }
    let kept: String = text.chars().take(n_letters.saturating_sub(1)).collect();
    format!("{}…", kept.trim_end())
}

pub fn is_drawable(value: f64) -> bool {
    value.abs() <= MAX_VALUE
}

/// Returns the range of an axis that covers zero and all drawable values, with a margin.
pub fn covering(values: impl Iterator<Item = f64>) -> Range<f64> {
    let values = values.filter(|&value| is_drawable(value));
    let (least, most) = values.fold((0.0_f64, 0.0_f64), |(least, most), value| {
        (least.min(value), most.max(value))
    });
    if most - least < MIN_RANGE {
        return 0.0..1.0;
    }
    let margin = 0.04 * (most - least);
    let least = if least < 0.0 { least - margin } else { 0.0 };
    least..if most > 0.0 { most + margin } else { 0.0 }
}

/// Returns a tick's label.
pub fn tick(value: &f64) -> String {
    if *value == 0.0 || (1e-4..1e6).contains(&value.abs()) {
        return format!("{}", (value * 1e6).round() / 1e6);
    }
    let rounded = format!("{value:.2e}").parse::<f64>();
    rounded.map_or(String::new(), |rounded| format!("{rounded:e}"))
}

/// Returns a darker shade of a colour, which is readable as text on white.
pub fn darker(RGBColor(red, green, blue): RGBColor) -> RGBColor {
    let [red, green, blue] = [red, green, blue].map(|channel| (f64::from(channel) * 0.75) as u8);
    RGBColor(red, green, blue)
}
