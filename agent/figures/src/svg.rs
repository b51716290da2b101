//! A white page to draw on, in points from its upper left corner; it becomes the text of an SVG file.

use crate::palette::{Color, PAPER};
use crate::text::{CAP_HEIGHT, FAMILY, TextStyle};
use std::fmt::Write;

/// Width of every page in points.
pub const WIDTH: f64 = 1200.0;

/// Empty rim of every page in points.
pub const MARGIN: f64 = 32.0;

/// A position in points: right of the left edge, below the upper edge.
pub type Point = (f64, f64);

/// Neighbouring squares of one colour: the left upper corner of the first, and how many there are.
pub type Run = (Point, usize);

/// Where a text's horizontal position lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Align {
    Left,
    Center,
    Right,
}

/// The page. What is drawn later lies over what was drawn before.
#[derive(Debug, Default)]
pub struct Svg {
    body: String,
}

impl Svg {
    pub fn new() -> Self {
        Self::default()
    }

    /// A page with a title and a line of small print.
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

    /// The text of a page of this size in points.
    pub fn finish(self, width: f64, height: f64) -> String {
        // Round joints, as mitred ones grow spikes at sharp angles. A space at the beginning of a text counts
        // in its width.
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
             viewBox=\"0 0 {width} {height}\" font-family=\"{FAMILY}\" \
             stroke-linejoin=\"round\" xml:space=\"preserve\">\n\
             <rect width=\"{width}\" height=\"{height}\" fill=\"{PAPER}\"/>\n{}</svg>\n",
            self.body
        )
    }

    /// Fills a rectangle, its edges on half points: whole pixels of a screen with two a point.
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

    /// Outlines a rectangle, inside its bounds.
    pub fn outline(&mut self, from: Point, to: Point, width: f64, color: Color) {
        self.rectangle(from, (to.0, from.1 + width), color);
        self.rectangle((from.0, to.1 - width), to, color);
        self.rectangle(from, (from.0 + width, to.1), color);
        self.rectangle((to.0 - width, from.1), to, color);
    }

    /// A line along a row or a column of the page.
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

    /// Fills a polygon through which what is under it is seen, unless `opacity` is 1.
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

    pub fn squares(&mut self, runs: &[Run], side: f64, color: Color) {
        let mut path = String::new();
        for &((x, y), n) in runs {
            let width = side * n as f64;
            // Writing to a string cannot fail.
            let _ = write!(path, "M{x} {y}h{width}v{side}h-{width}z");
        }
        self.add(format_args!(
            "<path fill=\"{color}\" shape-rendering=\"crispEdges\" d=\"{path}\"/>"
        ));
    }

    /// Writes a text whose capitals are centred on the height of `at`.
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
        // As wide as the layout counts on in whatever font the viewer has.
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

/// Two decimals are enough; a number that is none must not reach a file.
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
    fn numbers_that_are_none_reach_no_file() {
        let mut page = Svg::new();
        let none = (f64::NAN, f64::INFINITY);
        page.line(&[none, none], 1.0, INK);
        page.rectangle(none, (1e300, 1e300), INK);
        page.disc(none, 1.0, INK);
        let svg = page.finish(10.0, 20.0);
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }
}
