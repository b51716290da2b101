//! One window's loss and gradient: encoder, recurrence, decoder, and back (paper eqs. 7 to 11).

use super::batch_norm::Norm;
use super::decoder::{Decoder, DecoderLayers};
use super::dropout::Dropout;
use super::encoder::Encoder;
use super::gru::{self, Gru, Trace};
use super::lanes::dispatch;
use super::parameters::{DECODER_NORMS, ENCODER, Tensors};
use super::shape::NetworkShape;
use super::window::Window;

/// Room for windows of one length.
#[derive(Debug)]
pub(crate) struct Workspace {
    shape: NetworkShape,
    n_frames: usize,
    encoder: Encoder,
    decoder: Decoder,
    pub(crate) gradient: Tensors,
}

impl Workspace {
    /// For windows of `n_frames`.
    pub(crate) fn new(shape: &NetworkShape, parameters: &Tensors, n_frames: usize) -> Self {
        let layers = DecoderLayers::new(shape, parameters);
        Self {
            shape: *shape,
            n_frames,
            encoder: Encoder::new(shape, n_frames),
            decoder: Decoder::new(shape, n_frames, &layers),
            gradient: parameters.zeros_like(),
        }
    }

    pub(crate) fn n_frames(&self) -> usize {
        self.n_frames
    }

    /// The mean loss over the window's targets, from the state `h_0`; leaves the gradient in
    /// `self.gradient` and moves the running statistics.
    pub(crate) fn loss_and_gradient(
        &mut self,
        parameters: &Tensors,
        statistics: &mut Tensors,
        window: &Window,
        dropout: &Dropout,
        first: &[f32],
    ) -> f64 {
        assert_eq!(window.len(), self.n_frames, "frames of a window");
        let gradient = &mut self.gradient;
        let (encodings, encoder) = self.encoder.forward(parameters, window, dropout);
        let gru = Gru::new(parameters, self.shape.encoding, self.shape.hidden);
        let mut trace = Trace::default();
        dispatch(gru::Forward {
            gru: &gru,
            first,
            encodings: &encodings,
            trace: &mut trace,
        });
        let hidden = &trace.hidden[self.shape.hidden..];
        let mut decoder = DecoderLayers::new(&self.shape, parameters);
        self.decoder
            .forward(parameters, &mut decoder, hidden, dropout);
        let loss = self
            .decoder
            .loss(parameters, &decoder, window, dropout, gradient);
        let d_hidden = self.decoder.backward(&decoder, hidden, dropout, gradient);
        let mut d_encodings = Vec::new();
        dispatch(gru::Backward {
            gru: &gru,
            trace: &trace,
            encodings: &encodings,
            d_hidden: &d_hidden,
            d_encodings: &mut d_encodings,
            gradient,
        });
        self.encoder
            .backward(&encoder, window, dropout, &d_encodings, gradient);
        let norms = ENCODER
            .map(|[_, norm]| norm)
            .into_iter()
            .zip(&encoder.norms);
        for (name, norm) in norms.chain(DECODER_NORMS.into_iter().zip(&decoder.norms)) {
            update_running(statistics, name, norm);
        }
        loss
    }
}

/// Moves the running statistics of one normalisation.
fn update_running(statistics: &mut Tensors, name: &str, norm: &Norm) {
    let [mean, variance] = ["running_mean", "running_var"].map(|what| format!("{name}.{what}"));
    let mut new_mean = statistics.get(&mean).to_vec();
    let new_variance = statistics.get_mut(&variance);
    norm.statistics()
        .update_running(&mut new_mean, new_variance);
    statistics.get_mut(&mean).copy_from_slice(&new_mean);
}
