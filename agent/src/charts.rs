//! Charts as SVG, drawn by plotters. The same data give the same SVG on every machine.
//!
//! [`Ladder`] draws bars, and [`Lines`] curves over a common axis. `page` has the page's size, colours and texts.

mod ladder;
mod lines;
mod page;

pub use self::ladder::{Bar, Ladder};
pub use self::lines::{Curve, Lines, MAX_CURVES, Panel, Point, Scale};
pub use plotters::style::RGBColor;
