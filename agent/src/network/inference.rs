//! One frame at a time with running statistics and no dropout: the network as an estimator.

use super::batch_norm::Statistics;
use super::conv::{Dense, Sparse};
use super::decoder::DecoderLayers;
use super::deconv::Scratch;
use super::dropout::Dropout;
use super::encoder::{Linear, encoder_norm};
use super::gru::{Gru, Trace};
use super::lanes::{Arithmetic, Buffer, Kernel, LANES, Lanes};
use super::loss::softmax;
use super::parameters::{DECODER_NORMS, ENCODER, Tensors};
use super::shape::{DECODER_CHANNELS, ENCODER_CHANNELS, NetworkShape};
use super::window::Visit;

/// The layers of one set of parameters, and room for one frame.
#[derive(Debug)]
pub(crate) struct Inference {
    shape: NetworkShape,
    sparse: Sparse,
    dense: [Dense; 2],
    linear: Linear,
    gru: Gru,
    decoder: DecoderLayers,
    everything: Dropout,
    encoder_maps: [Buffer; 3],
    linear_input: Buffer,
    decoder_maps: Vec<Buffer>,
    /// One state of the padded grid, row by row.
    rows: Vec<f32>,
    scratch: [Scratch; DECODER_CHANNELS.len()],
    /// What lost channels add to each doubling: nothing, as none are lost.
    no_constants: Buffer,
    /// No channel's constant is taken out.
    no_floors: Vec<f32>,
    states: Vec<u16>,
}

/// The running statistics of a normalisation.
fn running(statistics: &Tensors, norm: &str) -> Statistics {
    let tensor = |what: &str| statistics.get(&format!("{norm}.{what}"));
    Statistics::running(tensor("running_mean"), tensor("running_var"))
}

impl Inference {
    pub(crate) fn new(shape: &NetworkShape, parameters: &Tensors, statistics: &Tensors) -> Self {
        let convolutions = shape.convolutions();
        let norms: [_; 3] = std::array::from_fn(|stage| {
            encoder_norm(stage, parameters, running(statistics, ENCODER[stage][1]))
        });
        let (weight, bias) = parameters.layer(ENCODER[0][0]);
        let mut decoder = DecoderLayers::new(shape, parameters);
        decoder.norms = DECODER_NORMS
            .iter()
            .map(|norm| {
                let (weight, bias) = parameters.layer(norm);
                super::batch_norm::Norm::new(running(statistics, norm), weight, bias)
            })
            .collect();
        let scratch = std::array::from_fn(|level| decoder.doublings[level].scratch());
        let constants = decoder
            .doublings
            .iter()
            .map(|doubling| doubling.channels_out * doubling.output().length());
        let inputs = decoder.doublings.iter().map(|doubling| doubling.input);
        let maps = inputs
            .zip(DECODER_CHANNELS)
            .map(|(input, channels)| Buffer::zeros(input.length() * channels));
        let output = decoder.doublings[3].output();
        let logits = output.length() * shape.n_states;
        Self {
            sparse: Sparse::new(convolutions[0], weight, bias),
            dense: [1, 2].map(|stage| {
                let (weight, bias) = parameters.layer(ENCODER[stage][0]);
                Dense::new(convolutions[stage], weight, bias, &norms[stage - 1])
            }),
            linear: Linear::new(convolutions[2], shape.encoding, parameters, &norms[2]),
            gru: Gru::new(parameters, shape.encoding, shape.hidden),
            everything: Dropout::off(1),
            encoder_maps: convolutions.map(|conv| Buffer::zeros(conv.outputs())),
            linear_input: Buffer::zeros(convolutions[2].outputs()),
            decoder_maps: maps.chain([Buffer::zeros(logits)]).collect(),
            rows: vec![0.0; output.pixels()],
            scratch,
            no_constants: Buffer::zeros(constants.max().unwrap_or(0)),
            no_floors: vec![0.0; DECODER_CHANNELS[0]],
            states: (0..shape.n_states as u16).collect(),
            decoder,
            shape: *shape,
        }
    }

    /// `Encoder(y)` of eq. 9.
    #[inline(always)]
    fn encode<A: Arithmetic>(&mut self, visits: &[Visit], encoding: &mut [f32]) {
        const ONES: [f32; ENCODER_CHANNELS[0]] = [1.0; ENCODER_CHANNELS[0]];
        let [first, second, third] = &mut self.encoder_maps;
        let kept = |stage: usize| self.everything.encoder[stage].kept(0);
        self.sparse.forward::<A>(visits, &ONES, first);
        self.dense[0].forward::<A>(first, kept(0), &ONES, second);
        self.dense[1].forward::<A>(second, kept(1), &ONES, third);
        self.linear
            .forward::<A>(third, &mut self.linear_input, encoding);
    }

    /// `Decoder(h)` of eq. 9: probabilities, one plane of the padded grid per state.
    #[inline(always)]
    fn decode<A: Arithmetic>(&mut self, hidden: &[f32]) {
        let kept = |level: usize| match self.everything.decoder.get(level) {
            Some(mask) => mask.kept(0),
            None => &self.states,
        };
        self.decoder
            .seed
            .forward::<A>(hidden, kept(0), 1.0, &mut self.decoder_maps[0]);
        for level in 0..DECODER_CHANNELS.len() {
            let (doubling, norm) = (&self.decoder.doublings[level], &self.decoder.norms[level]);
            let scratch = &mut self.scratch[level];
            let (before, after) = self.decoder_maps.split_at_mut(level + 1);
            let floors = &self.no_floors[..doubling.channels_in];
            doubling.values::<A>(&before[level], kept(level), norm, floors, scratch);
            let channels = [kept(level), kept(level + 1)];
            doubling.forward::<A>(channels, &self.no_constants, 1.0, scratch, &mut after[0]);
        }
        self.normalise::<A>();
    }

    /// Softmax over the states, in place of the logits.
    #[inline(always)]
    fn normalise<A: Arithmetic>(&mut self) {
        let length = self.decoder.doublings[3].output().length();
        let logits = self.decoder_maps.last_mut().expect("invariant: five maps");
        let mut lanes = vec![Lanes::ZERO; self.states.len()];
        let mut probabilities = lanes.clone();
        for first in (0..length).step_by(LANES) {
            for (state, lanes) in lanes.iter_mut().enumerate() {
                *lanes = Lanes::load(&logits[state * length + first..]);
            }
            softmax::<A>(&lanes, &mut probabilities);
            for (state, lanes) in probabilities.iter().enumerate() {
                lanes.store(&mut logits[state * length + first..]);
            }
        }
    }

    /// Copies the probabilities of the grid's cells, `[S, H, W]`.
    #[inline(always)]
    fn cut_to_grid<A: Arithmetic>(&mut self, prediction: &mut [f32]) {
        let (height, width) = self.shape.grid.dim();
        let output = self.decoder.doublings[3].output();
        let probabilities = self.decoder_maps.last().expect("invariant: five maps");
        let states = probabilities.chunks_exact(output.length());
        for (from, to) in states.zip(prediction.chunks_exact_mut(height * width)) {
            output.to_rows::<A>(from, &mut self.rows);
            let rows = self.rows.chunks_exact(output.size()[1]);
            for (from, to) in rows.zip(to.chunks_exact_mut(width)) {
                to.copy_from_slice(&from[..width]);
            }
        }
    }
}

/// `h_{k+1}` and the predictor `u_{k+1}` from `h_k` and a frame (eq. 9).
pub(crate) struct Advance<'a> {
    pub(crate) inference: &'a mut Inference,
    pub(crate) visits: &'a [Visit],
    pub(crate) hidden: &'a mut Vec<f32>,
    /// `[S, H, W]`.
    pub(crate) prediction: &'a mut [f32],
}

impl Kernel for Advance<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(self) {
        let n_hidden = self.hidden.len();
        let mut encoding = vec![0.0; self.inference.shape.encoding];
        self.inference.encode::<A>(self.visits, &mut encoding);
        let Trace { hidden, .. } = self.inference.gru.forward::<A>(self.hidden, &encoding);
        self.hidden.copy_from_slice(&hidden[n_hidden..]);
        self.inference.decode::<A>(self.hidden);
        self.inference.cut_to_grid::<A>(self.prediction);
    }
}

/// `Decoder(h)` alone: what is predicted before any frame.
pub(crate) struct Decode<'a> {
    pub(crate) inference: &'a mut Inference,
    pub(crate) hidden: &'a [f32],
    /// `[S, H, W]`.
    pub(crate) prediction: &'a mut [f32],
}

impl Kernel for Decode<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(self) {
        self.inference.decode::<A>(self.hidden);
        self.inference.cut_to_grid::<A>(self.prediction);
    }
}
