//! Charts: data in, SVG out, the same on every machine.
//!
//! [`Ladder`] has bars, [`Lines`] curves over one axis, [`Snapshot`] the cells of one step; `svg` draws, `axis` scales.
//! [`heat`] is a picture of pixels, for TensorBoard, which shows no SVG.

#![allow(
    missing_docs,
    reason = "for one program: what names say is not said again"
)]

mod axis;
mod heat;
mod ladder;
mod legend;
mod lines;
mod palette;
mod panels;
mod snapshot;
mod svg;
mod text;

pub use heat::{Heat, heat};
pub use ladder::{Bar, Ladder};
pub use legend::Named;
pub use lines::{Curve, Lines, MOST_CURVES, Panel, Scale, Shade};
pub use palette::Color;
pub use snapshot::Snapshot;
