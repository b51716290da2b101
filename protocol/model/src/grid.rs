//! The grid that every other module indexes: its [`Shape`], its [`Cell`]s, and [`Grid`]s of values over it.
//!
//! Cells are `[row, col]`, rows grow downward, storage is row-major.

use ndarray::{Array2, Array3};
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// One value per cell, shape `[H, W]`, row-major.
pub type Grid<T> = Array2<T>;

/// One probability per state and cell, shape `[S, H, W]`. The probabilities of each cell sum to one.
///
/// The states are the outer axis, so that the kernels of eq. 2 run over contiguous rows of one state.
pub type Probabilities = Array3<f32>;

/// Maximum height and width: 4096, so that one frame is at most 16 MiB.
pub const MAX_SIDE: usize = 4096;

/// Height and width of a grid, each in `1..=MAX_SIDE`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "RawShape", into = "RawShape")]
pub struct Shape {
    height: usize,
    width: usize,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Cell {
    /// Row, 0 at the top.
    pub row: usize,
    /// Column, 0 at the left.
    pub col: usize,
}

/// The error for a height or width outside `1..=MAX_SIDE`.
#[derive(Debug, Error, PartialEq, Eq)]
#[error("grid shape: expected height and width in 1..={MAX_SIDE}, got {height} x {width}")]
pub struct ShapeError {
    height: usize,
    width: usize,
}

impl Shape {
    /// Checks both sides and makes a shape.
    ///
    /// # Errors
    /// [`ShapeError`] if a side is outside `1..=MAX_SIDE`.
    pub fn new(height: usize, width: usize) -> Result<Self, ShapeError> {
        let side = 1..=MAX_SIDE;
        if side.contains(&height) && side.contains(&width) {
            Ok(Self { height, width })
        } else {
            Err(ShapeError { height, width })
        }
    }

    pub fn height(self) -> usize {
        self.height
    }

    pub fn width(self) -> usize {
        self.width
    }

    pub fn n_cells(self) -> usize {
        self.height * self.width
    }

    pub fn contains(self, cell: Cell) -> bool {
        cell.row < self.height && cell.col < self.width
    }

    /// Returns the row-major index of a cell on the grid, in `0..n_cells()`.
    pub fn index(self, cell: Cell) -> usize {
        debug_assert!(self.contains(cell));
        cell.row * self.width + cell.col
    }

    pub fn cell(self, index: usize) -> Cell {
        debug_assert!(index < self.n_cells());
        Cell {
            row: index / self.width,
            col: index % self.width,
        }
    }

    /// Returns the cell in the middle (for even sides, the lower right one of the middle four).
    pub fn centre(self) -> Cell {
        Cell {
            row: self.height / 2,
            col: self.width / 2,
        }
    }

    /// Returns `(H, W)`, the shape of a [`Grid`].
    pub fn dim(self) -> (usize, usize) {
        (self.height, self.width)
    }
}

impl std::fmt::Display for Shape {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} x {}", self.height, self.width)
    }
}

impl std::fmt::Display for Cell {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "({}, {})", self.row, self.col)
    }
}

#[derive(Serialize, Deserialize)]
struct RawShape {
    height: usize,
    width: usize,
}

impl TryFrom<RawShape> for Shape {
    type Error = ShapeError;

    fn try_from(raw: RawShape) -> Result<Self, ShapeError> {
        Self::new(raw.height, raw.width)
    }
}

impl From<Shape> for RawShape {
    fn from(shape: Shape) -> Self {
        Self {
            height: shape.height,
            width: shape.width,
        }
    }
}
