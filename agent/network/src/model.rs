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

/// Encoder, recurrence, decoder and observation matrix, by the authors' names.
#[derive(Debug)]
pub struct Network {
    encoder: Encoder,
    gru: Gru,
    decoder: Decoder,
    observation: ObservationMatrix,
}

impl Network {
    /// A network whose layers ask `vb` for their variables.
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

    /// The hidden vectors that have read each frame, `[frames, hidden]`; `first` is the one before. A layer
    /// more is a line more here.
    pub fn forward(&self, pass: &Pass<'_>, first: &[f32]) -> Result<Tensor> {
        let x = self.encoder.forward(pass)?;
        self.gru.forward(&x, first)
    }

    /// The loss of what the window's frames say about their successors (eqs. 8 and 11).
    pub fn loss(&self, pass: &Pass<'_>, first: &[f32]) -> Result<Tensor> {
        let hidden = self.forward(pass, first)?;
        self.decoder.loss(&hidden, &self.observation, pass)
    }

    /// The predictors that hidden vectors stand for, `[frames, states, rows, cols]` of the padded grid.
    pub fn predict(&self, pass: &Pass<'_>, hidden: &Tensor) -> Result<Tensor> {
        softmax(&self.decoder.forward(hidden, pass)?, 1)
    }

    /// The observation matrix `O`, `[observations, states]`; each column sums to one.
    pub fn observation_matrix(&self) -> Result<Tensor> {
        self.observation.matrix()
    }
}

impl NetworkShape {
    /// How many numbers the network's parameters and statistics have; none of them is made.
    pub fn n_numbers(&self) -> usize {
        count_numbers(|vb| Network::new(&vb, self, Operators::Own))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberwatch_model::Shape;

    #[test]
    fn numbers_are_counted_before_they_are_made() {
        // Convolutions 6,176 + 8,208 + 1,160, linear 516, GRU 120, decoder 8,192 + 131,072 + 32,768 + 8,192
        // + 768, observation matrix 9; four numbers per channel for each of the seven normalisations.
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
