//! The neural belief: a network on the grid that predicts the distribution of each cell's next observation from past
//! observations. It learns only from masked frames.
//!
//! The idea and the loss come from the dynamic autoencoder (paper section III.B, eqs. 8 and 11). Instead of one hidden
//! vector for the whole grid, each cell stores its last observations and their ages.

use crate::adam::{Adam, AdamSettings};
use crate::crop::{Crop, extent};
use crate::error::NetworkError;
use crate::operators::Operators;
use crate::sightings::{Features, Sightings};
use crate::tensors::{NamedTensor, found, named_numbers, set};
use crate::unet::UNet;
use crate::variables::{Variables, build};
use candle_core::{D, DType, Device, Result as CandleResult, Shape, Tensor};
use candle_nn::ops::{log_softmax, softmax};
use emberwatch_model::grid::Probabilities;
use rayon::prelude::*;
use std::sync::Arc;

/// PyTorch's default decay rates. Each update sets the learning rate.
const ADAM: AdamSettings = AdamSettings {
    learning_rate: 0.0,
    betas: [0.9, 0.999],
    epsilon: 1e-8,
    max_norm: Some(1.0),
};

/// Minimum probability of an observation, so that no observation is impossible.
const LEAST: f64 = 1e-6;

/// Maximum number of cells in a batch: 16 grids of 64 x 64, or 40 crops of 40 x 40.
const BATCH_CELLS: usize = 65_536;

/// Maximum number of cells in one pass of predictions with candle's operators: 64 grids of 64 x 64.
const PASS_CELLS: usize = 262_144;

/// A world's sightings, and the prediction `[O, H, W]` of the filter that the network corrects, if any.
pub type AgentObservation<'a> = (&'a Sightings, Option<&'a Probabilities>);

/// The network, its variables and its optimiser. Clones share the variables, so an update of one clone changes all.
#[derive(Clone)]
pub struct NeuralBelief {
    n_observations: usize,
    features: Arc<Features>,
    device: Device,
    operators: Operators,
    unet: Arc<UNet>,
    adam: Adam,
}

/// A training example: a frame to predict, and the sightings before it.
#[derive(Debug, Clone, PartialEq)]
pub struct Lesson {
    /// The sightings before the frame.
    pub before: Sightings,
    /// The row-major index and the value of each observed cell, for at least one cell.
    pub frame: Vec<(usize, u8)>,
    /// The corrected filter's prediction for the observed cells, `[cells, O]`; empty without a filter.
    pub base: Vec<f32>,
}

impl NeuralBelief {
    /// Creates a network with initial parameters from a seed, for worlds with `n_observations` observations.
    pub fn new(n_observations: usize, seed: u64, device: &Device) -> Result<Self, NetworkError> {
        let operators = Operators::on(device, DType::F32);
        Self::with_operators(n_observations, seed, device, operators)
    }

    /// Creates a network as [`Self::new`] does, but with the given operators. Candle's operators work on every device.
    pub fn with_operators(
        n_observations: usize,
        seed: u64,
        device: &Device,
        operators: Operators,
    ) -> Result<Self, NetworkError> {
        let n_features = Features::n_channels(n_observations);
        let unet = |vb| UNet::new(&vb, n_features, n_observations, operators);
        let (unet, variables) = build(seed, DType::F32, device, unet)?;
        Ok(Self {
            n_observations,
            features: Arc::new(Features::new(n_observations)),
            device: device.clone(),
            operators,
            unet: Arc::new(unet),
            adam: Adam::new(variables)?,
        })
    }

    /// Returns an identifier that is the same only for clones of one network.
    pub fn id(&self) -> usize {
        Arc::as_ptr(&self.unet).addr()
    }

    /// Returns the number of values that a cell can show.
    pub fn n_observations(&self) -> usize {
        self.n_observations
    }

    /// Returns the number of updates so far.
    pub fn n_updates(&self) -> u64 {
        self.adam.steps()
    }

    /// Returns the parameters.
    pub fn variables(&self) -> &Variables {
        self.adam.variables()
    }

    /// Returns the parameters as plain numbers.
    pub fn parameters(&self) -> Result<Vec<NamedTensor>, NetworkError> {
        Ok(named_numbers(&[("", self.variables())])?)
    }

    /// Loads parameters that [`Self::parameters`] returned. `find` returns the values of a tensor with a given name and
    /// shape.
    ///
    /// # Errors
    /// If `find` or the device fails. The network is then unchanged.
    pub fn set_parameters<E: From<NetworkError>>(
        &mut self,
        find: impl Fn(&str, &[usize]) -> Result<Vec<f32>, E>,
    ) -> Result<(), E> {
        let changes = found(&[("", self.variables())], find)?;
        Ok(set(&changes).map_err(NetworkError::from)?)
    }

    /// Predicts the distribution of each cell's observation in the current step, `[O, H, W]`. `base` is the prediction
    /// of the filter that the network corrects, if it corrects one.
    ///
    /// # Errors
    /// If a value is not finite, or the device fails.
    pub fn predict(
        &self,
        sightings: &Sightings,
        base: Option<&Probabilities>,
    ) -> Result<Probabilities, NetworkError> {
        let mut all = self.predict_in_one_pass(&[(sightings, base)])?;
        Ok(all.swap_remove(0))
    }

    /// Predicts several worlds with the same grid, each as [`Self::predict`] does. Either all worlds have a base or
    /// none does. Our operators predict one world per thread, and candle's operators many worlds in one pass.
    ///
    /// # Errors
    /// The same as for [`Self::predict`].
    pub fn predict_all(
        &self,
        worlds: &[AgentObservation<'_>],
    ) -> Result<Vec<Probabilities>, NetworkError> {
        let Some((first, _)) = worlds.first() else {
            return Ok(Vec::new());
        };
        let passes = match self.operators {
            // For a single world, another thread costs more than it saves.
            Operators::Own if worlds.len() == 1 => {
                vec![self.predict_in_one_pass(worlds)].into_iter().collect()
            }
            Operators::Own => {
                let worlds = worlds.par_iter().with_max_len(1);
                worlds
                    .map(|world| self.predict_in_one_pass(&[*world]))
                    .collect()
            }
            Operators::Stock => {
                let max_worlds = (PASS_CELLS / first.shape().n_cells()).max(1);
                let passes = worlds.chunks(max_worlds);
                passes
                    .map(|worlds| self.predict_in_one_pass(worlds))
                    .collect()
            }
        };
        let passes: Result<Vec<_>, NetworkError> = passes;
        Ok(passes?.into_iter().flatten().collect())
    }

    fn predict_in_one_pass(
        &self,
        worlds: &[AgentObservation<'_>],
    ) -> Result<Vec<Probabilities>, NetworkError> {
        let (n, shape) = (worlds.len(), worlds[0].0.shape());
        let (crop, (height, width)) = (Crop::whole(shape), shape.dim());
        let images = worlds.iter().map(|(sightings, _)| (*sightings, &crop));
        let logits = self.unet.logits(&self.images(images, crop.sides)?)?;
        let logits = logits.narrow(2, 0, height)?.narrow(3, 0, width)?;
        let bases: Vec<_> = worlds.iter().filter_map(|(_, base)| *base).collect();
        let (o, logits) = (self.n_observations, logits.contiguous()?);
        let logits = if bases.is_empty() {
            logits
        } else {
            let bases = bases.into_iter().flatten();
            (logits + self.logarithms(bases, (n, o, height, width))?)?
        };
        let probabilities = softmax(&logits, 1)?.affine(1.0 - o as f64 * LEAST, LEAST)?;
        let numbers: Vec<f32> = probabilities.flatten_all()?.to_vec1()?;
        if !numbers.iter().all(|number| number.is_finite()) {
            return Err(self.adam.not_finite("the prediction".into()));
        }
        let worlds = numbers.chunks_exact(o * height * width);
        let world = |numbers: &[f32]| {
            let numbers = Probabilities::from_shape_vec((o, height, width), numbers.to_vec());
            numbers.expect("invariant: one number per observation and cell")
        };
        Ok(worlds.map(world).collect())
    }

    /// Computes the mean cross-entropy over the observed cells of lessons, which must have the same grid (paper eqs. 8
    /// and 11). The network reads crops around the observed cells. Lessons beyond the size of a batch are ignored.
    ///
    /// # Panics
    /// If there is no lesson, if a lesson has no cells, or if only some lessons have a base.
    pub fn loss(&self, lessons: &[Lesson]) -> Result<Tensor, NetworkError> {
        let shape = lessons[0].before.shape();
        let extents: Vec<_> = lessons.iter().map(|it| extent(shape, it.cells())).collect();
        let sides = Crop::sides(shape, &extents);
        let n = (BATCH_CELLS / (sides[0] * sides[1])).clamp(1, lessons.len());
        let (mut cells, mut values) = (Vec::new(), Vec::new());
        let crops: Vec<Crop> = extents[..n]
            .iter()
            .map(|it| Crop::around(shape, sides, it))
            .collect();
        let images = self.images(lessons.iter().map(|it| &it.before).zip(&crops), sides)?;
        for (image, (lesson, crop)) in lessons.iter().zip(&crops).enumerate() {
            for &(cell, value) in &lesson.frame {
                let cell = shape.cell(cell);
                let [top, left] = crop.first;
                cells.push([image, cell.row - top, cell.col - left]);
                values.push(u32::from(value));
            }
        }
        let base: Vec<f32> = lessons[..n]
            .iter()
            .flat_map(|it| &it.base)
            .copied()
            .collect();
        assert!(
            base.is_empty() || base.len() == cells.len() * self.n_observations,
            "lessons: expected a base for all cells or for no cell"
        );
        Ok(match self.operators {
            Operators::Own => self.loss_at(&images, &cells, values, &base)?,
            Operators::Stock => self.loss_of_all(&images, &cells, &values, &base)?,
        })
    }

    fn loss_at(
        &self,
        images: &Tensor,
        cells: &[[usize; 3]],
        values: Vec<u32>,
        base: &[f32],
    ) -> CandleResult<Tensor> {
        let logits = self.unet.logits_at(images, cells)?;
        let logits = if base.is_empty() {
            logits
        } else {
            (logits + self.logarithms(base.iter(), (cells.len(), self.n_observations))?)?
        };
        let values = Tensor::new(values, &self.device)?.unsqueeze(1)?;
        let log_p = log_softmax(&logits, D::Minus1)?.gather(&values, 1)?;
        log_p.mean_all()?.neg()
    }

    /// The same loss as `loss_at`, but as a weighted sum over all cells, without gather or scatter.
    fn loss_of_all(
        &self,
        images: &Tensor,
        cells: &[[usize; 3]],
        values: &[u32],
        base: &[f32],
    ) -> CandleResult<Tensor> {
        let logits = self.unet.logits(images)?;
        let (_, n, rows, cols) = logits.dims4()?;
        let at = |[image, row, col]: &[usize; 3], value: usize| {
            ((image * n + value) * rows + row) * cols + col
        };
        let mut weights = vec![0.0_f32; logits.elem_count()];
        for (cell, value) in cells.iter().zip(values) {
            weights[at(cell, *value as usize)] -= 1.0 / cells.len() as f32;
        }
        let weights = Tensor::from_vec(weights, logits.shape(), &self.device)?;
        let logits = if base.is_empty() {
            logits
        } else {
            let mut of_all = vec![1.0_f32; logits.elem_count()];
            for (cell, base) in cells.iter().zip(base.chunks(n)) {
                for (value, base) in base.iter().enumerate() {
                    of_all[at(cell, value)] = *base;
                }
            }
            (&logits + self.logarithms(of_all.iter(), logits.shape())?)?
        };
        (log_softmax(&logits, 1)? * weights)?.sum_all()
    }

    /// Performs one step of Adam on lessons, and returns the loss before the step.
    ///
    /// # Errors
    /// If a value is not finite, or the device fails. The network is then unchanged.
    pub fn update(&mut self, learning_rate: f32, lessons: &[Lesson]) -> Result<f64, NetworkError> {
        let loss = self.loss(lessons)?;
        let settings = AdamSettings {
            learning_rate,
            ..ADAM
        };
        Ok(f64::from(self.adam.update(&settings, &loss)?))
    }

    /// Returns the tensors of a checkpoint: the parameters, and Adam's moments as `adam.first.<name>` and
    /// `adam.second.<name>`. A resumed run also needs [`Self::n_updates`].
    pub fn named_tensors(&self) -> Result<Vec<NamedTensor>, NetworkError> {
        Ok(named_numbers(&self.groups())?)
    }

    fn groups(&self) -> [(&'static str, &Variables); 2] {
        [("", self.variables()), ("adam.", self.adam.moments())]
    }

    /// Loads tensors that [`Self::named_tensors`] returned after `n_updates` updates. `find` returns the values of a
    /// tensor with a given name and shape.
    ///
    /// # Errors
    /// If `find` or the device fails. The network is then unchanged.
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
    ) -> CandleResult<Tensor> {
        let logarithms = probabilities.map(|p| p.max(LEAST as f32).ln());
        Tensor::from_vec(logarithms.collect(), shape.into(), &self.device)
    }

    /// Computes the network's input for crops with the given sides, `[crops, features, rows, cols]`.
    fn images<'a>(
        &self,
        crops: impl Iterator<Item = (&'a Sightings, &'a Crop)>,
        [rows, cols]: [usize; 2],
    ) -> CandleResult<Tensor> {
        let (crops, n) = (
            crops.collect::<Vec<_>>(),
            Features::n_channels(self.n_observations),
        );
        let image = rows * cols * n;
        let mut features = vec![0.0; crops.len() * image];
        let images = features.par_chunks_mut(image).zip(&crops);
        images.for_each(|(image, (sightings, crop))| self.features.write(sightings, crop, image));
        Tensor::from_vec(features, (crops.len(), n, rows, cols), &self.device)
    }
}

impl Lesson {
    fn cells(&self) -> impl Iterator<Item = usize> {
        self.frame.iter().map(|(cell, _)| *cell)
    }
}
