//! The context of one pass over a window, which all layers share.

use crate::dropout::{Dropout, Mask};
use crate::window::Window;
use candle_core::Tensor;
use std::cell::RefCell;

/// One pass over a window of frames, for training with dropout or for inference without.
///
/// In training, normalisations use the moments of the window, and store these moments in the pass. In inference, they
/// use the running statistics.
#[derive(Debug)]
pub struct Pass<'a> {
    /// The frames.
    pub window: &'a Window,
    dropout: Dropout,
    trains: bool,
    moments: RefCell<Vec<KeptMoments>>,
}

#[derive(Debug)]
pub(crate) struct KeptMoments {
    pub(crate) norm: String,
    pub(crate) moments: [Tensor; 2],
    pub(crate) count: f64,
}

impl<'a> Pass<'a> {
    /// Creates the pass for an update.
    ///
    /// # Panics
    /// If the window is empty, or a mask has a different number of frames.
    pub fn training(window: &'a Window, dropout: &Dropout) -> Self {
        let masks = dropout.encoder.iter().chain(&dropout.decoder);
        let fits = masks
            .into_iter()
            .all(|mask| mask.n_frames() == window.len());
        assert!(
            fits && !window.is_empty(),
            "window: expected at least one frame, and as many frames as the masks"
        );
        Self {
            window,
            dropout: dropout.clone(),
            trains: true,
            moments: RefCell::default(),
        }
    }

    /// Creates the pass for inference, with running statistics and without dropout.
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
            // Gradients do not propagate through the running statistics.
            moments: moments.map(|tensor| tensor.detach()),
            count,
        });
    }

    pub(crate) fn into_moments(self) -> Vec<KeptMoments> {
        self.moments.into_inner()
    }
}
