//! Draws charts as SVG. The same data give the same SVG on every machine.
//!
//! [`Ladder`] draws bars, and [`Lines`] curves over a common axis. `svg` contains the drawing functions, and `axis` the
//! scales. [`heat`] creates PNGs for TensorBoard, which cannot show SVG.

#![allow(
    missing_docs,
    reason = "serves one program: only items that need an explanation are documented"
)]

mod axis;
mod heat;
mod ladder;
mod lines;
mod palette;
mod svg;
mod text;

pub use heat::{Heat, heat};
pub use ladder::{Bar, Ladder};
pub use lines::{Curve, Lines, MAX_CURVES, Panel, Scale, Shade};
pub use palette::Color;
