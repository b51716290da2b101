//! A convolution of images with bias, ReLU and residual as one operator, for 32-bit floats on the CPU.

use super::conv::{Buffers, Conv, Sizes};
use super::cpu::{add, numbers, slice, total};
use candle_core::{CpuStorage, CustomOp3, Device, Layout, Result, Shape, Tensor, bail};
use emberwatch_model::vectors::vectorised;
use rayon::prelude::*;
use std::sync::OnceLock;

/// Number of partial sums of a batch's gradients, each over consecutive images. It is constant, so that results do not
/// depend on the number of threads.
const N_SUMS: usize = 8;

/// Arguments: images `[batch, channels in, rows, cols]`, weights `[kernel * kernel * channels in, channels out]`, bias
/// `[channels out]`. Result: `[batch, channels out, rows / stride, cols / stride]`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ImageConv {
    /// Side of the kernel, odd.
    pub(crate) kernel: usize,
    pub(crate) stride: usize,
    pub(crate) dilation: usize,
    pub(crate) relu: bool,
}

impl ImageConv {
    pub(crate) fn apply(self, x: &Tensor, weights: &Tensor, bias: &Tensor) -> Result<Tensor> {
        x.apply_op3(weights, bias, Call::new(self, false))
    }

    /// Applies the convolution with ReLU, and adds the image. The result must have the image's shape.
    pub(crate) fn residual(self, x: &Tensor, weights: &Tensor, bias: &Tensor) -> Result<Tensor> {
        x.apply_op3(weights, bias, Call::new(self, true))
    }

    fn conv(&self, x: &Shape, weights: &Shape) -> Result<(usize, Conv)> {
        let (batch, channels, rows, cols) = x.dims4()?;
        let (patch, n) = weights.dims2()?;
        let Self {
            kernel,
            stride,
            dilation,
            ..
        } = *self;
        if patch != kernel * kernel * channels || rows % stride + cols % stride > 0 {
            bail!("weights {weights:?} or stride {stride} do not fit images of shape {x:?}");
        }
        let sizes = Sizes {
            large: [channels, rows, cols],
            small: [n, rows / stride, cols / stride],
            kernel: [kernel; 2],
            stride,
            padding: dilation * (kernel / 2),
            dilation,
        };
        Ok((batch, Conv::new(sizes)))
    }
}

struct Call {
    conv: ImageConv,
    adds_image: bool,
    /// The output of a residual layer does not reveal this, because it includes the image.
    kept: OnceLock<Vec<bool>>,
}

impl Call {
    fn new(conv: ImageConv, adds_image: bool) -> Self {
        Self {
            conv,
            adds_image,
            kept: OnceLock::new(),
        }
    }

    #[inline(always)]
    fn finish(&self, x: &[f32], y: &mut [f32], kept: &mut [bool]) {
        if self.conv.relu {
            for (y, kept) in y.iter_mut().zip(kept) {
                *kept = *y > 0.0;
                *y = y.max(0.0);
            }
        }
        if self.adds_image {
            add(y, x);
        }
    }

    #[inline(always)]
    fn gradient_before_relu(&self, kept: &[bool], dy: &[f32]) -> Vec<f32> {
        let relu = self.conv.relu;
        let pairs = dy.iter().zip(kept);
        pairs
            .map(|(dy, kept)| dy * f32::from(!relu || *kept))
            .collect()
    }
}

impl CustomOp3 for Call {
    fn name(&self) -> &'static str {
        "image_conv"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        weights: &CpuStorage,
        weights_layout: &Layout,
        bias: &CpuStorage,
        bias_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (batch, conv) = self.conv.conv(x_layout.shape(), weights_layout.shape())?;
        let [n, rows, cols] = conv.sizes.small;
        if self.adds_image && conv.sizes.large != conv.sizes.small {
            bail!(
                "residual convolution: expected a result with the image's shape, got {:?}",
                conv.sizes
            );
        }
        let (x, weights) = (slice(x, x_layout)?, slice(weights, weights_layout)?);
        let bias = slice(bias, bias_layout)?;
        let [large, small] = conv.channels();
        let mut y = vec![0.0; batch * n * rows * cols];
        let mut kept = vec![false; y.len()];
        let image = |buffers: &mut Buffers, ((x, y), kept): ((&[f32], &mut [f32]), &mut [bool])| {
            vectorised(
                #[inline(always)]
                || {
                    conv.put_all_large(buffers, x);
                    for (plane, bias) in y.chunks_exact_mut(rows * cols).zip(bias) {
                        plane.fill(*bias);
                    }
                    conv.down(weights, buffers, [&large, &small], y);
                    self.finish(x, y, kept);
                },
            );
        };
        let (n_x, n_y) = (x.len() / batch, y.len() / batch);
        if batch == 1 {
            // For a single image, another thread costs more than it saves.
            image(&mut conv.buffers(), ((x, &mut y), &mut kept));
        } else {
            let results = x.par_chunks(n_x).zip(y.par_chunks_mut(n_y));
            let results = results.zip(kept.par_chunks_mut(n_y));
            results.for_each_init(|| conv.buffers(), image);
        }
        // Set once: candle runs the forward pass of a call only once.
        self.kept.get_or_init(|| kept);
        Ok((CpuStorage::F32(y), (batch, n, rows, cols).into()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        weights: &Tensor,
        bias: &Tensor,
        _: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (batch, conv) = self.conv.conv(x.shape(), weights.shape())?;
        let dy = dy.contiguous()?;
        let (x_numbers, weight_numbers, dy) = (numbers(x)?, numbers(weights)?, numbers(&dy)?);
        let kept = self.kept.get().expect("invariant: the result came first");
        let (n_x, n_y) = (x_numbers.len() / batch, dy.len() / batch);
        let mut dx = vec![0.0; x_numbers.len()];
        let mut channels_last = vec![0.0; dy.len()];
        let images = x_numbers.par_chunks(n_x).zip(kept.par_chunks(n_y));
        let gradients = dy.par_chunks(n_y).zip(dx.par_chunks_mut(n_x));
        let images = images.zip(gradients.zip(channels_last.par_chunks_mut(n_y)));
        let back = Back {
            call: self,
            conv: &conv,
            weights: &weight_numbers,
            // Constants, such as the network's input, need no gradient.
            of_image: x.track_op(),
        };
        let images = images.map_init(
            || conv.buffers(),
            |buffers, ((x, kept), ((dy, dx), channels_last))| {
                vectorised(
                    #[inline(always)]
                    || back.image(buffers, [x, dy], kept, dx, channels_last),
                )
            },
        );
        let d_weights: Vec<Vec<f32>> = images.collect();
        let n = batch.div_ceil(N_SUMS);
        let d_weights = d_weights
            .chunks(n)
            .map(|images| total(images.iter().cloned()));
        let d_bias = channels_last.par_chunks(n_y * n).map(|images| {
            let mut sum = vec![0.0; conv.sizes.small[0]];
            images
                .chunks(sum.len())
                .for_each(|cell| add(&mut sum, cell));
            sum
        });
        let d_bias: Vec<Vec<f32>> = d_bias.collect();
        let tensor = |numbers, like: &Tensor| Tensor::from_vec(numbers, like.shape(), &Device::Cpu);
        let dx = x.track_op().then(|| tensor(dx, x)).transpose()?;
        Ok((
            dx,
            Some(tensor(total(d_weights), weights)?),
            Some(tensor(total(d_bias), bias)?),
        ))
    }
}

struct Back<'a> {
    call: &'a Call,
    conv: &'a Conv,
    weights: &'a [f32],
    of_image: bool,
}

impl Back<'_> {
    /// Writes the gradient `dx` of an image, and the gradient before ReLU, `[cells, channels]`, to `channels_last`.
    /// Returns the gradient of the weights.
    #[inline(always)]
    fn image(
        &self,
        buffers: &mut Buffers,
        [x, dy]: [&[f32]; 2],
        kept: &[bool],
        dx: &mut [f32],
        channels_last: &mut [f32],
    ) -> Vec<f32> {
        let (conv, [large, small]) = (self.conv, self.conv.channels());
        let dz = self.call.gradient_before_relu(kept, dy);
        conv.put_all_large(buffers, x);
        conv.transpose_all_small(buffers, &dz);
        channels_last.copy_from_slice(conv.channels_last(buffers));
        let mut d_weights = vec![0.0; conv.n_weights()];
        conv.add_weight_gradient(buffers, &large, &mut d_weights);
        if self.of_image {
            for (index, plane) in dz.chunks_exact(conv.small_area()).enumerate() {
                conv.put_small(buffers, index, plane);
            }
            conv.up(self.weights, buffers, [&large, &small], dx);
            if self.call.adds_image {
                add(dx, dy);
            }
        }
        d_weights
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::DType;

    #[test]
    fn images_that_do_not_fit_are_rejected() {
        let conv = ImageConv {
            kernel: 3,
            stride: 2,
            dilation: 1,
            relu: true,
        };
        let is_refused = |x: [usize; 4]| {
            let zeros = |shape: &[usize]| Tensor::zeros(shape, DType::F32, &Device::Cpu);
            let [x, weights, bias] = [&x[..], &[18, 4], &[4]].map(|it| zeros(it).expect("zeros"));
            conv.apply(&x, &weights, &bias).is_err()
        };
        assert!(!is_refused([1, 2, 4, 4]));
        assert!(is_refused([1, 2, 5, 4]), "an odd side");
        assert!(is_refused([1, 3, 4, 4]), "other channels");
    }
}
