//! A [`Window`]: consecutive frames as lists of what was seen, the form in which the network reads them.

use super::shape::NetworkShape;
use protocol::frame::Frame;

/// One visited cell of a frame, by its place on the padded grid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Visit {
    pub(crate) row: u16,
    pub(crate) col: u16,
    pub(crate) value: u8,
}

/// Consecutive frames: all are read, and all but the first predicted.
#[derive(Debug, Clone, Default)]
pub struct Window {
    visits: Vec<Visit>,
    /// Where each frame's visits begin, and where the last ends.
    starts: Vec<usize>,
}

impl Window {
    /// A window of frames of one grid.
    pub fn new<'a>(frames: impl IntoIterator<Item = &'a Frame>) -> Self {
        let mut window = Self {
            visits: Vec::new(),
            starts: vec![0],
        };
        for frame in frames {
            let (_, width) = frame.values().dim();
            window
                .visits
                .extend(frame.observed().map(|(cell, value)| Visit {
                    row: (cell / width) as u16,
                    col: (cell % width) as u16,
                    value,
                }));
            window.starts.push(window.visits.len());
        }
        window
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.starts.len() - 1
    }

    /// Whether it holds no frame.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The visited cells of one frame, in row-major order.
    pub(crate) fn visits(&self, frame: usize) -> &[Visit] {
        &self.visits[self.starts[frame]..self.starts[frame + 1]]
    }

    /// What is to be predicted after a frame: the visited cells of the next one, none after the last.
    pub(crate) fn targets(&self, frame: usize) -> &[Visit] {
        match frame + 1 < self.len() {
            true => self.visits(frame + 1),
            false => &[],
        }
    }

    /// Visited cells of all frames but the first: the terms of the loss.
    pub(crate) fn n_targets(&self) -> usize {
        self.visits.len() - self.starts[1.min(self.len())]
    }

    /// Whether there is anything to predict.
    pub fn has_targets(&self) -> bool {
        self.n_targets() > 0
    }

    /// Whether each visit is a cell and an observation of the network.
    pub(crate) fn fits(&self, shape: &NetworkShape) -> bool {
        let (height, width) = shape.grid.dim();
        self.visits.iter().all(|visit| {
            usize::from(visit.row) < height
                && usize::from(visit.col) < width
                && usize::from(visit.value) < shape.n_observations
        })
    }
}
