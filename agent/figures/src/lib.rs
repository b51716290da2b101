//! Charts: data in, SVG out, and PNG from that SVG, the same on every machine.
//!
//! [`Ladder`] has bars, [`Lines`] curves over one axis, [`Snapshot`] the cells of one step. Each makes a
//! text; [`png`] turns it into pixels. `svg` draws, `axis` scales.

#![allow(
    missing_docs,
    reason = "for one program: what names say is not said again"
)]

mod axis;
mod ladder;
mod legend;
mod lines;
mod palette;
mod panels;
mod raster;
mod snapshot;
mod svg;
mod text;

pub use ladder::{Bar, Ladder};
pub use legend::Named;
pub use lines::{Curve, Lines, MOST_CURVES, Panel, Scale, Shade};
pub use palette::Color;
pub use raster::{Heat, PngError, heat, png};
pub use snapshot::Snapshot;
