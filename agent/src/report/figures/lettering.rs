//! The texts of an SVG page: text, not outlines, as wide as the layout counts on in whatever font the
//! viewer has.

use super::canvas::{SCALE, TextStyle};
use super::text::{CAP_HEIGHT, Weight};
use plotters::style::RGBColor;
use std::fmt::Write;

/// The figures' font, and what is near it.
const FAMILY: &str = "Noto Sans, Open Sans, DejaVu Sans, Arial, sans-serif";

/// Texts in the order in which they are written.
#[derive(Debug, Default)]
pub struct Lettering(String);

impl Lettering {
    /// Adds a text that starts at `x` and whose capitals are centred on `middle`, in pixels.
    pub fn add(&mut self, text: &str, (x, middle): (f32, f32), style: TextStyle) {
        let size = style.size * SCALE;
        let baseline = middle + size as f32 * CAP_HEIGHT / 2.0;
        let width = style.width(text) * SCALE;
        let RGBColor(red, green, blue) = style.color;
        let weight = match style.weight {
            Weight::Regular => "",
            Weight::Bold => r#" font-weight="bold""#,
        };
        let text = escaped(text);
        // Writing to a string cannot fail.
        let _ = writeln!(
            self.0,
            "<text x=\"{x:.1}\" y=\"{baseline:.1}\" textLength=\"{width:.1}\" \
             lengthAdjust=\"spacingAndGlyphs\" font-size=\"{size}\" fill=\"#{red:02x}{green:02x}{blue:02x}\"{weight}>{text}</text>"
        );
    }

    /// A page of shapes, as plotters wrote it, with the texts over it.
    pub fn over(&self, page: &str) -> String {
        let shapes = page.trim_end().trim_end_matches("</svg>");
        // Round joints, as mitred ones grow spikes at sharp angles.
        let shapes = shapes.replacen("<svg ", "<svg stroke-linejoin=\"round\" ", 1);
        let texts = &self.0;
        // A space at the beginning of a text counts in its width.
        let group = format!("<g font-family=\"{FAMILY}\" xml:space=\"preserve\">");
        format!("{shapes}{group}\n{texts}</g>\n</svg>\n")
    }
}

fn escaped(text: &str) -> String {
    let text = text.replace('&', "&amp;");
    text.replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_stand_over_shapes_as_text() {
        let mut lettering = Lettering::default();
        lettering.add("a < b & c", (10.0, 20.0), TextStyle::TITLE);
        let page = lettering.over("<svg width=\"9\">\n<rect/>\n</svg>\n");
        let lines: Vec<&str> = page.lines().collect();
        assert_eq!(lines[0], "<svg stroke-linejoin=\"round\" width=\"9\">");
        assert_eq!(lines[1], "<rect/>");
        assert!(
            lines[3].starts_with("<text x=\"10.0\" y=\"34.3\" "),
            "{page}"
        );
        assert!(lines[3].ends_with(">a &lt; b &amp; c</text>"), "{page}");
        assert_eq!(lines[4..], ["</g>", "</svg>"]);
    }
}
