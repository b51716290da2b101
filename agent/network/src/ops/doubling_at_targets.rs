//! The decoder's last doubling, at the cells that are to be predicted only.
//!
//! Of each frame, the input's cells that meet a target are gathered as rows of all channels, a lost one's being
//! `relu(b)`; a product with the kernels gives what each of their taps adds.

use super::cpu::{frames, numbers, slice, tensor, total};
use super::norm::{Moments, Norm, Sums, finish};
use super::planes::Planes;
use super::product::{Left, Right, add_product, steps};
use super::taps::{SIDE, Sizes, TAPS, meeting};
use crate::dropout::Mask;
use crate::window::Window;
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor};

/// Arguments as of [`super::doubling::Doubling`]; the result is `[targets, channels out]`.
pub(crate) struct DoublingAtTargets {
    /// Dropout of `z`.
    pub(crate) input: Mask,
    /// Of `z` after its dropout.
    pub(crate) moments: Moments,
    pub(crate) window: Window,
}

/// One call: what all frames share.
struct Call<'a> {
    op: &'a DoublingAtTargets,
    sizes: Sizes,
    norm: Norm,
    z: Planes<'a>,
    /// `[channels in, channels out * taps]`.
    kernels: &'a [f32],
}

/// One frame's cells that meet a target, and room for their numbers.
struct Room {
    cells: Vec<usize>,
    /// Where in `cells` each cell of the input is, if it meets a target.
    slots: Vec<usize>,
    /// `[cells, channels in]`.
    x: Vec<f32>,
    dx: Vec<f32>,
    /// `[cells, channels out * taps]`.
    taps: Vec<f32>,
}

/// One chunk's sums in the backward pass.
struct Gradients {
    room: Room,
    kernels: Vec<f32>,
    sums: Sums,
}

impl Room {
    fn new(sizes: &Sizes) -> Self {
        Self {
            cells: Vec::new(),
            slots: vec![NOWHERE; sizes.area()],
            x: vec![0.0; sizes.area() * sizes.channels_in],
            dx: vec![0.0; sizes.area() * sizes.channels_in],
            taps: vec![0.0; sizes.area() * sizes.channels_out * TAPS],
        }
    }
}

/// The slot of a cell that meets no target.
const NOWHERE: usize = usize::MAX;

impl Call<'_> {
    /// Numbers of a cell's taps.
    fn n_taps(&self) -> usize {
        self.sizes.channels_out * TAPS
    }

    /// Calls `f(target, cell of the input, tap)` for all that meet.
    #[inline(always)]
    fn for_each_meeting(&self, frame: usize, mut f: impl FnMut(usize, usize, usize)) {
        for (target, visit) in self.op.window.targets(frame).iter().enumerate() {
            for (tap_row, row) in meeting(usize::from(visit.row), self.sizes.rows) {
                for (tap_col, col) in meeting(usize::from(visit.col), self.sizes.cols) {
                    f(
                        target,
                        row * self.sizes.cols + col,
                        tap_row * SIDE + tap_col,
                    );
                }
            }
        }
    }

    /// Finds a frame's cells and gathers their numbers after normalisation and ReLU.
    #[inline(always)]
    fn read(&self, frame: usize, room: &mut Room) {
        let n_in = self.sizes.channels_in;
        for cell in room.cells.drain(..) {
            room.slots[cell] = NOWHERE;
        }
        self.for_each_meeting(frame, |_, cell, _| {
            if room.slots[cell] == NOWHERE {
                room.slots[cell] = room.cells.len();
                room.cells.push(cell);
            }
        });
        let rows = room.x.chunks_exact_mut(n_in).take(room.cells.len());
        for x in rows {
            for (x, b) in x.iter_mut().zip(&self.norm.b) {
                *x = b.max(0.0);
            }
        }
        for (channel, z) in self.z.kept(frame) {
            let (a, b) = (self.norm.a[channel], self.norm.b[channel]);
            for (slot, cell) in room.cells.iter().enumerate() {
                room.x[slot * n_in + channel] = (a * z[*cell] + b).max(0.0);
            }
        }
    }

    fn rows_of_kernels(&self) -> Vec<usize> {
        steps(self.sizes.channels_in, self.n_taps())
    }

    /// The frame's part of the result.
    #[inline(always)]
    fn forward(&self, frame: usize, room: &mut Room, out: &mut [f32]) {
        self.read(frame, room);
        let (n_in, n_out) = (self.sizes.channels_in, self.sizes.channels_out);
        let (n_cells, n_taps) = (room.cells.len(), self.n_taps());
        room.taps[..n_cells * n_taps].fill(0.0);
        let left = Left {
            numbers: &room.x,
            rows: &steps(n_cells, n_in),
            terms: &steps(n_in, 1),
        };
        let right = Right {
            numbers: self.kernels,
            terms: &self.rows_of_kernels(),
            cols: n_taps,
        };
        add_product(&mut room.taps, &steps(n_cells, n_taps), left, right);
        self.for_each_meeting(frame, |target, cell, tap| {
            let taps = &room.taps[room.slots[cell] * n_taps..][..n_taps];
            for (out, taps) in out[target * n_out..][..n_out]
                .iter_mut()
                .zip(taps.as_chunks::<TAPS>().0)
            {
                *out += taps[tap];
            }
        });
    }

    fn all_frames(&self) -> Vec<f32> {
        let (n_out, window) = (self.sizes.channels_out, &self.op.window);
        let mut out = vec![0.0; window.all_targets().len() * n_out];
        let start = |frame| window.target_start(frame) * n_out;
        let new = || Room::new(&self.sizes);
        frames(
            &mut out,
            window.len(),
            start,
            new,
            #[inline(always)]
            |room, frame, out| {
                self.forward(frame, room, out);
            },
        );
        out
    }

    /// Gradients of `z`, of `[gamma; beta]` and of the kernels.
    fn gradients(&self, d_out: &[f32]) -> [Vec<f32>; 3] {
        let mut dz = vec![0.0; self.z.len()];
        let (n_in, n_taps) = (self.sizes.channels_in, self.n_taps());
        let turned = (0..self.kernels.len()).map(|at| self.kernels[at % n_in * n_taps + at / n_in]);
        let turned: Vec<f32> = turned.collect();
        let new = || Gradients {
            room: Room::new(&self.sizes),
            kernels: vec![0.0; self.kernels.len()],
            sums: Sums::new(n_in),
        };
        let start = |frame| self.z.start(frame);
        let n_frames = self.op.window.len();
        let chunks = frames(
            &mut dz,
            n_frames,
            start,
            new,
            #[inline(always)]
            |chunk, frame, dz| {
                let first = self.op.window.target_start(frame) * self.sizes.channels_out;
                self.read(frame, &mut chunk.room);
                self.backward(frame, chunk, &d_out[first..], &turned);
                self.gradients_of_frame(frame, chunk, dz);
            },
        );
        let (kernels, sums): (Vec<_>, Vec<_>) = chunks
            .into_iter()
            .map(|chunk| (chunk.kernels, chunk.sums))
            .unzip();
        let (d_weights, terms) = self.norm.backward(&Sums::total(sums));
        finish(&terms, &self.z, &mut dz);
        [dz, d_weights, total(kernels)]
    }

    /// From the gradient of the result, that of `x`, and adds that of the kernels.
    #[inline(always)]
    fn backward(&self, frame: usize, chunk: &mut Gradients, d_out: &[f32], turned: &[f32]) {
        let (n_in, n_out) = (self.sizes.channels_in, self.sizes.channels_out);
        let (room, n_taps) = (&mut chunk.room, self.n_taps());
        let n_cells = room.cells.len();
        room.taps[..n_cells * n_taps].fill(0.0);
        self.for_each_meeting(frame, |target, cell, tap| {
            let taps = &mut room.taps[room.slots[cell] * n_taps..][..n_taps];
            for (taps, d) in taps
                .as_chunks_mut::<TAPS>()
                .0
                .iter_mut()
                .zip(&d_out[target * n_out..])
            {
                taps[tap] += d;
            }
        });
        let (cells, inputs) = (steps(n_cells, n_taps), steps(n_cells, n_in));
        room.dx[..n_cells * n_in].fill(0.0);
        let left = Left {
            numbers: &room.taps,
            rows: &cells,
            terms: &steps(n_taps, 1),
        };
        let right = Right {
            numbers: turned,
            terms: &steps(n_taps, n_in),
            cols: n_in,
        };
        add_product(&mut room.dx, &inputs, left, right);
        let left = Left {
            numbers: &room.x,
            rows: &steps(n_in, 1),
            terms: &inputs,
        };
        let right = Right {
            numbers: &room.taps,
            terms: &cells,
            cols: n_taps,
        };
        add_product(&mut chunk.kernels, &self.rows_of_kernels(), left, right);
    }

    /// Leaves the gradients behind the normalisation in `dz`.
    #[inline(always)]
    fn gradients_of_frame(&self, frame: usize, chunk: &mut Gradients, dz: &mut [f32]) {
        let (n_in, area, room) = (self.sizes.channels_in, self.sizes.area(), &chunk.room);
        let mut is_kept = vec![false; n_in];
        for (index, (channel, z)) in self.z.kept(frame).enumerate() {
            is_kept[channel] = true;
            let dz = &mut dz[self.z.place(frame, index)..][..area];
            for (slot, cell) in room.cells.iter().enumerate() {
                if room.x[slot * n_in + channel] > 0.0 {
                    dz[*cell] = room.dx[slot * n_in + channel];
                }
            }
            chunk.sums.add(channel, dz, z);
        }
        for channel in (0..n_in).filter(|channel| !is_kept[*channel] && self.norm.b[*channel] > 0.0)
        {
            let dx = room.dx[channel..]
                .iter()
                .step_by(n_in)
                .take(room.cells.len());
            chunk.sums.lost[channel] += f64::from(dx.sum::<f32>());
        }
    }
}

impl DoublingAtTargets {
    fn call<'a>(
        &'a self,
        sizes: Sizes,
        z: &'a [f32],
        weights: &[f32],
        kernels: &'a [f32],
    ) -> Call<'a> {
        Call {
            norm: Norm::new(weights, &self.moments, self.input.scale()),
            z: Planes::new(z, sizes.area(), &self.input),
            op: self,
            sizes,
            kernels,
        }
    }
}

impl CustomOp3 for DoublingAtTargets {
    fn name(&self) -> &'static str {
        "doubling-at-targets"
    }

    fn cpu_fwd(
        &self,
        z: &CpuStorage,
        z_layout: &Layout,
        weights: &CpuStorage,
        weights_layout: &Layout,
        kernels: &CpuStorage,
        kernels_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let sizes = Sizes::new(z_layout.dims(), kernels_layout.dims());
        let (z, kernels) = (slice(z, z_layout)?, slice(kernels, kernels_layout)?);
        let call = self.call(sizes, z, slice(weights, weights_layout)?, kernels);
        let dims = (self.window.all_targets().len(), sizes.channels_out);
        Ok((CpuStorage::F32(call.all_frames()), dims.into()))
    }

    fn bwd(
        &self,
        z: &Tensor,
        weights: &Tensor,
        kernels: &Tensor,
        _out: &Tensor,
        d_out: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let sizes = Sizes::new(z.dims(), kernels.dims());
        let d_out = d_out.contiguous()?;
        let arguments = [numbers(z)?, numbers(weights)?, numbers(kernels)?];
        let call = self.call(sizes, &arguments[0], &arguments[1], &arguments[2]);
        let [dz, d_weights, d_kernels] = call.gradients(&numbers(&d_out)?);
        Ok((
            Some(tensor(dz, z.shape())?),
            Some(tensor(d_weights, weights.shape())?),
            Some(tensor(d_kernels, kernels.shape())?),
        ))
    }
}
