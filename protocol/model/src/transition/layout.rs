//! The memory layout of beliefs in [`super::Transition`].

use super::super::grid::Shape;
use super::super::vectors::LANES;

/// A memory layout for a belief, with one plane per state. Each plane has a margin of half a kernel on each side. The
/// right margin is wider, so that each row consists of whole chunks of [`LANES`] cells.
#[derive(Debug, Clone, Copy)]
pub(super) struct Layout {
    pub(super) above: usize,
    pub(super) left: usize,
    pub(super) stride: usize,
    pub(super) plane: usize,
}

impl Layout {
    pub(super) fn new(shape: Shape, kernel_height: usize, kernel_width: usize) -> Self {
        let stride = shape.width().next_multiple_of(LANES) + kernel_width - 1;
        Self {
            above: kernel_height / 2,
            left: kernel_width / 2,
            stride,
            plane: (shape.height() + kernel_height - 1) * stride,
        }
    }
}
