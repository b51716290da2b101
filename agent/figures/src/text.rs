//! How wide texts are, in Noto Sans, which the crate `notosans` ships with its licence, the SIL Open Font
//! License 1.1.

use crate::palette::{Color, INK, MUTED};
use resvg::usvg::{Node, Options, Tree, fontdb};
use std::sync::{Arc, LazyLock};

/// Height of a capital letter as a fraction of the text size (Noto Sans, OS/2 table: 714 / 1000).
pub const CAP_HEIGHT: f64 = 0.714;

/// The font, and what is near it for viewers that lack it.
pub const FAMILY: &str = "Noto Sans, Open Sans, DejaVu Sans, Arial, sans-serif";

/// What is put in place of the end of a text that is too long.
const ELLIPSIS: char = '…';

/// How SVG is read: with this font alone, so that a page looks the same on every machine.
pub static OPTIONS: LazyLock<Options<'static>> = LazyLock::new(|| {
    let mut fonts = fontdb::Database::new();
    for font in [notosans::REGULAR_TTF, notosans::BOLD_TTF] {
        fonts.load_font_source(fontdb::Source::Binary(Arc::new(font)));
    }
    Options {
        fontdb: Arc::new(fonts),
        font_family: "Noto Sans".into(),
        ..Options::default()
    }
});

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TextStyle {
    pub size: f64,
    pub is_bold: bool,
    pub color: Color,
}

impl TextStyle {
    pub const TITLE: Self = Self::new(20.0, true, INK);
    pub const LABEL: Self = Self::new(14.0, false, INK);
    pub const STRONG: Self = Self::new(14.0, true, INK);
    pub const NOTE: Self = Self::new(13.0, false, MUTED);

    const fn new(size: f64, is_bold: bool, color: Color) -> Self {
        Self {
            size,
            is_bold,
            color,
        }
    }

    pub fn colored(self, color: Color) -> Self {
        Self { color, ..self }
    }

    /// The text as an SVG element at a place.
    pub fn element(self, at: &str, more: &str, text: &str) -> String {
        let (size, color) = (self.size, self.color);
        let weight = if self.is_bold {
            " font-weight=\"bold\""
        } else {
            ""
        };
        let text = escaped(text);
        format!("<text {at} font-size=\"{size}\"{weight}{more} fill=\"{color}\">{text}</text>")
    }

    pub fn width(self, text: &str) -> f64 {
        // A space at the beginning of a text counts in its width.
        let page = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" font-family=\"{FAMILY}\" \
             xml:space=\"preserve\">{}</svg>",
            self.element("", "", text)
        );
        let tree = Tree::from_str(&page, &OPTIONS).expect("invariant: pages are SVG");
        let width = |node: &Node| match node {
            Node::Text(text) => Some(f64::from(text.bounding_box().width())),
            _ => None,
        };
        tree.root().children().iter().filter_map(width).sum()
    }

    /// The text, or as much of its start as fits into `room` points with an ellipsis.
    pub fn fit(self, text: &str, room: f64) -> String {
        if self.width(text) <= room {
            return text.into();
        }
        let ends: Vec<usize> = text.char_indices().map(|(at, _)| at).collect();
        let short = |end: usize| format!("{}{ELLIPSIS}", text[..end].trim_end());
        // Widths grow with the text.
        let n = ends.partition_point(|&end| self.width(&short(end)) <= room);
        n.checked_sub(1)
            .map_or(String::new(), |last| short(ends[last]))
    }
}

/// Text as XML allows it: other characters are left out.
fn escaped(text: &str) -> String {
    let mut escaped = String::new();
    for letter in text.chars() {
        match letter {
            '&' => escaped += "&amp;",
            '<' => escaped += "&lt;",
            '>' => escaped += "&gt;",
            '\u{fffe}' | '\u{ffff}' => {}
            letter if letter.is_control() => escaped.push(' '),
            letter => escaped.push(letter),
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn widths_are_those_of_the_font() {
        let width = |text| {
            TextStyle {
                size: 1000.0,
                ..TextStyle::LABEL
            }
            .width(text)
        };
        // Noto Sans, hmtx table: 572 of 1000 for a digit, 260 for a space; `AV` is kerned.
        assert!((width("0") - 572.0).abs() < 1.0, "{}", width("0"));
        assert!((width(" 0") - 832.0).abs() < 1.0, "{}", width(" 0"));
        assert!(width("AV") < width("A") + width("V"));
        assert_eq!(width(""), 0.0);
    }

    #[test]
    fn long_texts_are_shortened_to_fit() {
        let (text, style) = ("a policy with a very long näme", TextStyle::LABEL);
        let short = style.fit(text, 100.0);
        assert!(short.ends_with(ELLIPSIS) && style.width(&short) <= 100.0);
        assert!(style.width(&short) > 85.0);
        assert_eq!(style.fit(text, 1000.0), text);
        assert_eq!(style.fit(text, 0.0), "");
    }
}
