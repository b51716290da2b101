//! Crops of grids, the input of the U-Net.

use crate::unet::ALIGNMENT;
use emberwatch_model::grid::Shape;

/// Total width of the two margins on opposite sides of the cells to predict, in cells. Cells farther away hardly affect
/// the predictions.
const MARGINS: usize = 24;

/// A rectangular part of a grid, with sides that are multiples of [`ALIGNMENT`], which may extend beyond the grid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Crop {
    /// Row and column of the upper left cell.
    pub first: [usize; 2],
    /// Number of rows and columns.
    pub sides: [usize; 2],
}

/// The bounding box of some cells: first and last row, then first and last column.
pub(crate) type Extent = [[usize; 2]; 2];

impl Crop {
    /// Returns the crop that contains the whole grid.
    pub fn whole(shape: Shape) -> Self {
        let (height, width) = shape.dim();
        Self {
            first: [0, 0],
            sides: [height, width].map(|side| side.next_multiple_of(ALIGNMENT)),
        }
    }

    pub(crate) fn sides(shape: Shape, extents: &[Extent]) -> [usize; 2] {
        let whole = Self::whole(shape);
        [0, 1].map(|axis| {
            let spans = extents.iter().map(|it| it[axis][1] + 1 - it[axis][0]);
            let side = spans.max().unwrap_or(0) + MARGINS;
            side.next_multiple_of(ALIGNMENT).min(whole.sides[axis])
        })
    }

    /// A crop that would leave the aligned grid is moved inside.
    pub(crate) fn around(shape: Shape, sides: [usize; 2], extent: &Extent) -> Self {
        let whole = Self::whole(shape);
        let first = [0, 1].map(|axis| {
            let middle = (extent[axis][0] + extent[axis][1]).div_ceil(2);
            let max_first = whole.sides[axis] - sides[axis];
            let first = middle.saturating_sub(sides[axis] / 2).min(max_first);
            // Align the crop, so that convolutions with strides sample the same cells as on the whole grid.
            first / ALIGNMENT * ALIGNMENT
        });
        Self { first, sides }
    }
}

/// Panics if there are no cells.
pub(crate) fn extent(shape: Shape, cells: impl Iterator<Item = usize>) -> Extent {
    let mut extent = [[usize::MAX, 0]; 2];
    for cell in cells.map(|cell| shape.cell(cell)) {
        for ([first, last], at) in extent.iter_mut().zip([cell.row, cell.col]) {
            (*first, *last) = (at.min(*first), at.max(*last));
        }
    }
    assert!(extent[0][0] < usize::MAX, "cells: expected at least one");
    extent
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn crops_contain_their_cells_with_margins() {
        let shape = Shape::new(70, 30).expect("test shape");
        let extents = [extent(shape, [33, 95].into_iter()), [[50, 69], [0, 9]]];
        assert_eq!(extents[0], [[1, 3], [3, 5]]);
        let sides = Crop::sides(shape, &extents);
        assert_eq!(sides, [44, 32], "20 rows and margins; the whole width");
        let first = |extent| Crop::around(shape, sides, extent).first;
        assert_eq!(first(&extents[0]), [0, 0]);
        assert_eq!(first(&extents[1]), [28, 0]);
        assert_eq!(first(&[[30, 49], [0, 9]]), [16, 0]);
    }
}
