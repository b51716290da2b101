//! Consecutive frames as lists of observations: the input of the network.

use crate::shape::NetworkShape;
use candle_core::{DType, Device, Result, Tensor};
use emberwatch_model::frame::Frame;
use std::sync::Arc;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Visit {
    pub(crate) row: u16,
    pub(crate) col: u16,
    pub(crate) value: u8,
}

/// Consecutive frames. The network reads all frames, and predicts all but the first. Clones share the data.
#[derive(Debug, Clone)]
pub struct Window {
    visits: Arc<[Visit]>,
    /// For each frame, the index at which its visits start, followed by the end of the last frame's visits.
    starts: Arc<[usize]>,
}

impl Window {
    /// Creates a window from frames of one grid.
    pub fn new<'a>(frames: impl IntoIterator<Item = &'a Frame>) -> Self {
        let (mut visits, mut starts) = (Vec::new(), vec![0]);
        for frame in frames {
            let (_, width) = frame.values().dim();
            visits.extend(frame.observed().map(|(cell, value)| Visit {
                row: (cell / width) as u16,
                col: (cell % width) as u16,
                value,
            }));
            starts.push(visits.len());
        }
        let (visits, starts) = (visits.into(), starts.into());
        Self { visits, starts }
    }

    pub(crate) fn blank(n_frames: usize) -> Self {
        Self {
            visits: Arc::new([]),
            starts: vec![0; n_frames + 1].into(),
        }
    }

    /// Returns the number of frames.
    pub fn len(&self) -> usize {
        self.starts.len() - 1
    }

    /// Returns whether the window has no frame.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the visited cells of one frame, in row-major order.
    pub(crate) fn visits(&self, frame: usize) -> &[Visit] {
        &self.visits[self.starts[frame]..self.starts[frame + 1]]
    }

    /// Returns the cells to predict after a frame: the visited cells of the next frame, or no cells after the last
    /// frame.
    pub(crate) fn targets(&self, frame: usize) -> &[Visit] {
        if frame + 1 < self.len() {
            self.visits(frame + 1)
        } else {
            &[]
        }
    }

    pub(crate) fn all_targets(&self) -> &[Visit] {
        &self.visits[self.starts[1.min(self.len())]..]
    }

    /// Returns whether there are cells to predict.
    pub fn has_targets(&self) -> bool {
        !self.all_targets().is_empty()
    }

    pub(crate) fn fits(&self, shape: &NetworkShape) -> bool {
        let (height, width) = shape.grid.dim();
        self.visits.iter().all(|visit| {
            usize::from(visit.row) < height
                && usize::from(visit.col) < width
                && usize::from(visit.value) < shape.n_observations
        })
    }

    /// Returns a one-hot encoding of the frames, `[frames, observations, rows, cols]` of the padded grid. Cells without
    /// an observation are 0.
    pub(crate) fn one_hot(
        &self,
        n_observations: usize,
        [rows, cols]: [usize; 2],
        dtype: DType,
        device: &Device,
    ) -> Result<Tensor> {
        let mut numbers = vec![0.0_f32; self.len() * n_observations * rows * cols];
        for frame in 0..self.len() {
            for visit in self.visits(frame) {
                let plane = frame * n_observations + usize::from(visit.value);
                numbers[(plane * rows + usize::from(visit.row)) * cols + usize::from(visit.col)] =
                    1.0;
            }
        }
        let dims = (self.len(), n_observations, rows, cols);
        Tensor::from_vec(numbers, dims, device)?.to_dtype(dtype)
    }
}
