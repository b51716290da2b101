//! A [`Frame`]: a robot's observations in one step, the masked observation `y ⊙ m` of paper eq. 11.

use super::grid::{Grid, Shape};
use ndarray::ArrayView2;
use thiserror::Error;

/// The value of a cell that was not observed.
pub const UNOBSERVED: u8 = 255;

/// The part of the grid that a frame shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
#[repr(u32)]
pub enum Coverage {
    /// Nothing: the frame after a reset.
    Empty = 0,
    /// The cells on the robot's path (paper section III.C).
    Path = 1,
    /// Every cell (paper sections III.A and III.B).
    Full = 2,
}

/// One observed value per cell, [`UNOBSERVED`] where the robot did not look.
///
/// Values are below the model's number of observations O. Decoding checks this, so that a `Frame` can index a
/// likelihood table.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    values: Grid<u8>,
}

/// The error for bytes that are not a frame of the expected grid.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum FrameError {
    #[error("frame: expected {expected} bytes for a {shape} grid, got {got}")]
    Length {
        expected: usize,
        got: usize,
        shape: Shape,
    },
    /// A value that is neither an observation nor [`UNOBSERVED`].
    #[error(
        "frame: cell {index}: expected an observation below {n_observations} or 255, got {value}"
    )]
    Value {
        index: usize,
        value: u8,
        n_observations: usize,
    },
}

impl Frame {
    pub fn empty(shape: Shape) -> Self {
        Self {
            values: Grid::from_elem(shape.dim(), UNOBSERVED),
        }
    }

    /// Decodes `H * W` row-major bytes. One invalid byte makes the whole frame invalid.
    ///
    /// # Errors
    /// [`FrameError`] for a wrong length or a value that is not an observation.
    pub fn from_bytes(
        shape: Shape,
        n_observations: usize,
        bytes: &[u8],
    ) -> Result<Self, FrameError> {
        if bytes.len() != shape.n_cells() {
            let (expected, got) = (shape.n_cells(), bytes.len());
            return Err(FrameError::Length {
                expected,
                got,
                shape,
            });
        }
        let wrong = |&value: &u8| value != UNOBSERVED && usize::from(value) >= n_observations;
        if bytes.iter().any(wrong) {
            let index = bytes
                .iter()
                .position(wrong)
                .expect("invariant: any() found one");
            return Err(FrameError::Value {
                index,
                value: bytes[index],
                n_observations,
            });
        }
        let values = Grid::from_shape_vec(shape.dim(), bytes.to_vec());
        Ok(Self {
            values: values.expect("invariant: length checked above"),
        })
    }

    /// Returns the values, shape `[H, W]`.
    pub fn values(&self) -> ArrayView2<'_, u8> {
        self.values.view()
    }

    /// Returns `H * W` row-major bytes.
    pub fn as_bytes(&self) -> &[u8] {
        self.values
            .as_slice()
            .expect("invariant: frames are row-major")
    }

    /// Iterates over the observed cells in row-major order, as `(cell index, value)`.
    pub fn observed(&self) -> impl Iterator<Item = (usize, u8)> + '_ {
        let cells = self.as_bytes().iter().copied().enumerate();
        cells.filter(|&(_, value)| value != UNOBSERVED)
    }

    pub fn clear(&mut self) {
        self.values.fill(UNOBSERVED);
    }

    /// Records an observation of the cell at a row-major index. `value` must be below the model's number of
    /// observations.
    pub fn observe(&mut self, index: usize, value: u8) {
        debug_assert_ne!(value, UNOBSERVED);
        self.values
            .as_slice_mut()
            .expect("invariant: frames are row-major")[index] = value;
    }
}

impl TryFrom<u32> for Coverage {
    type Error = u32;

    fn try_from(value: u32) -> Result<Self, u32> {
        match value {
            0 => Ok(Self::Empty),
            1 => Ok(Self::Path),
            2 => Ok(Self::Full),
            other => Err(other),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_accepted_or_rejected_as_a_whole() {
        let shape = Shape::new(2, 2).expect("test shape");
        let frame = |bytes: &[u8]| Frame::from_bytes(shape, 3, bytes);
        let good = frame(&[0, 255, 2, 255]).expect("valid");
        assert_eq!(good.observed().collect::<Vec<_>>(), [(0, 0), (2, 2)]);
        let wrong = frame(&[0, 3, 2, 255]).expect_err("no observation");
        let words = "frame: cell 1: expected an observation below 3 or 255, got 3";
        assert_eq!(wrong.to_string(), words);
        let short = frame(&[0; 3]).expect_err("too short");
        let words = "frame: expected 4 bytes for a 2 x 2 grid, got 3";
        assert_eq!(short.to_string(), words);
    }
}
