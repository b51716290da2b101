//! A small U-Net: from the features of cells to the logits of what will be seen there.
//!
//! Images are `[batch, rows, cols, channels]`, with sides that [`ALIGNMENT`] divides. Two strides of 2, and back by nearest
//! doubling with what was there before; residual layers, no normalisation. The head begins at zero: all observations
//! alike.

use crate::ops::image_conv::ImageConv;
use crate::variables::uniform_init;
use candle_core::{DType, Result, Tensor};
use candle_nn::{Init, VarBuilder};

/// What sides of images are multiples of: two strides of 2.
pub const ALIGNMENT: usize = 4;

/// Channels at full, half and quarter size.
const CHANNELS: [usize; 3] = [16, 24, 32];

/// Offsets of a cell and its eight neighbours, in the order of a kernel's taps.
const AROUND: usize = 9;

/// Features of cells to logits of observations.
#[derive(Debug)]
pub struct UNet {
    full: Layer,
    down: [[Layer; 2]; 2],
    wide: Layer,
    up: [[Layer; 2]; 2],
    head: Layer,
}

/// A convolution with bias, by candle's layers or our operator.
#[derive(Debug)]
struct Layer {
    conv: ImageConv,
    /// `[kernel * kernel * channels in, channels out]`.
    weight: Tensor,
    bias: Tensor,
    is_stock: bool,
}

impl UNet {
    /// A network whose layers ask `vb` for their variables. Stock layers compute everywhere, ours with 32-bit floats on the
    /// CPU.
    pub fn new(
        vb: &VarBuilder<'_>,
        n_features: usize,
        n_observations: usize,
        is_stock: bool,
    ) -> Result<Self> {
        let is_stock = is_stock || !vb.device().is_cpu() || vb.dtype() != DType::F32;
        let [full, half, quarter] = CHANNELS;
        let layer = |name: &str, channels: [usize; 2], [kernel, stride, dilation]: [usize; 3]| {
            let conv = ImageConv {
                kernel,
                stride,
                dilation,
                relu: kernel > 1,
            };
            Layer::new(&vb.pp(name), channels, conv, is_stock, name == "head")
        };
        let (same, strided, point) = ([3, 1, 1], [3, 2, 1], [1, 1, 1]);
        let pair = |name: &str, from: usize, to: usize, first| -> Result<[Layer; 2]> {
            Ok([
                layer(&format!("{name}.0"), [from, to], first)?,
                layer(&format!("{name}.1"), [to, to], same)?,
            ])
        };
        Ok(Self {
            full: layer("full", [n_features, full], same)?,
            down: [
                pair("down.0", full, half, strided)?,
                pair("down.1", half, quarter, strided)?,
            ],
            wide: layer("wide", [quarter, quarter], [3, 1, 2])?,
            up: [
                pair("up.0", quarter, half, point)?,
                pair("up.1", half, full, point)?,
            ],
            head: layer("head", [full, n_observations], point)?,
        })
    }

    /// The logits of all cells, `[batch, rows, cols, observations]`.
    pub fn logits(&self, x: &Tensor) -> Result<Tensor> {
        let [full, half] = self.features(x)?;
        let [point, last] = &self.up[1];
        let full = (doubled(&point.forward(&half)?)? + full)?.relu()?;
        self.head.forward(&last.residual(&full)?)
    }

    /// The logits of some cells, `[cells, observations]`: the last layers compute no others. A cell is its image, row and
    /// column.
    pub fn logits_at(&self, x: &Tensor, cells: &[[usize; 3]]) -> Result<Tensor> {
        let [full, half] = self.features(x)?;
        let [point, last] = &self.up[1];
        let around = Around::of(cells, [full.dim(1)?, full.dim(2)?]);
        let index = |rows: Vec<u32>| Tensor::new(rows, x.device());
        let channels = full.dim(3)?;
        let full = full.flatten_to(2)?.index_select(&index(around.full)?, 0)?;
        let half = point.forward(&half)?.flatten_to(2)?;
        let half = half.index_select(&index(around.half)?, 0)?;
        let is_inside = Tensor::new(around.is_inside, x.device())?.to_dtype(x.dtype())?;
        let patches = (full + half)?
            .relu()?
            .broadcast_mul(&is_inside.unsqueeze(1)?)?;
        let patches = patches.reshape(((), AROUND * channels))?;
        let middle = patches.narrow(1, AROUND / 2 * channels, channels)?;
        self.head.dense(&(last.dense(&patches)?.relu()? + middle)?)
    }

    /// What lies before the last doubling: features at full and at half size.
    fn features(&self, x: &Tensor) -> Result<[Tensor; 2]> {
        let full = self.full.forward(x)?;
        let [strided, same] = &self.down[0];
        let half = same.residual(&strided.forward(&full)?)?;
        let [strided, same] = &self.down[1];
        let quarter = same.residual(&strided.forward(&half)?)?;
        let quarter = self.wide.residual(&quarter)?;
        let [point, same] = &self.up[0];
        let half = (doubled(&point.forward(&quarter)?)? + half)?.relu()?;
        Ok([full, same.residual(&half)?])
    }
}

impl Layer {
    fn new(
        vb: &VarBuilder<'_>,
        [channels, n]: [usize; 2],
        conv: ImageConv,
        is_stock: bool,
        is_head: bool,
    ) -> Result<Self> {
        let patch = conv.kernel * conv.kernel * channels;
        let init = if is_head {
            Init::Const(0.0)
        } else {
            uniform_init(patch)
        };
        Ok(Self {
            conv,
            weight: vb.get_with_hints((patch, n), "weight", init)?,
            bias: vb.get_with_hints(n, "bias", init)?,
            is_stock,
        })
    }

    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        if self.is_stock {
            self.stock(x)
        } else {
            x.contiguous()?
                .apply_op3(&self.weight, &self.bias, self.conv)
        }
    }

    /// The same by candle's layers, whose channels come second.
    fn stock(&self, x: &Tensor) -> Result<Tensor> {
        let ImageConv {
            kernel,
            stride,
            dilation,
            relu,
        } = self.conv;
        let kernels = self.weight.reshape((kernel, kernel, x.dim(3)?, ()))?;
        let kernels = kernels.permute((3, 2, 0, 1))?.contiguous()?;
        let z = x.permute((0, 3, 1, 2))?.contiguous()?;
        let z = z.conv2d(&kernels, dilation * (kernel / 2), stride, dilation, 1)?;
        let z = z.permute((0, 2, 3, 1))?.broadcast_add(&self.bias)?;
        if relu { z.relu() } else { Ok(z) }
    }

    fn residual(&self, x: &Tensor) -> Result<Tensor> {
        self.forward(x)? + x
    }

    /// Of patches as rows, before ReLU.
    fn dense(&self, patches: &Tensor) -> Result<Tensor> {
        patches.matmul(&self.weight)?.broadcast_add(&self.bias)
    }
}

/// Each cell four times.
fn doubled(x: &Tensor) -> Result<Tensor> {
    let (batch, rows, cols, channels) = x.dims4()?;
    // candle's own doubling and broadcasts take several times as long.
    let from = |at: usize| at / (4 * cols) * cols + at % (2 * cols) / 2;
    let from = (0..4 * batch * rows * cols).map(|at| from(at) as u32);
    let from = Tensor::from_iter(from, x.device())?;
    let doubled = x.reshape(((), channels))?.index_select(&from, 0)?;
    doubled.reshape((batch, 2 * rows, 2 * cols, channels))
}

/// The patches of some cells: where their cells lie among those of all images, at full and half size, and which lie
/// inside.
struct Around {
    full: Vec<u32>,
    half: Vec<u32>,
    is_inside: Vec<f32>,
}

impl Around {
    fn of(cells: &[[usize; 3]], [rows, cols]: [usize; 2]) -> Self {
        let n = cells.len() * AROUND;
        let mut around = Self {
            full: Vec::with_capacity(n),
            half: Vec::with_capacity(n),
            is_inside: Vec::with_capacity(n),
        };
        for [image, row, col] in cells {
            for tap in 0..AROUND {
                let row = (row + tap / 3).wrapping_sub(1);
                let col = (col + tap % 3).wrapping_sub(1);
                let is_inside = row < rows && col < cols;
                around.is_inside.push(f32::from(is_inside));
                let (row, col) = if is_inside { (row, col) } else { (0, 0) };
                let full = (image * rows + row) * cols + col;
                let half = (image * rows / 2 + row / 2) * cols / 2 + col / 2;
                around.full.push(full as u32);
                around.half.push(half as u32);
            }
        }
        around
    }
}
