//! The last doubling and the loss behind it, at visited cells only where these are few.

use super::{Chunk, Decoder, DecoderLayers, LEVELS, Level};
use crate::network::dropout::Dropout;
use crate::network::lanes::{Arithmetic, LANES, Lanes};
use crate::network::loss::{CellLoss, LossSettings};
use crate::network::parallel::{Pass, for_each_chunk};
use crate::network::parameters::{DECODER, OBSERVATION, Tensors};
use crate::network::visited::{LastLayer, LastMaps};
use crate::network::window::Window;
use protocol::frame::UNOBSERVED;

/// From this share of visited cells on, one in so many, all cells are decoded.
const DENSE_FROM: usize = 12;

impl Decoder {
    /// The loss, and the gradients of the last doubling and of the observation matrix.
    pub(crate) fn loss(
        &mut self,
        parameters: &Tensors,
        layers: &DecoderLayers,
        (window, settings): (&Window, &LossSettings),
        dropout: &Dropout,
        gradient: &mut Tensors,
    ) -> f64 {
        let level = Level::new(LEVELS - 1, layers, dropout);
        let n_states = self.shape.n_states;
        let weight = parameters.get(&format!("{}.weight", DECODER[LEVELS]));
        let input = level.doubling().input;
        let divisor = settings.divisor(window);
        let loss = CellLoss::new(parameters.get(OBSERVATION), n_states, divisor);
        let loss = loss.with_log_floor(settings.log_floor);
        let last = LastLayer::new(input, n_states, weight, level.norm());
        let states = (0..n_states as u16).collect();
        let pass = Loss {
            level,
            last,
            window,
            loss,
            states,
        };
        for_each_chunk(&mut self.chunks, &pass);
        let losses = || self.chunks.iter().map(|chunk| &chunk.loss);
        gradient
            .get_mut(OBSERVATION)
            .copy_from_slice(&CellLoss::gradient(losses()));
        self.write_doubling(&pass.level, gradient);
        let d_weight = gradient.get_mut(&format!("{}.weight", DECODER[LEVELS]));
        for chunk in &self.chunks {
            LastLayer::add_gradient(&chunk.d_last, n_states, d_weight);
        }
        losses().map(CellLoss::sum).sum::<f64>() / divisor as f64
    }
}

/// The last doubling, softmax, observation matrix and loss: of each frame's successor.
struct Loss<'a> {
    level: Level<'a>,
    last: LastLayer,
    window: &'a Window,
    loss: CellLoss,
    states: Vec<u16>,
}

impl Pass<Chunk> for Loss<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(&self, chunk: &mut Chunk) {
        let doubling = self.level.doubling();
        let n_cells = doubling.output().pixels();
        chunk.clear(self.level.level);
        chunk.d_last.fill(Lanes::ZERO);
        chunk.loss = self.loss.clone();
        for (number, frame) in chunk.frames.clone().enumerate() {
            if self.window.targets(frame).len() * DENSE_FROM < n_cells {
                self.at_visits::<A>(chunk, number, frame);
            } else {
                self.everywhere::<A>(chunk, number, frame);
            }
        }
    }
}

impl Loss<'_> {
    #[inline(always)]
    fn at_visits<A: Arithmetic>(&self, chunk: &mut Chunk, number: usize, frame: usize) {
        let index = self.level.level;
        let at = number * self.level.length_in()..(number + 1) * self.level.length_in();
        let mut maps = LastMaps {
            kept: self.level.mask().kept(frame),
            u: &chunk.u[index][at],
            touched: chunk.touched[number].insert(Vec::new()),
            sums: &mut chunk.sums,
            d_weights: &mut chunk.d_last,
        };
        let visits = self.window.targets(frame);
        self.last.frame::<A>(visits, &mut maps, &mut chunk.loss);
    }

    #[inline(always)]
    fn everywhere<A: Arithmetic>(&self, chunk: &mut Chunk, number: usize, frame: usize) {
        let (level, doubling) = (&self.level, self.level.doubling());
        let kept = level.mask().kept(frame);
        chunk.touched[number] = None;
        let scratch = &mut chunk.scratch[level.level];
        let u = &chunk.u[level.level][number * level.length_in()..];
        doubling.values::<A>(u, kept, level.norm(), &level.floors, scratch);
        let channels = [kept, &self.states[..]];
        doubling.forward::<A>(channels, &level.constants, 1.0, scratch, &mut chunk.logits);
        let output = doubling.output();
        chunk.values.fill(UNOBSERVED);
        for visit in self.window.targets(frame) {
            let cell = output.at(usize::from(visit.row), usize::from(visit.col));
            chunk.values[cell] = visit.value;
        }
        self.add_cells::<A>(chunk);
        for (state, dz) in chunk.logits.chunks_exact(output.length()).enumerate() {
            let scratch = &mut chunk.scratch[level.level];
            doubling.place_gradient(state, scratch, |first, to| {
                to.copy_from_slice(&dz[first..][..to.len()]);
            });
        }
        chunk.through_doubling::<A>(level, number, frame, &self.states);
    }

    /// Adds all cells' losses and turns their logits into gradients.
    #[inline(always)]
    fn add_cells<A: Arithmetic>(&self, chunk: &mut Chunk) {
        let length = self.level.doubling().output().length();
        let mut lanes = vec![Lanes::ZERO; self.states.len()];
        for (index, values) in chunk.values.as_chunks().0.iter().enumerate() {
            for (state, lanes) in lanes.iter_mut().enumerate() {
                *lanes = Lanes::load(&chunk.logits[state * length + index * LANES..]);
            }
            chunk.loss.add::<A>(&mut lanes, values);
            for (state, lanes) in lanes.iter().enumerate() {
                lanes.store(&mut chunk.logits[state * length + index * LANES..]);
            }
        }
    }
}
