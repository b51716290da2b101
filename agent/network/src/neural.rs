//! The neural belief: a network that keeps space, from what was seen to the distribution of what will be seen, learned
//! from masked frames alone.
//!
//! The idea and the loss are the dynamic autoencoder's (paper section III.B, eqs. 8 and 11); in the place of one hidden
//! vector for the whole grid, each cell remembers what it showed and when.

use crate::adam::{Adam, AdamSettings};
use crate::crop::{Crop, extent};
use crate::error::NetworkError;
use crate::sightings::{Features, Sightings};
use crate::tensors::{NamedTensor, found, named_numbers, set};
use crate::unet::UNet;
use crate::variables::{Variables, build};
use candle_core::{D, DType, Device, Shape, Tensor};
use candle_nn::ops::{log_softmax, softmax};
use emberwatch_model::grid::Probabilities;
use std::fmt;
use std::sync::Arc;

/// Adam's decays (PyTorch's defaults), and the norm at which gradients are clipped.
const ADAM: AdamSettings = AdamSettings {
    learning_rate: 0.0,
    betas: [0.9, 0.999],
    epsilon: 1e-8,
    max_norm: Some(1.0),
};

/// Least probability of an observation, so that none is ruled out.
const LEAST: f64 = 1e-6;

/// Cells of a batch: 16 grids of 64 x 64, or 40 crops of 40 x 40.
const BATCH_CELLS: usize = 65_536;

/// The network, its variables and its optimiser. Clones share the variables: each sees the updates that another makes.
#[derive(Clone)]
pub struct NeuralBelief {
    n_observations: usize,
    features: Arc<Features>,
    device: Device,
    unet: Arc<UNet>,
    adam: Adam,
}

/// A frame to predict, and what was seen before it.
#[derive(Debug, Clone, PartialEq)]
pub struct Lesson {
    /// What was seen before.
    pub before: Sightings,
    /// The cells that the frame shows, by row-major index, and their values; at least one.
    pub frame: Vec<(usize, u8)>,
    /// What the filter that the network corrects predicted of each of these cells, `[cells, O]`; empty without one.
    pub base: Vec<f32>,
}

impl NeuralBelief {
    /// A new network of a seed, for worlds with so many observations.
    pub fn new(n_observations: usize, seed: u64, device: &Device) -> Result<Self, NetworkError> {
        let n_features = Features::n_channels(n_observations);
        let unet = |vb| UNet::new(&vb, n_features, n_observations, false);
        let (unet, variables) = build(seed, DType::F32, device, unet)?;
        Ok(Self {
            n_observations,
            features: Arc::new(Features::new(n_observations)),
            device: device.clone(),
            unet: Arc::new(unet),
            adam: Adam::new(variables)?,
        })
    }

    /// Number of values that a cell may show.
    pub fn n_observations(&self) -> usize {
        self.n_observations
    }

    /// Updates so far.
    pub fn n_updates(&self) -> u64 {
        self.adam.steps()
    }

    /// Its parameters.
    pub fn variables(&self) -> &Variables {
        self.adam.variables()
    }

    /// Its parameters as plain numbers.
    pub fn parameters(&self) -> Result<Vec<NamedTensor>, NetworkError> {
        Ok(named_numbers(&[("", self.variables())])?)
    }

    /// Takes over what [`Self::parameters`] gave. `find` gives the numbers of a name and shape.
    ///
    /// # Errors
    /// As of `find`, or where the device fails; nothing has changed then.
    pub fn set_parameters<E: From<NetworkError>>(
        &mut self,
        find: impl Fn(&str, &[usize]) -> Result<Vec<f32>, E>,
    ) -> Result<(), E> {
        let changes = found(&[("", self.variables())], find)?;
        Ok(set(&changes).map_err(NetworkError::from)?)
    }

    /// The distribution of what each cell will show in the present step, `[O, H, W]`. `base`: that of the filter that it
    /// corrects.
    ///
    /// # Errors
    /// For a number that is not finite, or where the device fails.
    pub fn predict(
        &self,
        sightings: &Sightings,
        base: Option<&Probabilities>,
    ) -> Result<Probabilities, NetworkError> {
        let crop = Crop::whole(sightings.shape());
        let mut features = Vec::new();
        self.features.add(sightings, &crop, &mut features);
        let logits = self.unet.logits(&self.tensor(features, 1, crop.sides)?)?;
        let (height, width) = sightings.shape().dim();
        let logits = logits
            .squeeze(0)?
            .narrow(0, 0, height)?
            .narrow(1, 0, width)?;
        let logits = match base {
            Some(base) => {
                let base = base.view().permuted_axes([1, 2, 0]);
                (logits + self.logarithms(base.iter(), (height, width, self.n_observations))?)?
            }
            None => logits,
        };
        let probabilities = softmax(&logits.contiguous()?, D::Minus1)?;
        let n = self.n_observations;
        let probabilities = probabilities.affine(1.0 - n as f64 * LEAST, LEAST)?;
        let numbers: Vec<f32> = probabilities.permute((2, 0, 1))?.flatten_all()?.to_vec1()?;
        if !numbers.iter().all(|number| number.is_finite()) {
            return Err(self.adam.not_finite("the prediction".into()));
        }
        let numbers = Probabilities::from_shape_vec((n, height, width), numbers);
        Ok(numbers.expect("invariant: one number per observation and cell"))
    }

    /// The mean cross-entropy of what the cells of lessons of one grid show (paper eqs. 8 and 11). The network reads crops
    /// around these cells, and no more lessons than fit into a batch.
    ///
    /// # Panics
    /// If there is no lesson, or one without cells, or if some have a base and others have none.
    pub fn loss(&self, lessons: &[Lesson]) -> Result<Tensor, NetworkError> {
        let shape = lessons[0].before.shape();
        let extents = lessons.iter().map(|it| extent(shape, it.cells()));
        let extents: Vec<_> = extents.collect();
        let sides = Crop::sides(shape, &extents);
        let n = (BATCH_CELLS / (sides[0] * sides[1])).clamp(1, lessons.len());
        let (mut features, mut cells, mut values) = (Vec::new(), Vec::new(), Vec::new());
        for (image, lesson) in lessons[..n].iter().enumerate() {
            let crop = Crop::around(shape, sides, &extents[image]);
            self.features.add(&lesson.before, &crop, &mut features);
            for &(cell, value) in &lesson.frame {
                let cell = shape.cell(cell);
                let [top, left] = crop.first;
                cells.push([image, cell.row - top, cell.col - left]);
                values.push(u32::from(value));
            }
        }
        let logits = self
            .unet
            .logits_at(&self.tensor(features, n, sides)?, &cells)?;
        let base = lessons[..n].iter().flat_map(|lesson| &lesson.base);
        let logits = if lessons[0].base.is_empty() {
            logits
        } else {
            (logits + self.logarithms(base, (cells.len(), self.n_observations))?)?
        };
        let values = Tensor::new(values, &self.device)?.unsqueeze(1)?;
        let log_p = log_softmax(&logits, D::Minus1)?.gather(&values, 1)?;
        Ok(log_p.mean_all()?.neg()?)
    }

    /// One step of Adam on lessons; the loss before it. Nothing has changed after an error.
    pub fn update(&mut self, learning_rate: f32, lessons: &[Lesson]) -> Result<f64, NetworkError> {
        let loss = self.loss(lessons)?;
        let settings = AdamSettings {
            learning_rate,
            ..ADAM
        };
        Ok(f64::from(self.adam.update(&settings, &loss)?))
    }

    /// Everything that a resumed run needs but [`Self::n_updates`]: parameters, and Adam's moments as
    /// `adam.first.<name>` and `adam.second.<name>`.
    pub fn named_tensors(&self) -> Result<Vec<NamedTensor>, NetworkError> {
        Ok(named_numbers(&self.groups())?)
    }

    fn groups(&self) -> [(&'static str, &Variables); 2] {
        [("", self.variables()), ("adam.", self.adam.moments())]
    }

    /// Takes over what [`Self::named_tensors`] gave after so many updates. `find` gives the numbers of a name and shape.
    ///
    /// # Errors
    /// As of `find`, or where the device fails; nothing has changed then.
    pub fn load<E: From<NetworkError>>(
        &mut self,
        find: impl Fn(&str, &[usize]) -> Result<Vec<f32>, E>,
        n_updates: u64,
    ) -> Result<(), E> {
        let changes = found(&self.groups(), find)?;
        set(&changes).map_err(NetworkError::from)?;
        self.adam.set_steps(n_updates);
        Ok(())
    }

    fn logarithms<'a>(
        &self,
        probabilities: impl Iterator<Item = &'a f32>,
        shape: impl Into<Shape>,
    ) -> candle_core::Result<Tensor> {
        let logarithms = probabilities.map(|p| p.max(LEAST as f32).ln());
        Tensor::from_vec(logarithms.collect(), shape.into(), &self.device)
    }

    fn tensor(
        &self,
        features: Vec<f32>,
        n: usize,
        [rows, cols]: [usize; 2],
    ) -> candle_core::Result<Tensor> {
        let channels = Features::n_channels(self.n_observations);
        Tensor::from_vec(features, (n, rows, cols, channels), &self.device)
    }
}

impl Lesson {
    fn cells(&self) -> impl Iterator<Item = usize> {
        self.frame.iter().map(|(cell, _)| *cell)
    }
}

impl fmt::Debug for NeuralBelief {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut debug = f.debug_struct("NeuralBelief");
        debug.field("n_observations", &self.n_observations);
        debug.field("n_updates", &self.n_updates());
        debug.finish_non_exhaustive()
    }
}
