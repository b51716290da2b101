//! What the layers are told about one pass over a window.

use crate::dropout::{Dropout, Mask};
use crate::window::Window;
use candle_core::Tensor;
use std::cell::RefCell;

/// One pass: the frames, and either the dropout of training or none.
///
/// In training, normalisations use the moments of the window and leave them here; afterwards they use the
/// running ones.
#[derive(Debug)]
pub struct Pass<'a> {
    /// The frames.
    pub window: &'a Window,
    dropout: Dropout,
    trains: bool,
    moments: RefCell<Vec<KeptMoments>>,
}

/// The moments of a window behind one normalisation.
#[derive(Debug)]
pub(crate) struct KeptMoments {
    /// The name of the normalisation.
    pub(crate) norm: String,
    /// Mean and variance of each channel; the variance is the population's.
    pub(crate) moments: [Tensor; 2],
    /// Values per channel.
    pub(crate) count: f64,
}

impl<'a> Pass<'a> {
    /// An update's pass.
    ///
    /// # Panics
    /// If the window is empty, or a mask is of another number of frames.
    pub fn training(window: &'a Window, dropout: &Dropout) -> Self {
        let masks = dropout.encoder.iter().chain(&dropout.decoder);
        let fits = masks
            .into_iter()
            .all(|mask| mask.n_frames() == window.len());
        assert!(
            fits && !window.is_empty(),
            "window: no frame, or other frames than the masks"
        );
        Self {
            window,
            dropout: dropout.clone(),
            trains: true,
            moments: RefCell::default(),
        }
    }

    /// An estimator's pass, with running statistics and every channel.
    pub fn inference(window: &'a Window) -> Self {
        Self {
            window,
            dropout: Dropout::off(window.len()),
            trains: false,
            moments: RefCell::default(),
        }
    }

    pub(crate) fn trains(&self) -> bool {
        self.trains
    }

    pub(crate) fn encoder_mask(&self, stage: usize) -> &Mask {
        &self.dropout.encoder[stage]
    }

    pub(crate) fn decoder_mask(&self, level: usize) -> &Mask {
        &self.dropout.decoder[level]
    }

    pub(crate) fn keep_moments(&self, norm: &str, moments: [Tensor; 2], count: f64) {
        self.moments.borrow_mut().push(KeptMoments {
            norm: norm.into(),
            // No gradient goes through them.
            moments: moments.map(|tensor| tensor.detach()),
            count,
        });
    }

    /// The window's moments.
    pub(crate) fn into_moments(self) -> Vec<KeptMoments> {
        self.moments.into_inner()
    }
}
