//! A small U-Net, which maps the features of cells to the logits of their next observations.
//!
//! Images are `[batch, channels, rows, cols]`, with sides that are multiples of [`ALIGNMENT`]. Each of two convolutions
//! with stride 2 halves the image's sides. Nearest-neighbour upsampling with skip connections doubles them again. There
//! are residual layers and no normalisation. The weights of the last layer start at zero, so all observations are
//! equally probable at first.

use crate::operators::Operators;
use crate::ops::doubled_sum::DoubledSum;
use crate::ops::image_conv::ImageConv;
use crate::variables::uniform_init;
use candle_core::{Result, Tensor};
use candle_nn::{Init, VarBuilder};

/// The sides of images are multiples of this number, because two convolutions have a stride of 2.
pub const ALIGNMENT: usize = 4;

/// Number of channels at full, half and quarter size.
const CHANNELS: [usize; 3] = [16, 24, 32];

/// Number of cells in a 3 x 3 patch. The cells are in the order of a kernel's weights.
const AROUND: usize = 9;

/// The network, from features of cells to logits of observations.
#[derive(Debug)]
pub struct UNet {
    full: Layer,
    down: [[Layer; 2]; 2],
    wide: Layer,
    up: [[Layer; 2]; 2],
    head: Layer,
}

#[derive(Debug)]
struct Layer {
    conv: ImageConv,
    /// `[kernel * kernel * channels in, channels out]`.
    weight: Tensor,
    bias: Tensor,
    operators: Operators,
}

impl UNet {
    /// Creates a network, whose layers request their variables from `vb`.
    pub fn new(
        vb: &VarBuilder<'_>,
        n_features: usize,
        n_observations: usize,
        operators: Operators,
    ) -> Result<Self> {
        let [full, half, quarter] = CHANNELS;
        let layer = |name: &str, channels: [usize; 2], [kernel, stride, dilation]: [usize; 3]| {
            let conv = ImageConv {
                kernel,
                stride,
                dilation,
                relu: kernel > 1,
            };
            Layer::new(&vb.pp(name), channels, conv, operators, name == "head")
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

    /// Computes the logits of all cells, `[batch, observations, rows, cols]`.
    pub fn logits(&self, x: &Tensor) -> Result<Tensor> {
        let [full, half] = self.features(x)?;
        let [point, last] = &self.up[1];
        let full = self.doubled_sum(&point.forward(&half)?, &full)?;
        self.head.forward(&last.residual(&full)?)
    }

    /// Computes logits `[cells, observations]` of cells (image, row and column). The last layers skip other cells.
    pub fn logits_at(&self, x: &Tensor, cells: &[[usize; 3]]) -> Result<Tensor> {
        let [full, half] = self.features(x)?;
        let [point, last] = &self.up[1];
        let (_, channels, rows, cols) = full.dims4()?;
        let around = Around::of(cells, [rows, cols]);
        let gather = |image: &Tensor, cells: Vec<u32>| {
            let image = image.permute((0, 2, 3, 1))?.contiguous()?.flatten_to(2)?;
            image.index_select(&Tensor::new(cells, x.device())?, 0)
        };
        let full = gather(&full, around.full)?;
        let half = gather(&point.forward(&half)?, around.half)?;
        let is_inside = Tensor::new(around.is_inside, x.device())?.to_dtype(x.dtype())?;
        let patches = (full + half)?
            .relu()?
            .broadcast_mul(&is_inside.unsqueeze(1)?)?;
        let patches = patches.reshape(((), AROUND * channels))?;
        let middle = patches.narrow(1, AROUND / 2 * channels, channels)?;
        self.head.dense(&(last.dense(&patches)?.relu()? + middle)?)
    }

    fn features(&self, x: &Tensor) -> Result<[Tensor; 2]> {
        let full = self.full.forward(x)?;
        let [strided, same] = &self.down[0];
        let half = same.residual(&strided.forward(&full)?)?;
        let [strided, same] = &self.down[1];
        let quarter = same.residual(&strided.forward(&half)?)?;
        let quarter = self.wide.residual(&quarter)?;
        let [point, same] = &self.up[0];
        let half = self.doubled_sum(&point.forward(&quarter)?, &half)?;
        Ok([full, same.residual(&half)?])
    }

    fn doubled_sum(&self, small: &Tensor, large: &Tensor) -> Result<Tensor> {
        if self.head.operators == Operators::Own {
            return small.apply_op2(large, DoubledSum);
        }
        let (batch, channels, rows, cols) = small.dims4()?;
        // Use broadcasts: candle limits the gradient of `upsample_nearest2d` to whole batches with one stride, and its
        // gradient of `index_select` uses only one GPU thread per channel.
        let x = small.reshape((batch * channels, rows, 1, cols))?;
        let x = x.broadcast_as((batch * channels, rows, 2, cols))?;
        let x = x.reshape((batch * channels * 2 * rows, cols, 1))?;
        let x = x.broadcast_as((batch * channels * 2 * rows, cols, 2))?;
        (x.reshape(large.shape())? + large)?.relu()
    }
}

impl Layer {
    fn new(
        vb: &VarBuilder<'_>,
        [channels, n]: [usize; 2],
        conv: ImageConv,
        operators: Operators,
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
            operators,
        })
    }

    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        match self.operators {
            Operators::Own => self.conv.apply(&x.contiguous()?, &self.weight, &self.bias),
            Operators::Stock => self.stock(x),
        }
    }

    fn stock(&self, x: &Tensor) -> Result<Tensor> {
        let ImageConv {
            kernel,
            stride,
            dilation,
            relu,
        } = self.conv;
        let kernels = self.weight.reshape((kernel, kernel, x.dim(1)?, ()))?;
        let kernels = kernels.permute((3, 2, 0, 1))?.contiguous()?;
        let z = x.conv2d(&kernels, dilation * (kernel / 2), stride, dilation, 1)?;
        let z = z.broadcast_add(&self.bias.reshape((1, (), 1, 1))?)?;
        if relu { z.relu() } else { Ok(z) }
    }

    fn residual(&self, x: &Tensor) -> Result<Tensor> {
        match self.operators {
            Operators::Own => (self.conv).residual(&x.contiguous()?, &self.weight, &self.bias),
            Operators::Stock => self.stock(x)? + x,
        }
    }

    /// Applies the convolution, without ReLU, to patches `[patches, kernel * kernel * channels in]`.
    fn dense(&self, patches: &Tensor) -> Result<Tensor> {
        patches.matmul(&self.weight)?.broadcast_add(&self.bias)
    }
}

/// The cells of 3 x 3 patches, as indices into the cells of all images at full size and at half size. `is_inside` is 1
/// for cells inside the image and 0 for others.
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
                let half = (image * (rows / 2) + row / 2) * (cols / 2) + col / 2;
                around.full.push(full as u32);
                around.half.push(half as u32);
            }
        }
        around
    }
}
