//! The dynamic autoencoder (paper section III.B) as a candle model.

use crate::decoder::Decoder;
use crate::encoder::Encoder;
use crate::gru::Gru;
use crate::observation_matrix::ObservationMatrix;
use crate::operators::Operators;
use crate::pass::Pass;
use crate::shape::NetworkShape;
use crate::variables::count_numbers;
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
    /// An additional layer needs one more line here.
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

impl NetworkShape {
    /// Counts the values in the network's parameters and statistics without allocating them.
    pub fn n_numbers(&self) -> usize {
        count_numbers(|vb| Network::new(&vb, self, Operators::Own))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberwatch_model::Shape;

    #[test]
    fn all_parameters_and_statistics_are_counted() {
        // The convolutions have 6,176 + 8,208 + 1,160 numbers, the linear layer 516, the GRU 120, the decoder 8,192 +
        // 131,072 + 32,768 + 8,192 + 768, the observation matrix 9, and the seven normalisations four for each of their
        // 296 channels.
        assert_eq!(shape(64).n_numbers(), 197_181 + 4 * 296);
        assert!(shape(4096).n_numbers() > 40_000_000);
    }

    fn shape(side: usize) -> NetworkShape {
        NetworkShape {
            grid: Shape::new(side, side).expect("test shape"),
            n_states: 3,
            n_observations: 3,
            encoding: 4,
            hidden: 4,
        }
    }
}
