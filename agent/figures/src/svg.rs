//! A white page to draw on, which is written as SVG text. Coordinates are in points from the upper left corner.

use crate::palette::{Color, PAPER};
use crate::text::{CAP_HEIGHT, FAMILY, TextStyle};
use std::fmt::Write;

/// Width of every page in points.
pub const WIDTH: f64 = 1200.0;

/// Empty margin of every page in points.
pub const MARGIN: f64 = 32.0;

/// A position in points: distance from the left edge, and from the upper edge.
pub type Point = (f64, f64);

/// The text anchor: which part of a text (start, middle or end) is placed at the given horizontal position.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Align {
    Left,
    Center,
    Right,
}

/// A page. Later elements cover earlier ones.
#[derive(Debug, Default)]
pub struct Svg {
    body: String,
}

impl Svg {
    pub fn new() -> Self {
        Self::default()
    }

    /// Creates a page with a title and a line of small print.
    pub fn titled(title: &str, note: &str) -> Self {
        let mut page = Self::new();
        for (y, style, text) in [
            (36.0, TextStyle::TITLE, title),
            (64.0, TextStyle::NOTE, note),
        ] {
            let text = style.fit(text, WIDTH - 2.0 * MARGIN);
            page.text((MARGIN, y), Align::Left, style, &text);
        }
        page
    }

    /// Returns the SVG text of the page, with the given size in points.
    pub fn finish(self, width: f64, height: f64) -> String {
        // Round joins, because mitred joins have spikes at sharp angles. Spaces are preserved, because the computed
        // text widths include them.
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
             viewBox=\"0 0 {width} {height}\" font-family=\"{FAMILY}\" \
             stroke-linejoin=\"round\" xml:space=\"preserve\">\n\
             <rect width=\"{width}\" height=\"{height}\" fill=\"{PAPER}\"/>\n{}</svg>\n",
            self.body
        )
    }

    /// Fills a rectangle. Its edges are aligned to half points, which are whole pixels on a screen with two pixels per
    /// point.
    pub fn rectangle(&mut self, from: Point, to: Point, color: Color) {
        let [left, top, right, bottom] = [from.0, from.1, to.0, to.1].map(on_pixel);
        if right > left && bottom > top {
            self.add(format_args!(
                "<rect x=\"{left}\" y=\"{top}\" width=\"{}\" height=\"{}\" fill=\"{color}\"/>",
                right - left,
                bottom - top
            ));
        }
    }

    /// Draws a horizontal or vertical line.
    pub fn rule(&mut self, from: Point, to: Point, width: f64, color: Color) {
        let half = width / 2.0;
        let along = |a: f64, b: f64| if a == b { (a - half, a + half) } else { (a, b) };
        let ((left, right), (top, bottom)) = (along(from.0, to.0), along(from.1, to.1));
        self.rectangle((left, top), (right, bottom), color);
    }

    pub fn line(&mut self, points: &[Point], width: f64, color: Color) {
        if points.len() > 1 {
            self.add(format_args!(
                "<polyline points=\"{}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"{width}\"/>",
                list(points)
            ));
        }
    }

    /// Fills a polygon. It is translucent if `opacity` is below 1.
    pub fn polygon(&mut self, points: &[Point], color: Color, opacity: f64) {
        let points = list(points);
        self.add(format_args!(
            "<polygon points=\"{points}\" fill=\"{color}\" fill-opacity=\"{opacity}\"/>"
        ));
    }

    pub fn disc(&mut self, (x, y): Point, radius: f64, color: Color) {
        let (x, y) = (short(x), short(y));
        self.add(format_args!(
            "<circle cx=\"{x}\" cy=\"{y}\" r=\"{radius}\" fill=\"{color}\"/>"
        ));
    }

    /// Draws a text whose capitals are vertically centred at `at`.
    pub fn text(&mut self, at: Point, align: Align, style: TextStyle, text: &str) {
        if text.is_empty() {
            return;
        }
        let width = style.width(text);
        let start = match align {
            Align::Left => at.0,
            Align::Center => at.0 - width / 2.0,
            Align::Right => at.0 - width,
        };
        // Viewers stretch the text to the width used in the layout, whichever font they have.
        let length = format!(
            " textLength=\"{}\" lengthAdjust=\"spacingAndGlyphs\"",
            short(width)
        );
        let baseline = short(at.1 + style.size * CAP_HEIGHT / 2.0);
        let at = format!("x=\"{}\" y=\"{baseline}\"", short(start));
        let element = style.element(&at, &length, text);
        self.add(format_args!("{element}"));
    }

    fn add(&mut self, element: std::fmt::Arguments<'_>) {
        let _ = writeln!(self.body, "{element}");
    }
}

fn list(points: &[Point]) -> String {
    let mut list = String::new();
    for &(x, y) in points {
        let _ = write!(list, "{},{} ", short(x), short(y));
    }
    list
}

/// Rounds to two decimals. Non-finite values become 0, so that the file remains valid.
fn short(number: f64) -> f64 {
    if number.is_finite() {
        (number * 100.0).round() / 100.0
    } else {
        0.0
    }
}

fn on_pixel(number: f64) -> f64 {
    short((number * 2.0).round() / 2.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::palette::INK;
    use roxmltree::Document;

    #[test]
    fn texts_are_escaped_and_read_back() {
        let mut page = Svg::new();
        let text = "a < b & \"c\" > d\u{0}\u{1b}\n\u{ffff} 'ü 火'";
        page.text((0.0, 10.0), Align::Left, TextStyle::LABEL, text);
        let svg = page.finish(10.0, 20.0);
        let document = Document::parse(&svg).expect("XML");
        let found = document
            .descendants()
            .find(|node| node.has_tag_name("text"));
        let read = found.and_then(|node| node.text());
        assert_eq!(read, Some("a < b & \"c\" > d    'ü 火'"));
    }

    #[test]
    fn non_finite_values_are_not_written() {
        let mut page = Svg::new();
        let none = (f64::NAN, f64::INFINITY);
        page.line(&[none, none], 1.0, INK);
        page.rectangle(none, (1e300, 1e300), INK);
        page.disc(none, 1.0, INK);
        let svg = page.finish(10.0, 20.0);
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }
}
