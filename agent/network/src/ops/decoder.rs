//! The decoder as one operator: a seed of few cells, four doublings, and the loss at visited cells.
//!
//! The loss is one number, so its gradients are computed with it, and what lies between the levels is never a
//! tensor. Of the last level, the output is computed where it is visited, unless that is almost everywhere.

use super::cell_loss::CellLoss;
use super::cpu::{Frames, add_scaled, derived, dot, frames, numbers, total};
use super::doubling::{Doubling, Gradients};
use super::norm::{Moments, Norm, NormGradient, Sums};
use super::taps::{Sizes, TAPS};
use crate::dropout::Mask;
use crate::window::{Visit, Window};
use candle_core::{Device, Result, Tensor};

/// One in so many cells of a frame may be visited for them to be computed one by one.
const SPARSE: usize = 16;

/// Arguments of the operator.
pub(crate) struct Layers<'a> {
    /// `[frames, hidden]`.
    pub(crate) hidden: &'a Tensor,
    /// `[hidden, channels, rows, cols]`.
    pub(crate) seed: &'a Tensor,
    /// Of each level gamma and beta of its normalisation, and kernels `[channels in, channels out, 4, 4]`.
    pub(crate) levels: Vec<[&'a Tensor; 3]>,
    /// Dropout before each level, and behind the last.
    pub(crate) masks: Vec<&'a Mask>,
}

/// The hidden vectors and the matrix between them and the first planes.
struct Seed<'a> {
    hidden: &'a [f32],
    weights: &'a [f32],
    mask: &'a Mask,
    area: usize,
}

/// Everything before the last level's output.
struct Forward<'a> {
    seed: Seed<'a>,
    levels: Vec<Doubling<'a>>,
    /// What each level begins with.
    z: Vec<Frames>,
}

/// Sums of the last level.
struct Last<'a> {
    gradients: Gradients,
    loss: CellLoss<'a>,
    logits: Vec<f32>,
    /// Of one cell.
    cell: Vec<f32>,
}

impl<'a> Layers<'a> {
    /// Logits of all cells, `[frames, states, rows, cols]`, through which no gradient goes. `moments` gives those
    /// of a level from those of the window.
    pub(crate) fn logits(
        &self,
        moments: impl FnMut(usize, Moments) -> Result<Moments>,
    ) -> Result<Tensor> {
        self.forward(moments, |forward| {
            let (last, z) = forward.last();
            let sizes = &last.sizes;
            let dims = (
                last.input.n_frames(),
                sizes.channels_out,
                2 * sizes.rows,
                2 * sizes.cols,
            );
            Tensor::from_vec(last.all_frames(z).0.concat(), dims, &Device::Cpu)
        })
    }

    /// The mean loss over a window's targets, with `O [observations, states]`.
    pub(crate) fn loss(
        &self,
        window: &Window,
        observation: &Tensor,
        moments: impl FnMut(usize, Moments) -> Result<Moments>,
    ) -> Result<Tensor> {
        let (loss, gradients) = self.forward(moments, |forward| {
            Ok(forward.loss(window, &numbers(observation)?))
        })?;
        let mut from = vec![self.hidden, self.seed];
        from.extend(self.levels.iter().flatten());
        from.push(observation);
        derived(&from, (), vec![loss as f32], move |d_loss| {
            gradients.iter().map(|d| d * d_loss[0]).collect()
        })
    }

    fn forward<R>(
        &self,
        mut moments: impl FnMut(usize, Moments) -> Result<Moments>,
        then: impl FnOnce(Forward<'_>) -> Result<R>,
    ) -> Result<R> {
        let (hidden, weights) = (numbers(self.hidden)?, numbers(self.seed)?);
        let (_, _, mut rows, mut cols) = self.seed.dims4()?;
        let weights_of = |[gamma, beta, kernels]: &[&'a Tensor; 3]| {
            Ok([numbers(gamma)?, numbers(beta)?, numbers(kernels)?])
        };
        let weights_of_levels: Vec<_> =
            self.levels.iter().map(weights_of).collect::<Result<_>>()?;
        let seed = Seed {
            hidden: &hidden,
            weights: &weights,
            mask: self.masks[0],
            area: rows * cols,
        };
        let (mut planes, mut sums) = seed.forward();
        let (mut levels, mut z) = (Vec::<Doubling<'_>>::new(), Vec::new());
        for (level, [gamma, beta, kernels]) in weights_of_levels.iter().enumerate() {
            if let Some(before) = levels.last() {
                let next;
                (next, sums) = before.all_frames(&planes);
                z.push(std::mem::replace(&mut planes, next));
            }
            let masks = [self.masks[level], self.masks[level + 1]];
            let scale = masks[0].scale();
            let of_window = Moments::new(&sums, scale, masks[0].n_frames() * rows * cols);
            let norm = Norm::new([gamma, beta], moments(level, of_window)?, scale);
            let sizes = Sizes {
                channels_in: masks[0].channels(),
                channels_out: masks[1].channels(),
                rows,
                cols,
            };
            levels.push(Doubling::new(sizes, kernels, masks, norm));
            (rows, cols) = (2 * rows, 2 * cols);
        }
        z.push(planes);
        then(Forward { seed, levels, z })
    }
}

impl Seed<'_> {
    /// The weights from one hidden number to a kept channel.
    #[inline(always)]
    fn row(&self, at: usize, channel: usize) -> std::ops::Range<usize> {
        let first = (at * self.mask.channels() + channel) * self.area;
        first..first + self.area
    }

    fn n_hidden(&self) -> usize {
        self.hidden.len() / self.mask.n_frames()
    }

    fn hidden(&self, frame: usize) -> &[f32] {
        &self.hidden[frame * self.n_hidden()..][..self.n_hidden()]
    }

    fn forward(&self) -> (Frames, Sums) {
        let (z, sums) = frames(
            self.mask.n_frames(),
            |frame| self.mask.kept(frame).len() * self.area,
            || Sums::new(self.mask.channels()),
            #[inline(always)]
            |sums, frame, z| {
                let planes = z.chunks_exact_mut(self.area);
                for (&channel, z) in self.mask.kept(frame).iter().zip(planes) {
                    for (at, &h) in self.hidden(frame).iter().enumerate() {
                        add_scaled(z, h, &self.weights[self.row(at, channel)]);
                    }
                    sums.add(channel, z, z);
                }
            },
        );
        (z, Sums::total(&sums))
    }

    /// Gradients of the hidden vectors and of the weights. `dz` writes that of a frame's planes.
    fn backward(&self, write: impl Fn(usize, &mut [f32]) + Sync) -> [Vec<f32>; 2] {
        let n_planes = self.mask.channels();
        let new = || {
            (
                vec![0.0; self.weights.len()],
                vec![0.0; n_planes * self.area],
            )
        };
        let (d_hidden, d_weights) = frames(
            self.mask.n_frames(),
            |_| self.n_hidden(),
            new,
            #[inline(always)]
            |(d_weights, dz), frame, d_hidden| {
                let kept = self.mask.kept(frame);
                write(frame, &mut dz[..kept.len() * self.area]);
                for (&channel, dz) in kept.iter().zip(dz.chunks_exact(self.area)) {
                    for (at, &h) in self.hidden(frame).iter().enumerate() {
                        let row = self.row(at, channel);
                        d_hidden[at] += dot(dz, &self.weights[row.clone()]);
                        add_scaled(&mut d_weights[row], h, dz);
                    }
                }
            },
        );
        let d_weights = total(d_weights.into_iter().map(|(d_weights, _)| d_weights));
        [d_hidden.concat(), d_weights]
    }
}

impl Forward<'_> {
    fn last(&self) -> (&Doubling<'_>, &Frames) {
        let level = self.levels.len() - 1;
        (&self.levels[level], &self.z[level])
    }

    /// The loss, and all gradients one after the other, in the order of the arguments.
    fn loss(&self, window: &Window, observation: &[f32]) -> (f64, Vec<f32>) {
        let (mut dy, chunks) = self.last_level(window, observation);
        let (mut loss, mut d_observation, mut gradients) = (0.0, vec![], vec![]);
        for chunk in chunks {
            loss += chunk.loss.loss;
            d_observation.push(chunk.loss.d_observation);
            gradients.push(chunk.gradients);
        }
        let mut level = self.levels.len() - 1;
        let (mut d_kernels, mut norm) = self.levels[level].finish(gradients);
        let mut parts = vec![total(d_observation).iter().map(|&d| d as f32).collect()];
        while level > 0 {
            parts.extend([d_kernels, norm.beta.clone(), norm.gamma.clone()]);
            let chunks;
            (dy, chunks) = self.level(level - 1, &dy, &norm);
            level -= 1;
            (d_kernels, norm) = self.levels[level].finish(chunks);
        }
        let [d_hidden, d_seed] = self.seed.backward(
            #[inline(always)]
            |frame, dz| self.normalise_gradient(0, &norm, frame, &dy, dz),
        );
        parts.extend([d_kernels, norm.beta, norm.gamma, d_seed, d_hidden]);
        parts.reverse();
        (loss, parts.concat())
    }

    /// A frame's gradient before a level's normalisation, from the one behind it.
    #[inline(always)]
    fn normalise_gradient(
        &self,
        level: usize,
        norm: &NormGradient,
        frame: usize,
        dy: &Frames,
        dz: &mut [f32],
    ) {
        let z = (frame, &self.z[level]);
        self.levels[level].normalise_gradient(norm, z, dy.frame(frame), dz);
    }

    /// Gradients behind a level's normalisation, from those behind the next one's.
    fn level(&self, level: usize, dy: &Frames, next: &NormGradient) -> (Frames, Vec<Gradients>) {
        let (doubling, z) = (&self.levels[level], &self.z[level]);
        let (area, out_area) = (doubling.sizes.area(), doubling.sizes.out_area());
        let new = || {
            let length = doubling.sizes.channels_out * out_area;
            (doubling.gradients(), vec![0.0; length])
        };
        let (dy, chunks) = frames(
            doubling.input.n_frames(),
            |frame| doubling.input.kept(frame).len() * area,
            new,
            #[inline(always)]
            |(gradients, d_out), frame, to| {
                let length = doubling.output.kept(frame).len() * out_area;
                let d_out = &mut d_out[..length];
                self.normalise_gradient(level + 1, next, frame, dy, d_out);
                doubling.read(frame, z, &mut gradients.room);
                doubling.backward_of_frame(gradients, (frame, z), d_out, to);
            },
        );
        (
            dy,
            chunks.into_iter().map(|(gradients, _)| gradients).collect(),
        )
    }

    /// The last level's sums, and gradients behind its normalisation.
    fn last_level<'a>(&self, window: &Window, observation: &'a [f32]) -> (Frames, Vec<Last<'a>>) {
        let (last, z) = self.last();
        let (n_states, area) = (last.sizes.channels_out, last.sizes.area());
        let weight = 1.0 / window.all_targets().len() as f32;
        let new = || Last {
            gradients: last.gradients(),
            loss: CellLoss::new(observation, n_states, weight),
            logits: vec![0.0; n_states * last.sizes.out_area()],
            cell: vec![0.0; n_states],
        };
        frames(
            last.input.n_frames(),
            |frame| last.input.kept(frame).len() * area,
            new,
            #[inline(always)]
            |to, frame, dy| {
                let targets = window.targets(frame);
                if targets.len() * SPARSE < last.sizes.out_area() {
                    to.few(last, (frame, z), targets, dy)
                } else {
                    to.many(last, (frame, z), targets, dy)
                }
            },
        )
    }
}

impl Last<'_> {
    /// A frame of which much is visited: all logits, then those of visited cells give place to their gradients.
    #[inline(always)]
    fn many(
        &mut self,
        last: &Doubling<'_>,
        (frame, z): (usize, &Frames),
        targets: &[Visit],
        dy: &mut [f32],
    ) {
        let room = &mut self.gradients.room;
        last.read(frame, z, room);
        let channels = [last.input.kept(frame), last.output.kept(frame)];
        last.forward(room, channels, &mut self.logits);
        let (area, cols) = (last.sizes.out_area(), 2 * last.sizes.cols);
        let mut done = 0;
        for visit in targets {
            let at = usize::from(visit.row) * cols + usize::from(visit.col);
            for (state, logit) in self.cell.iter_mut().enumerate() {
                *logit = self.logits[state * area + at];
                self.logits[state * area + done..state * area + at].fill(0.0);
            }
            self.loss.add(&mut self.cell, visit.value);
            for (state, d_logit) in self.cell.iter().enumerate() {
                self.logits[state * area + at] = *d_logit;
            }
            done = at + 1;
        }
        for logits in self.logits.chunks_exact_mut(area) {
            logits[done..].fill(0.0);
        }
        last.backward_of_frame(&mut self.gradients, (frame, z), &self.logits, dy);
    }

    /// A frame of which little is visited: cell by cell.
    #[inline(always)]
    fn few(
        &mut self,
        last: &Doubling<'_>,
        (frame, z): (usize, &Frames),
        targets: &[Visit],
        dy: &mut [f32],
    ) {
        let (sizes, kept) = (&last.sizes, last.input.kept(frame));
        let (area, n_states) = (sizes.area(), sizes.channels_out);
        let to = &mut self.gradients;
        last.read(frame, z, &mut to.room);
        to.room.dx[..kept.len() * area].fill(0.0);
        for visit in targets {
            let (row, col) = (usize::from(visit.row), usize::from(visit.col));
            let out = row * 2 * sizes.cols + col;
            last.logits_at([row, col], frame, &to.room, &mut self.cell);
            self.loss.add(&mut self.cell, visit.value);
            for (tap, cell) in sizes.meets(row, col) {
                for (index, channel) in kept.iter().enumerate() {
                    let x = to.room.x_at(sizes, index, cell);
                    let dx = &mut to.room.dx[index * area + cell];
                    for (state, d) in self.cell.iter().enumerate() {
                        let at = (channel * n_states + state) * TAPS + tap;
                        *dx += last.kernels[at] * d;
                        to.kernels[at] += x * d;
                    }
                }
            }
            for (state, d) in self.cell.iter().enumerate() {
                to.d_out[state * sizes.out_area() + out] += d;
            }
        }
        last.rectify(to, (frame, z), dy);
    }
}
