//! The dynamic autoencoder (paper section III.B) as a candle model.

use crate::decoder::Decoder;
use crate::encoder::Encoder;
use crate::gru::Gru;
use crate::observation_matrix::ObservationMatrix;
use crate::operators::Operators;
use crate::pass::Pass;
use crate::shape::NetworkShape;
use candle_core::{Result, Tensor};
use candle_nn::VarBuilder;
use candle_nn::ops::softmax;

/// The network: encoder, recurrence, decoder and observation matrix. Its variables have the authors' names.
#[derive(Debug)]
pub struct Network {
    encoder: Encoder,
    gru: Gru,
    decoder: Decoder,
    observation: ObservationMatrix,
}

impl Network {
    /// Creates a network, whose layers request their variables from `vb`.
    pub fn new(vb: &VarBuilder<'_>, shape: &NetworkShape, operators: Operators) -> Result<Self> {
        let (n_observations, n_states) = (shape.n_observations, shape.n_states);
        let gru = vb.pp("rnn_layer");
        Ok(Self {
            encoder: Encoder::new(&vb.pp("encoder"), shape, operators)?,
            gru: Gru::new(&gru, shape.encoding, shape.hidden, operators)?,
            decoder: Decoder::new(&vb.pp("decoder"), shape, operators)?,
            observation: ObservationMatrix::new(vb, n_observations, n_states)?,
        })
    }

    /// Computes the hidden vector after each frame, `[frames, hidden]`. `first` is the hidden vector before the window.
    pub fn forward(&self, pass: &Pass<'_>, first: &[f32]) -> Result<Tensor> {
        let x = self.encoder.forward(pass)?;
        self.gru.forward(&x, first)
    }

    /// Computes the loss of the predictions of each frame from the frames before it (eqs. 8 and 11).
    pub fn loss(&self, pass: &Pass<'_>, first: &[f32]) -> Result<Tensor> {
        let hidden = self.forward(pass, first)?;
        self.decoder.loss(&hidden, &self.observation, pass)
    }

    /// Computes the predictors from hidden vectors, `[frames, states, rows, cols]` of the padded grid.
    pub fn predict(&self, pass: &Pass<'_>, hidden: &Tensor) -> Result<Tensor> {
        softmax(&self.decoder.forward(hidden, pass)?, 1)
    }

    /// Returns the observation matrix `O`, `[observations, states]`. Each column sums to one.
    pub fn observation_matrix(&self) -> Result<Tensor> {
        self.observation.matrix()
    }
}
