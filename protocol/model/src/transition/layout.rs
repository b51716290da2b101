//! Where beliefs lie while [`super::Transition`] works on them.

use super::super::grid::Shape;
use super::super::vectors::LANES;

/// Where a cell of a state lies in the planes: half a kernel of margin on each side, and on the
/// right up to a whole number of [`LANES`].
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
