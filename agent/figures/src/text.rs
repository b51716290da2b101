//! Text widths. The layout uses the widths of Noto Sans. The SVG specifies each text's width, so that viewers with
//! another font stretch the text to fit.

use crate::palette::{Color, INK, MUTED};

/// Height of a capital letter as a fraction of the text size (Noto Sans, OS/2 table: 714 / 1000).
pub const CAP_HEIGHT: f64 = 0.714;

/// The preferred font, followed by similar fonts for viewers that lack it.
pub const FAMILY: &str = "Noto Sans, Open Sans, DejaVu Sans, Arial, sans-serif";

/// Replaces the end of a text that is too long.
const ELLIPSIS: char = '…';

/// Widths of the characters from space to tilde in thousandths of the text size (Noto Sans Regular, hmtx table).
#[rustfmt::skip]
const REGULAR: [u16; 95] = [
    260, 269, 408, 646, 572, 831, 732, 225, 300, 300, 551, 572, 268, 322, 268, 372, 572, 572, 572,
    572, 572, 572, 572, 572, 572, 572, 268, 268, 572, 572, 572, 434, 899, 639, 650, 632, 730, 556,
    519, 728, 741, 339, 273, 619, 524, 907, 760, 781, 605, 781, 622, 549, 556, 731, 600, 930, 586,
    566, 572, 329, 372, 329, 572, 444, 580, 561, 615, 480, 615, 564, 344, 615, 618, 258, 258, 534,
    258, 935, 618, 605, 615, 615, 413, 479, 361, 618, 508, 786, 529, 510, 470, 380, 551, 380, 572,
];

/// The same widths for Noto Sans Bold.
#[rustfmt::skip]
const BOLD: [u16; 95] = [
    260, 286, 472, 646, 572, 901, 750, 266, 339, 339, 545, 572, 285, 322, 285, 413, 572, 572, 572,
    572, 572, 572, 572, 572, 572, 572, 285, 285, 572, 572, 572, 477, 897, 690, 672, 637, 740, 560,
    549, 724, 765, 389, 331, 664, 565, 943, 813, 796, 628, 796, 660, 551, 579, 756, 650, 967, 667,
    624, 579, 331, 413, 331, 572, 411, 607, 604, 633, 514, 633, 591, 387, 633, 657, 305, 305, 620,
    305, 982, 657, 619, 633, 633, 454, 497, 434, 657, 569, 856, 578, 569, 488, 394, 551, 394, 572,
];

/// Width of other characters in thousandths. Most letters with accents are narrower.
const OTHER: u16 = 640;

/// Width of East Asian characters and emoji in thousandths.
const WIDE: u16 = 1000;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TextStyle {
    pub size: f64,
    pub is_bold: bool,
    pub color: Color,
}

impl TextStyle {
    pub const TITLE: Self = Self::new(20.0, true, INK);
    pub const LABEL: Self = Self::new(14.0, false, INK);
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

    /// Returns the text as an SVG element. `at` contains the attributes of its position, and `more` further attributes.
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

    /// Returns the width of a text in points.
    pub fn width(self, text: &str) -> f64 {
        let table = if self.is_bold { &BOLD } else { &REGULAR };
        let of = |letter: char| match letter {
            ' '..='~' => table[letter as usize - ' ' as usize],
            '\u{2e80}'.. => WIDE,
            ELLIPSIS => 791,
            '±' | '×' => 572,
            _ => OTHER,
        };
        let thousandths: u32 = text.chars().map(|letter| u32::from(of(letter))).sum();
        f64::from(thousandths) / 1000.0 * self.size
    }

    /// Shortens a text to at most `room` points. A shortened text ends with an ellipsis.
    pub fn fit(self, text: &str, room: f64) -> String {
        if self.width(text) <= room {
            return text.into();
        }
        let ends: Vec<usize> = text.char_indices().map(|(at, _)| at).collect();
        let short = |end: usize| format!("{}{ELLIPSIS}", text[..end].trim_end());
        // Widths increase with the length of the text, so that binary search works.
        let n = ends.partition_point(|&end| self.width(&short(end)) <= room);
        n.checked_sub(1)
            .map_or(String::new(), |last| short(ends[last]))
    }
}

/// Escapes a text for XML. Control characters become spaces, and other invalid characters are omitted.
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
    fn long_texts_are_shortened_to_fit() {
        let (text, style) = ("a policy with a very long näme", TextStyle::LABEL);
        let short = style.fit(text, 100.0);
        assert!(short.ends_with(ELLIPSIS) && style.width(&short) <= 100.0);
        assert!(style.width(&short) > 85.0);
        assert_eq!(style.fit(text, 1000.0), text);
        assert_eq!(style.fit(text, 0.0), "");
        // Widths of a digit, a space and an A in thousandths: regular 572, 260 and 639, bold 572, 260 and 690.
        let [regular, bold] = [
            TextStyle::LABEL,
            TextStyle {
                is_bold: true,
                ..TextStyle::LABEL
            },
        ]
        .map(|style| style.width("0 A"));
        assert!((regular - 14.0 * 1.471).abs() < 1e-9 && (bold - 14.0 * 1.522).abs() < 1e-9);
    }
}
