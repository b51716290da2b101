//! A network with an additional layer: a second GRU after the first.
//!
//! Candle computes the network's gradients, a seed determines its initial values, and [`Adam`] finds its variables by
//! name. Run the example with `cargo run --release -p emberwatch-network --example second_gru`

use candle_core::{DType, Result, Tensor};
use candle_nn::VarBuilder;
use emberwatch_model::{Frame, Shape};
use emberwatch_network::variables::build;
use emberwatch_network::{
    Adam, AdamSettings, Decoder, Device, Dropout, Encoder, Gru, NetworkShape, ObservationMatrix,
    Operators, Pass, Window,
};

struct TwoGrus {
    encoder: Encoder,
    first: Gru,
    second: Gru,
    decoder: Decoder,
    observation: ObservationMatrix,
}

impl TwoGrus {
    fn new(vb: &VarBuilder<'_>, shape: &NetworkShape) -> Result<Self> {
        let n = shape.hidden;
        Ok(Self {
            encoder: Encoder::new(&vb.pp("encoder"), shape, Operators::Own)?,
            first: Gru::new(&vb.pp("rnn_layer"), shape.encoding, n, Operators::Own)?,
            second: Gru::new(&vb.pp("second_rnn_layer"), n, n, Operators::Own)?,
            decoder: Decoder::new(&vb.pp("decoder"), shape, Operators::Own)?,
            observation: ObservationMatrix::new(vb, shape.n_observations, shape.n_states)?,
        })
    }

    fn forward(&self, pass: &Pass<'_>, hidden: &[f32]) -> Result<Tensor> {
        let x = self.encoder.forward(pass)?;
        let x = self.first.forward(&x, hidden)?;
        self.second.forward(&x, hidden)
    }

    fn loss(&self, pass: &Pass<'_>, hidden: &[f32]) -> Result<Tensor> {
        let hidden = self.forward(pass, hidden)?;
        self.decoder.loss(&hidden, &self.observation, pass)
    }
}

/// Creates frames of a grid whose left half shows 0 and whose right half shows 1.
fn frames(grid: Shape) -> Vec<Frame> {
    let (_, width) = grid.dim();
    let frame = |step: usize| {
        let mut frame = Frame::empty(grid);
        for cell in (step..grid.n_cells()).step_by(7) {
            frame.observe(cell, u8::from(2 * (cell % width) >= width));
        }
        frame
    };
    (0..40).map(|step| frame(step % 7)).collect()
}

#[expect(clippy::print_stdout, reason = "the example prints its progress")]
fn main() -> Result<()> {
    let shape = NetworkShape {
        grid: Shape::new(32, 32).map_err(candle_core::Error::wrap)?,
        n_states: 2,
        n_observations: 2,
        encoding: 8,
        hidden: 8,
    };
    let model = |vb| TwoGrus::new(&vb, &shape);
    let (model, variables) = build(1, DType::F32, &Device::Cpu, model)?;
    let (mut adam, settings) = (Adam::new(variables)?, AdamSettings::paper(1e-3));
    let window = Window::new(&frames(shape.grid));
    for update in 0..100 {
        let dropout = Dropout::draw(window.len(), 1, update);
        let loss = model.loss(&Pass::training(&window, &dropout), &[0.0; 8])?;
        let loss = adam.update(&settings, &loss);
        let loss = loss.map_err(candle_core::Error::wrap)?;
        if update % 20 == 0 {
            println!("update {update}: loss {loss:.4}");
        }
    }
    Ok(())
}
