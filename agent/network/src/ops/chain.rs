//! Convolutions with dropout, normalisation and ReLU between them, over all frames of a window and with all gradients.
//!
//! Between the passes over the frames only the convolutions' results are kept; what is cheap is computed again. Of each
//! frame, only the channels that dropout keeps are stored and computed. Dropout makes a lost channel zero, and
//! normalisation and ReLU make that a constant, its *floor*. As a convolution is linear, `conv(x) = conv(x - floors) +
//! conv(floors)`: in the first term lost channels are zero, and the second is the same for all frames and computed
//! once. Gradients follow the same split.
//!
//! What lies between two convolutions has two steps, one before the normalisation and one behind it; one of them is
//! ReLU ([`Order`]).

use super::conv::{Conv, Room};
use super::cpu::{Frames, add, derived, frames, numbers, sum, total};
use super::norm::{Moments, Norm, Sums};
use crate::dropout::Mask;
use candle_core::{Result, Tensor};

/// A convolution, and the normalisation before it.
pub(crate) struct Layer<'a> {
    pub(crate) conv: Conv,
    /// Whether it gives large maps of small ones.
    pub(crate) transposed: bool,
    /// `[kernel rows * kernel cols * large channels, small channels]`.
    pub(crate) weights: Tensor,
    pub(crate) bias: Option<&'a Tensor>,
    /// Gamma and beta; none before the first convolution of a window.
    pub(crate) norm: Option<[&'a Tensor; 2]>,
    /// Dropout of its result.
    pub(crate) output: &'a Mask,
}

/// What lies between dropout and the next convolution.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Order {
    /// ReLU, then the normalisation: the encoder. Dropout must scale by more than zero.
    ReluFirst,
    /// The normalisation, then ReLU: the decoder.
    NormFirst,
}

/// Layers that have read all frames.
pub(crate) struct Chain {
    stages: Vec<Stage>,
    /// What each stage has read, before normalisation and ReLU.
    z: Vec<Frames>,
}

struct Stage {
    conv: Conv,
    transposed: bool,
    weights: Tensor,
    has_bias: bool,
    before: Before,
    output: Mask,
    /// What the result of every frame begins with: the bias and what becomes of the constants, `[channels, cells]`.
    start: Vec<f32>,
}

/// What lies before a convolution.
struct Before {
    order: Order,
    /// None before the first of a window.
    norm: Option<Norm>,
    mask: Mask,
    /// The constants of lost channels; zero if there are none.
    floors: Vec<f32>,
}

/// Sums over frames of a stage's gradients, and room for one.
struct Gradients {
    room: Room,
    plane: Vec<f32>,
    d_out: Vec<f32>,
    dx: Vec<f32>,
    weights: Vec<f32>,
    /// Of what results begin with.
    start: Vec<f32>,
    sums: Sums,
}

impl Chain {
    /// The layers' last result, and what [`Self::backward`] needs, of maps `[frames, channels, rows, cols]` and their
    /// dropout. `moments` gives those of a layer's normalisation from those of the window.
    pub(crate) fn forward(
        (maps, mask): (&Tensor, &Mask),
        layers: &[Layer<'_>],
        order: Order,
        mut moments: impl FnMut(usize, Moments) -> Result<Moments>,
    ) -> Result<(Self, Frames)> {
        let has_norm = |layer: &Layer<'_>| layer.norm.is_some();
        assert!(
            layers[1..].iter().all(has_norm),
            "invariant: only the first layer has no norm"
        );
        let (mut z, mut sums) = kept_of(&numbers(maps)?, mask, order);
        let mut chain = Self {
            stages: Vec::new(),
            z: Vec::new(),
        };
        let mut mask = mask;
        for (index, layer) in layers.iter().enumerate() {
            let mut norm = None;
            if let Some([gamma, beta]) = layer.norm {
                let (scale, count) = (mask.scale(), mask.n_frames() * layer.in_area());
                let moments = moments(index, Moments::new(&sums, scale, count))?;
                let weights = [&*numbers(gamma)?, &*numbers(beta)?];
                norm = Some(Norm::new(weights, moments, scale));
            }
            let before = Before::new(norm, mask.clone(), order);
            let stage = Stage::new(layer, before)?;
            let out;
            (out, sums) = stage.forward(&z, order)?;
            chain.z.push(std::mem::replace(&mut z, out));
            chain.stages.push(stage);
            mask = layer.output;
        }
        Ok((chain, z))
    }

    /// From the gradient of the last result those of all layers, in their order, each as far as a layer has it: gamma,
    /// beta, weights, bias. Before them, if the first layer begins with a normalisation, that of the maps.
    pub(crate) fn backward(&self, last: Frames) -> Result<Vec<f32>> {
        let (mut parts, mut outer) = (Vec::new(), Outer::Given(last));
        for (stage, z) in self.stages.iter().zip(&self.z).rev() {
            let (dy, chunks) = stage.backward(z, &outer)?;
            let (part, terms) = stage.finish(chunks)?;
            parts.push(part);
            let before = &stage.before;
            outer = Outer::Through {
                before,
                z,
                dy,
                terms,
            };
        }
        let first = &self.stages[0];
        if first.before.norm.is_some() {
            parts.push(first.before.dense(first.areas()[0], &outer));
        }
        parts.reverse();
        Ok(parts.concat())
    }
}

/// The planes that dropout keeps, and their sums.
fn kept_of(maps: &[f32], mask: &Mask, order: Order) -> (Frames, Sums) {
    let area = maps.len() / (mask.n_frames() * mask.channels());
    let (planes, sums) = frames(
        mask.n_frames(),
        |frame| mask.kept(frame).len() * area,
        || Sums::new(mask.channels()),
        #[inline(always)]
        |sums, frame, to| {
            for (channel, to) in mask.kept(frame).iter().zip(to.chunks_exact_mut(area)) {
                let first = (frame * mask.channels() + channel) * area;
                to.copy_from_slice(&maps[first..][..area]);
                order.add_moments(sums, *channel, to);
            }
        },
    );
    (planes, Sums::total(&sums))
}

/// The gradient of a stage's result.
enum Outer<'a> {
    Given(Frames),
    /// What the next stage makes of it: `dy` before the second step behind its normalisation.
    Through {
        before: &'a Before,
        z: &'a Frames,
        dy: Frames,
        terms: Vec<[f32; 3]>,
    },
}

impl Outer<'_> {
    /// Writes the planes that a frame keeps.
    #[inline(always)]
    fn write(&self, frame: usize, to: &mut [f32]) {
        match self {
            Self::Given(numbers) => to.copy_from_slice(numbers.frame(frame)),
            Self::Through {
                before,
                z,
                dy,
                terms,
            } => before.normalise_gradient(terms, frame, [z.frame(frame), dy.frame(frame)], to),
        }
    }
}

impl Order {
    /// What is normalised.
    #[inline(always)]
    fn first(self, z: f32) -> f32 {
        match self {
            Self::ReluFirst => z.max(0.0),
            Self::NormFirst => z,
        }
    }

    /// What becomes of it behind the normalisation.
    #[inline(always)]
    fn second(self, y: f32) -> f32 {
        match self {
            Self::ReluFirst => y,
            Self::NormFirst => y.max(0.0),
        }
    }

    #[inline(always)]
    fn add_moments(self, sums: &mut Sums, channel: usize, z: &[f32]) {
        sums.add(
            channel,
            [z, z],
            #[inline(always)]
            |z, _| [self.first(z), self.first(z) * self.first(z)],
        );
    }
}

impl Before {
    fn new(norm: Option<Norm>, mask: Mask, order: Order) -> Self {
        let mut floors = vec![0.0; mask.channels()];
        if let Some(norm) = norm.as_ref().filter(|_| !mask.keeps_all()) {
            floors = norm.b.iter().map(|b| order.second(*b)).collect();
        }
        Self {
            order,
            norm,
            mask,
            floors,
        }
    }

    /// A kept plane behind normalisation and ReLU, less the constant.
    #[inline(always)]
    fn read(&self, channel: usize, z: &[f32], x: &mut [f32]) {
        let Some(norm) = &self.norm else {
            return x.copy_from_slice(z);
        };
        let (a, b, order) = (norm.a[channel], norm.b[channel], self.order);
        let floor = self.floors[channel];
        for (x, z) in x.iter_mut().zip(z) {
            *x = order.second(a * order.first(*z) + b) - floor;
        }
    }

    /// The gradient before the second step from that behind it; adds it to the normalisation's sums.
    #[inline(always)]
    fn take_back(
        &self,
        norm: &Norm,
        channel: usize,
        [z, dx]: [&[f32]; 2],
        (dy, sums): (&mut [f32], &mut Sums),
    ) {
        let (a, b, order) = (norm.a[channel], norm.b[channel], self.order);
        for (dy, (z, dx)) in dy.iter_mut().zip(z.iter().zip(dx)) {
            let passes = order == Order::ReluFirst || a * z + b > 0.0;
            *dy = if passes { *dx } else { 0.0 };
        }
        sums.add(
            channel,
            [dy, z],
            #[inline(always)]
            |dy, z| [dy, dy * order.first(z)],
        );
        if !self.mask.keeps_all() {
            // Lost positions get that of all positions, which `back_of_floors` adds, less this.
            sums.lost[channel] -= f64::from(sum(dx));
        }
    }

    /// `dz` of a frame from its `dy`.
    #[inline(always)]
    fn normalise_gradient(
        &self,
        terms: &[[f32; 3]],
        frame: usize,
        [z, dy]: [&[f32]; 2],
        dz: &mut [f32],
    ) {
        let (kept, order) = (self.mask.kept(frame), self.order);
        let area = (z.len() / kept.len().max(1)).max(1);
        let planes = z.chunks_exact(area).zip(dy.chunks_exact(area));
        let planes = planes.zip(dz.chunks_exact_mut(area));
        for (channel, ((z, dy), dz)) in kept.iter().zip(planes) {
            let [p, q, r] = terms[*channel];
            for (dz, (z, dy)) in dz.iter_mut().zip(z.iter().zip(dy)) {
                let d = p * dy + q * order.first(*z) + r;
                let passes = order == Order::NormFirst || *z > 0.0;
                *dz = if passes { d } else { 0.0 };
            }
        }
    }

    /// Gradients of all frames, with zeros in lost channels; `write` writes those of a frame's kept ones.
    fn dense(&self, area: usize, gradient: &Outer<'_>) -> Vec<f32> {
        let channels = self.mask.channels();
        let (dense, _) = frames(
            self.mask.n_frames(),
            |_| channels * area,
            || vec![0.0; channels * area],
            #[inline(always)]
            |kept, frame, to| {
                let n = self.mask.kept(frame).len() * area;
                gradient.write(frame, &mut kept[..n]);
                for (channel, from) in self.mask.kept(frame).iter().zip(kept.chunks_exact(area)) {
                    to[channel * area..][..area].copy_from_slice(from);
                }
            },
        );
        dense.concat()
    }
}

impl Stage {
    fn new(layer: &Layer<'_>, before: Before) -> Result<Self> {
        let mut stage = Self {
            conv: layer.conv.clone(),
            transposed: layer.transposed,
            weights: layer.weights.clone(),
            has_bias: layer.bias.is_some(),
            before,
            output: layer.output.clone(),
            start: Vec::new(),
        };
        let [_, area] = stage.areas();
        let mut start = vec![0.0; stage.output.channels() * area];
        if let Some(bias) = layer.bias {
            let bias = numbers(bias)?;
            let planes = start.chunks_exact_mut(area).zip(bias.iter());
            planes.for_each(|(plane, bias)| plane.fill(*bias));
        }
        if !stage.before.mask.keeps_all() {
            let mut room = stage.conv.room();
            stage.put_floors(&mut room);
            let (weights, [inputs, outputs]) = (numbers(&stage.weights)?, stage.all_channels());
            stage.convolve(&weights, &mut room, &inputs, &outputs, &mut start);
        }
        stage.start = start;
        Ok(stage)
    }

    /// Cells of what it reads, and of its result.
    fn areas(&self) -> [usize; 2] {
        let (large, small) = (self.conv.large_area(), self.conv.small_area());
        if self.transposed {
            [small, large]
        } else {
            [large, small]
        }
    }

    /// Every channel that it reads, and of its result.
    fn all_channels(&self) -> [Vec<usize>; 2] {
        let [large, small] = self.conv.channels();
        if self.transposed {
            [small, large]
        } else {
            [large, small]
        }
    }

    /// Puts a plane where [`Self::convolve`] reads it.
    #[inline(always)]
    fn put(&self, room: &mut Room, index: usize, plane: &[f32]) {
        if self.transposed {
            self.conv.put_small(room, index, plane);
        } else {
            self.conv.put_large(room, index, plane);
        }
    }

    /// Puts the constants there.
    fn put_floors(&self, room: &mut Room) {
        let mut plane = vec![0.0; self.areas()[0]];
        for (channel, floor) in self.before.floors.iter().enumerate() {
            plane.fill(*floor);
            self.put(room, channel, &plane);
            if self.transposed {
                self.conv.turn_small(room, channel, &plane);
            }
        }
    }

    /// Adds to some channels of a result what becomes of those in `room`.
    #[inline(always)]
    fn convolve(
        &self,
        weights: &[f32],
        room: &mut Room,
        inputs: &[usize],
        outputs: &[usize],
        out: &mut [f32],
    ) {
        if self.transposed {
            self.conv.up(weights, room, [outputs, inputs], out);
        } else {
            self.conv.down(weights, room, [inputs, outputs], out);
        }
    }

    /// Reads a frame's planes: `put(room, index, channel, plane)` takes each.
    #[inline(always)]
    fn read(
        &self,
        (z, frame): (&Frames, usize),
        (plane, room): (&mut [f32], &mut Room),
        put: impl Fn(&mut Room, usize, usize, &[f32]),
    ) {
        let planes = z.frame(frame).chunks_exact(plane.len());
        let kept = self.before.mask.kept(frame).iter();
        for (index, (channel, z)) in kept.zip(planes).enumerate() {
            self.before.read(*channel, z, plane);
            put(room, index, *channel, plane);
        }
    }

    /// The results of all frames, and their sums for a normalisation of this order.
    fn forward(&self, z: &Frames, order: Order) -> Result<(Frames, Sums)> {
        let (weights, [in_area, area]) = (numbers(&self.weights)?, self.areas());
        let weights = &weights[..];
        let (out, sums) = frames(
            self.output.n_frames(),
            |frame| self.output.kept(frame).len() * area,
            || {
                let sums = Sums::new(self.output.channels());
                (self.conv.room(), vec![0.0; in_area], sums)
            },
            #[inline(always)]
            |(room, plane, sums), frame, out| {
                self.read(
                    (z, frame),
                    (plane, room),
                    #[inline(always)]
                    |room, index, _, plane| self.put(room, index, plane),
                );
                let (inputs, outputs) = (self.before.mask.kept(frame), self.output.kept(frame));
                for (channel, out) in outputs.iter().zip(out.chunks_exact_mut(area)) {
                    out.copy_from_slice(&self.start[channel * area..][..area]);
                }
                self.convolve(weights, room, inputs, outputs, out);
                for (channel, out) in outputs.iter().zip(out.chunks_exact(area)) {
                    order.add_moments(sums, *channel, out);
                }
            },
        );
        let sums: Vec<Sums> = sums.into_iter().map(|(_, _, sums)| sums).collect();
        Ok((out, Sums::total(&sums)))
    }

    /// The gradients of all frames before the second step behind the normalisation, and the sums of each chunk.
    fn backward(&self, z: &Frames, outer: &Outer<'_>) -> Result<(Frames, Vec<Gradients>)> {
        let (weights, [in_area, area]) = (numbers(&self.weights)?, self.areas());
        let (weights, before) = (&weights[..], &self.before);
        let n = |frame: usize| before.norm.as_ref().map_or(0, |_| z.frame(frame).len());
        Ok(frames(
            self.output.n_frames(),
            n,
            || self.room_for_gradients(),
            #[inline(always)]
            |to, frame, dy| {
                let (inputs, outputs) = (before.mask.kept(frame), self.output.kept(frame));
                let d_out = &mut to.d_out[..outputs.len() * area];
                outer.write(frame, d_out);
                for (output, d) in outputs.iter().zip(d_out.chunks_exact(area)) {
                    add(&mut to.start[output * area..][..area], d);
                }
                if self.transposed && inputs.len() < before.mask.channels() {
                    self.conv.forget_turned(&mut to.room);
                }
                self.read(
                    (z, frame),
                    (&mut to.plane, &mut to.room),
                    #[inline(always)]
                    |room, index, channel, plane| {
                        self.put_for_gradient(room, [index, channel], plane);
                    },
                );
                self.back(weights, to, inputs, outputs);
                let Some(norm) = &before.norm else {
                    return;
                };
                let planes = z.frame(frame).chunks_exact(in_area);
                let planes = planes.zip(to.dx.chunks_exact(in_area));
                let planes = planes.zip(dy.chunks_exact_mut(in_area));
                for (channel, ((z, dx), dy)) in inputs.iter().zip(planes) {
                    before.take_back(norm, *channel, [z, dx], (dy, &mut to.sums));
                }
            },
        ))
    }

    fn room_for_gradients(&self) -> Gradients {
        let ([in_area, area], [inputs, outputs]) = (self.areas(), self.all_channels());
        Gradients {
            room: self.conv.room(),
            plane: vec![0.0; in_area],
            d_out: vec![0.0; outputs.len() * area],
            dx: vec![0.0; inputs.len() * in_area],
            weights: vec![0.0; self.conv.n_weights()],
            start: vec![0.0; self.start.len()],
            sums: Sums::new(inputs.len()),
        }
    }

    /// Puts a plane that the convolution has read where the gradient of the weights reads it.
    #[inline(always)]
    fn put_for_gradient(&self, room: &mut Room, [index, channel]: [usize; 2], plane: &[f32]) {
        if self.transposed {
            self.conv.turn_small(room, channel, plane);
        } else {
            self.conv.put_large(room, index, plane);
        }
    }

    /// From the gradient `to.d_out` of some outputs of the frame in `to.room`, adds that of the weights, and writes that of
    /// what was read, if it is needed.
    #[inline(always)]
    fn back(&self, weights: &[f32], to: &mut Gradients, inputs: &[usize], outputs: &[usize]) {
        let (conv, room, [in_area, area]) = (&self.conv, &mut to.room, self.areas());
        let dx = &mut to.dx[..inputs.len() * in_area];
        dx.fill(0.0);
        let planes = to.d_out.chunks_exact(area).take(outputs.len());
        if self.transposed {
            for (index, plane) in planes.enumerate() {
                conv.put_large(room, index, plane);
            }
            conv.add_weight_gradient(room, outputs, &mut to.weights);
            conv.down(weights, room, [outputs, inputs], dx);
            return;
        }
        if outputs.len() < self.output.channels() {
            conv.forget_turned(room);
        }
        for (index, (channel, plane)) in outputs.iter().zip(planes).enumerate() {
            conv.put_small(room, index, plane);
            conv.turn_small(room, *channel, plane);
        }
        conv.add_weight_gradient(room, inputs, &mut to.weights);
        if self.before.norm.is_some() {
            conv.up(weights, room, [inputs, outputs], dx);
        }
    }

    /// The gradients of the layer, and, per channel of what it reads, `[p, q, r]` with `dz = p dy + q z + r`.
    fn finish(&self, chunks: Vec<Gradients>) -> Result<(Vec<f32>, Vec<[f32; 3]>)> {
        let (mut weights, mut starts, mut sums) = (vec![], vec![], vec![]);
        for chunk in chunks {
            weights.push(chunk.weights);
            starts.push(chunk.start);
            sums.push(chunk.sums);
        }
        let (mut weights, start, mut sums) = (total(weights), total(starts), Sums::total(&sums));
        let (mut part, mut terms) = (Vec::new(), Vec::new());
        if let Some(norm) = &self.before.norm {
            if !self.before.mask.keeps_all() {
                self.back_of_floors(norm, &start, &mut weights, &mut sums)?;
            }
            let gradient = norm.backward(&sums);
            terms = gradient.terms;
            part.extend(gradient.gamma);
            part.extend(gradient.beta);
        }
        part.extend(weights);
        if self.has_bias {
            part.extend(start.chunks_exact(self.areas()[1]).map(sum));
        }
        Ok((part, terms))
    }

    /// The constants' part: `start` is the gradient of the results' sum over frames.
    fn back_of_floors(
        &self,
        norm: &Norm,
        start: &[f32],
        weights: &mut Vec<f32>,
        sums: &mut Sums,
    ) -> Result<()> {
        let (mut to, [inputs, outputs]) = (self.room_for_gradients(), self.all_channels());
        self.put_floors(&mut to.room);
        to.d_out.copy_from_slice(start);
        std::mem::swap(&mut to.weights, weights);
        self.back(&numbers(&self.weights)?, &mut to, &inputs, &outputs);
        std::mem::swap(&mut to.weights, weights);
        for (channel, dx) in to.dx.chunks_exact(self.areas()[0]).enumerate() {
            let lost = sums.lost[channel] + f64::from(sum(dx));
            let passes = self.before.order == Order::ReluFirst || norm.b[channel] > 0.0;
            sums.lost[channel] = if passes { lost } else { 0.0 };
        }
        Ok(())
    }
}

impl Layer<'_> {
    /// Weights in the order of ours, from those of candle's layers, `[small channels, large channels, rows, cols]`.
    pub(crate) fn weights_of(weights: &Tensor) -> Result<Tensor> {
        let (small, large, rows, cols) = weights.dims4()?;
        let taps = rows * cols;
        let ours = permuted(&numbers(weights)?, [small, large, taps]);
        derived(&[weights], (taps * large, small), ours, move |d| {
            permuted(d, [taps, large, small])
        })
    }

    /// All that it computes with, in the order of the gradients.
    pub(crate) fn tensors(&self) -> Vec<&Tensor> {
        let norm = self.norm.into_iter().flatten();
        norm.chain([&self.weights]).chain(self.bias).collect()
    }

    /// Cells of what it reads.
    fn in_area(&self) -> usize {
        if self.transposed {
            self.conv.small_area()
        } else {
            self.conv.large_area()
        }
    }
}

/// Numbers of `[a, b, c]` as `[c, b, a]`.
fn permuted(numbers: &[f32], [a, b, c]: [usize; 3]) -> Vec<f32> {
    // Rows of `to` are often a power of two apart, and caches hold few such lines at once: through a small tile.
    let (mut to, mut tile) = (vec![0.0; numbers.len()], vec![0.0; a * c]);
    for at_b in 0..b {
        for at_a in 0..a {
            let from = &numbers[(at_a * b + at_b) * c..][..c];
            for (at_c, number) in from.iter().enumerate() {
                tile[at_c * a + at_a] = *number;
            }
        }
        for (at_c, row) in tile.chunks_exact(a).enumerate() {
            to[(at_c * b + at_b) * a..][..a].copy_from_slice(row);
        }
    }
    to
}
