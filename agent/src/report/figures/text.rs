//! Text of the figures: Noto Sans from bytes inside the program, so that no font need be installed.
//!
//! The crate `notosans` ships Noto Sans Regular and Bold with their licence, the SIL Open Font
//! License 1.1. Glyphs are placed here, at fractions of a pixel, because plotters' own placement
//! drops their side bearings and so spaces letters unevenly.

use ab_glyph::{Font, FontRef, PxScale, ScaleFont, point};
use std::sync::LazyLock;

/// Height of a capital letter as a fraction of the text size (Noto Sans, OS/2 table: 714 / 1000).
pub const CAP_HEIGHT: f32 = 0.714;

/// What is put in place of the end of a text that is too long.
const ELLIPSIS: char = '…';

static REGULAR: LazyLock<FontRef<'static>> = LazyLock::new(|| font(notosans::REGULAR_TTF));
static BOLD: LazyLock<FontRef<'static>> = LazyLock::new(|| font(notosans::BOLD_TTF));

/// Weight of a text.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Weight {
    /// Labels and captions.
    Regular,
    /// Titles.
    Bold,
}

/// Width of a text in pixels at `size` pixels per em.
pub fn width(text: &str, size: f32, weight: Weight) -> f32 {
    let font = face(weight).as_scaled(scale(weight, size));
    let mut end = 0.0;
    let mut before = None;
    for glyph in text.chars().map(|letter| font.glyph_id(letter)) {
        end += before.map_or(0.0, |before| font.kern(before, glyph)) + font.h_advance(glyph);
        before = Some(glyph);
    }
    end
}

/// The text, or as much of its start as fits into `room` pixels with an ellipsis.
pub fn fit(text: &str, room: f32, size: f32, weight: Weight) -> String {
    if width(text, size, weight) <= room {
        return text.into();
    }
    let mut short: String = text.into();
    while short.pop().is_some() {
        let candidate = format!("{}{ELLIPSIS}", short.trim_end());
        if width(&candidate, size, weight) <= room {
            return candidate;
        }
    }
    String::new()
}

/// Calls `pixel(x, y, coverage)` for each pixel of a text that starts at `x` and whose capitals are
/// centred on `middle`.
pub fn rasterize(
    text: &str,
    (x, middle): (f32, f32),
    size: f32,
    weight: Weight,
    mut pixel: impl FnMut(i32, i32, f32),
) {
    let scale = scale(weight, size);
    let font = face(weight).as_scaled(scale);
    let baseline = (middle + size * CAP_HEIGHT / 2.0).round();
    let mut at = x;
    let mut before = None;
    for glyph in text.chars().map(|letter| font.glyph_id(letter)) {
        at += before.map_or(0.0, |before| font.kern(before, glyph));
        let placed = glyph.with_scale_and_position(scale, point(at, baseline));
        if let Some(outline) = face(weight).outline_glyph(placed) {
            let corner = outline.px_bounds().min;
            let (left, top) = (corner.x as i32, corner.y as i32);
            outline.draw(|dx, dy, coverage| pixel(left + dx as i32, top + dy as i32, coverage));
        }
        at += font.h_advance(glyph);
        before = Some(glyph);
    }
}

fn font(bytes: &'static [u8]) -> FontRef<'static> {
    FontRef::try_from_slice(bytes).expect("invariant: the embedded font is valid, as a test shows")
}

fn face(weight: Weight) -> &'static FontRef<'static> {
    match weight {
        Weight::Regular => &REGULAR,
        Weight::Bold => &BOLD,
    }
}

/// `ab_glyph` scales by ascent minus descent; `size` is pixels per em, as everywhere else.
fn scale(weight: Weight, size: f32) -> PxScale {
    let face = face(weight);
    let em = face.units_per_em().unwrap_or(1000.0);
    PxScale::from(size * face.height_unscaled() / em)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_faces_have_the_glyphs_that_figures_use() {
        for weight in [Weight::Regular, Weight::Bold] {
            for letter in "aZ09 .,;:()±…×-–_%=".chars() {
                assert_ne!(face(weight).glyph_id(letter).0, 0, "{letter:?} {weight:?}");
            }
        }
    }

    #[test]
    fn long_texts_are_shortened_to_fit() {
        let text = "a policy with a very long name";
        let short = fit(text, 100.0, 14.0, Weight::Regular);
        assert!(short.ends_with(ELLIPSIS) && width(&short, 14.0, Weight::Regular) <= 100.0);
        assert_eq!(fit(text, 1000.0, 14.0, Weight::Regular), text);
        assert_eq!(fit(text, 0.0, 14.0, Weight::Regular), "");
    }
}
