//! What a panel's colours and marks mean.

use super::colors::{BACKGROUND, FRAME, PEN, Tone, shade};
use super::pen::{Point, TEXT, disc, fit, write};
use crate::report::figures::text::{self, Weight};
use crate::report::picture::Picture;

/// Height of a line.
pub const LINE: usize = 20;
/// Side of a colour.
const SWATCH: usize = 11;

/// A mark of a legend.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mark {
    /// A colour's number.
    Color(u8),
    /// The robot's.
    Robot,
    /// From 0 to what the name says.
    Scale,
}

/// A mark with its name, and where it stands below its panel.
pub struct Entry {
    mark: Mark,
    name: String,
    /// Its left upper corner, from that of the legend.
    pub at: Point,
}

/// Places marks on as many lines as they need.
pub fn place(marks: Vec<(Mark, String)>, room: usize) -> Vec<Entry> {
    let (mut x, mut y) = (0, 0);
    let mut entries = Vec::new();
    for (mark, name) in marks {
        let name = fit(&name, room.saturating_sub(mark.width()));
        let width = mark.width() + text::width(&name, TEXT, Weight::Regular).ceil() as usize;
        if x > 0 && x + width > room {
            (x, y) = (0, y + LINE);
        }
        entries.push(Entry {
            mark,
            name,
            at: (x, y),
        });
        x += width + 12;
    }
    entries
}

impl Mark {
    /// Width with the space behind it.
    fn width(self) -> usize {
        match self {
            Self::Color(_) | Self::Robot => SWATCH + 5,
            Self::Scale => 12 + 64 + 6,
        }
    }
}

impl Entry {
    /// `x`: its left edge; `y`: its middle.
    pub fn draw(&self, picture: &mut Picture, (x, y): Point) {
        let top = y - SWATCH / 2;
        match self.mark {
            Mark::Color(color) => {
                picture.fill((x, top), (SWATCH, SWATCH), FRAME);
                picture.fill((x + 1, top + 1), (SWATCH - 2, SWATCH - 2), color);
            }
            Mark::Robot => {
                let center = (x + SWATCH / 2, y);
                disc(picture, center, 4, PEN);
                disc(picture, center, 2, BACKGROUND);
            }
            Mark::Scale => {
                write(picture, (x, y), (TEXT, Tone::Plain), "0");
                picture.fill((x + 11, top - 1), (66, SWATCH + 2), FRAME);
                for column in 0..64 {
                    let at = (x + 12 + column, top);
                    picture.fill(at, (1, SWATCH), shade(column as f32 / 63.0));
                }
            }
        }
        let at = (x + self.mark.width(), y);
        write(picture, at, (TEXT, Tone::Plain), &self.name);
    }
}
