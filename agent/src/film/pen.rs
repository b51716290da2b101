//! Letters and discs in pictures of few colours.

use super::colors::{Tone, letter};
use crate::report::figures::text::{self, Weight};
use crate::report::picture::Picture;

/// Pixels per em.
pub const TEXT: f32 = 13.0;
/// The same of a title.
pub const TITLE: f32 = 16.0;

/// A point, pixels from the left and from the top.
pub type Point = (usize, usize);

/// Writes a text whose capitals are centred on the height of `at`.
pub fn write(picture: &mut Picture, at: Point, (size, tone): (f32, Tone), text: &str) {
    ink(picture, at, (size, Weight::Regular, tone), text);
}

/// The same, larger and bold; returns where it ends.
pub fn write_bold(picture: &mut Picture, at: Point, text: &str) -> usize {
    ink(picture, at, (TITLE, Weight::Bold, Tone::Plain), text);
    at.0 + text::width(text, TITLE, Weight::Bold).ceil() as usize
}

fn ink(picture: &mut Picture, at: Point, (size, weight, tone): (f32, Weight, Tone), text: &str) {
    let start = (at.0 as f32, at.1 as f32);
    text::rasterize(text, start, size, weight, |x, y, coverage| {
        if let (Ok(x), Ok(y), Some(color)) = (
            usize::try_from(x),
            usize::try_from(y),
            letter(coverage, tone),
        ) {
            picture.fill((x, y), (1, 1), color);
        }
    });
}

/// The text, shortened where it is wider than `room` pixels.
pub fn fit(text: &str, room: usize) -> String {
    text::fit(text, room as f32, TEXT, Weight::Regular)
}

/// Fills a disc.
pub fn disc(picture: &mut Picture, center: Point, radius: isize, color: u8) {
    for y in -radius..=radius {
        for x in -radius..=radius {
            // A quarter more than the radius: rounder at these sizes.
            if x * x + y * y <= radius * radius + radius / 2 {
                let at = (
                    center.0.checked_add_signed(x),
                    center.1.checked_add_signed(y),
                );
                if let (Some(x), Some(y)) = at {
                    picture.fill((x, y), (1, 1), color);
                }
            }
        }
    }
}
