//! The dynamic autoencoder with its optimiser, which computes predictors from frames, and learns from windows of
//! frames.

use crate::adam::{Adam, AdamSettings};
use crate::batch_norm::moved_statistics;
use crate::dropout::Dropout;
use crate::error::NetworkError;
use crate::model::Network;
use crate::operators::Operators;
use crate::pass::Pass;
use crate::shape::NetworkShape;
use crate::tensors::{NamedTensor, found, named_numbers, numbers_of, set};
use crate::variables::{Variables, build, normal};
use crate::window::Window;
use candle_core::{DType, Device, Tensor};
use emberwatch_model::grid::Probabilities;
use emberwatch_model::randomness::{Purpose, stream};
use std::sync::Arc;

/// Settings of the autoencoder.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AutoencoderSettings {
    /// Length of the encoder's output.
    pub encoding: usize,
    /// Length of the hidden vector h.
    pub hidden: usize,
    /// Number of frames in a training window. All frames but the first are predicted.
    pub window: usize,
    /// Capacity of the replay buffer, in frames.
    pub replay: usize,
    /// Settings of the optimiser.
    pub adam: AdamSettings,
}

impl AutoencoderSettings {
    /// Returns the settings that the authors used for the results in their table.
    pub fn paper() -> Self {
        Self {
            encoding: 4,
            hidden: 4,
            window: 1000,
            replay: 5000,
            adam: AdamSettings::paper(1e-4),
        }
    }
}

/// The network, its variables and its optimiser. Clones share the variables, so an update of one clone changes all.
#[derive(Clone)]
pub struct Autoencoder {
    settings: AutoencoderSettings,
    shape: NetworkShape,
    seed: u64,
    device: Device,
    network: Arc<Network>,
    adam: Adam,
    n_updates: u64,
}

impl Autoencoder {
    /// Creates a network. The seed determines its initial variables, dropout masks and initial hidden vectors.
    pub fn new(
        settings: AutoencoderSettings,
        shape: NetworkShape,
        seed: u64,
        device: &Device,
    ) -> Result<Self, NetworkError> {
        let operators = Operators::on(device, DType::F32);
        let network = |vb| Network::new(&vb, &shape, operators);
        let (network, variables) = build(seed, DType::F32, device, network)?;
        Ok(Self {
            adam: Adam::new(variables)?,
            settings,
            shape,
            seed,
            device: device.clone(),
            network: Arc::new(network),
            n_updates: 0,
        })
    }

    /// Returns the settings, with the current learning rate.
    pub fn settings(&self) -> &AutoencoderSettings {
        &self.settings
    }

    /// Returns the sizes of the network: the grid, the numbers of states and observations, and the lengths of vectors.
    pub fn shape(&self) -> &NetworkShape {
        &self.shape
    }

    /// Returns the number of updates so far.
    pub fn n_updates(&self) -> u64 {
        self.n_updates
    }

    /// Returns the model.
    pub fn network(&self) -> &Network {
        &self.network
    }

    /// Returns the parameters and running statistics.
    pub fn variables(&self) -> &Variables {
        self.adam.variables()
    }

    /// Sets the learning rate.
    pub fn set_learning_rate(&mut self, learning_rate: f32) {
        self.settings.adam.learning_rate = learning_rate;
    }

    /// Returns the learned observation matrix `O`, row-major `[observation][state]`. Each column sums to one.
    pub fn observation_matrix(&self) -> Result<Vec<f32>, NetworkError> {
        Ok(numbers_of(&self.network.observation_matrix()?)?)
    }

    /// Draws `h_0 ~ N(0, I)` for a run. The vector depends only on the seed.
    pub fn first_hidden(&self) -> Vec<f32> {
        self.draw_hidden(u64::MAX)
    }

    fn draw_hidden(&self, index: u64) -> Vec<f32> {
        let mut rng = stream(self.seed, Purpose::Hidden, index);
        (0..self.shape.hidden).map(|_| normal(&mut rng)).collect()
    }

    /// Computes the next hidden vector from a hidden vector and a window with a single frame.
    ///
    /// # Errors
    /// [`NetworkError`] if a value is not finite, or the device fails.
    ///
    /// # Panics
    /// If the frame does not fit the network.
    pub fn advance(&self, window: &Window, hidden: &[f32]) -> Result<Vec<f32>, NetworkError> {
        assert!(
            window.fits(&self.shape),
            "frame: expected the network's grid and observations"
        );
        let hidden = self.network.forward(&Pass::inference(window), hidden)?;
        let hidden = numbers_of(&hidden)?;
        if hidden.iter().all(|number| number.is_finite()) {
            Ok(hidden)
        } else {
            // Check here, because softmax and ReLU could turn NaN into finite numbers.
            Err(self.adam.not_finite("the hidden vector".into()))
        }
    }

    /// Computes the predictor `u` from a hidden vector, `[S, H, W]`.
    pub fn predict(&self, hidden: &[f32]) -> Result<Probabilities, NetworkError> {
        let (height, width) = self.shape.grid.dim();
        let hidden = Tensor::from_slice(hidden, (1, hidden.len()), &self.device)?;
        let nothing = Window::blank(1);
        let padded = self.network.predict(&Pass::inference(&nothing), &hidden)?;
        let cells = padded.narrow(2, 0, height)?.narrow(3, 0, width)?;
        let dim = (self.shape.n_states, height, width);
        let predictor = Probabilities::from_shape_vec(dim, numbers_of(&cells)?);
        Ok(predictor.expect("invariant: one number per state and cell"))
    }

    /// Performs one step of Adam on a window, with dropout and `h_0` from this update's random streams. Returns the
    /// loss before the step.
    ///
    /// # Errors
    /// [`NetworkError`] if a value is not finite, or the device fails. The network is then unchanged.
    ///
    /// # Panics
    /// If the window has no cells to predict or does not fit the network.
    pub fn update(&mut self, window: &Window) -> Result<f64, NetworkError> {
        let dropout = Dropout::draw(window.len(), self.seed, self.n_updates);
        self.update_with(window, &dropout, &self.draw_hidden(self.n_updates))
    }

    /// Performs a step as [`Self::update`] does, but with the given dropout masks and `h_0`.
    pub fn update_with(
        &mut self,
        window: &Window,
        dropout: &Dropout,
        first: &[f32],
    ) -> Result<f64, NetworkError> {
        assert!(window.has_targets(), "window: expected cells to predict");
        assert!(
            window.fits(&self.shape),
            "window: expected the network's grid and observations"
        );
        let pass = Pass::training(window, dropout);
        let loss = self.network.loss(&pass, first)?;
        let statistics = moved_statistics(self.variables(), &pass.into_moments())?;
        let loss = self
            .adam
            .update_with(&self.settings.adam, &loss, statistics, "")?;
        self.n_updates += 1;
        Ok(f64::from(loss))
    }

    /// Returns the tensors of a checkpoint: the variables by PyTorch's names, and Adam's moments as `adam.first.<name>`
    /// and `adam.second.<name>`. A resumed run also needs the settings, the seed and [`Self::counters`].
    pub fn named_tensors(&self) -> Result<Vec<NamedTensor>, NetworkError> {
        Ok(named_numbers(&self.groups())?)
    }

    fn groups(&self) -> [(&'static str, &Variables); 2] {
        [("", self.variables()), ("adam.", self.adam.moments())]
    }

    /// Returns the number of Adam's steps, and the number of updates.
    pub fn counters(&self) -> [u64; 2] {
        [self.adam.steps(), self.n_updates]
    }

    /// Loads the state that [`Self::named_tensors`] and [`Self::counters`] returned for a network with the same sizes.
    /// `find` returns the values of a tensor with a given name and shape.
    ///
    /// # Errors
    /// If `find` or the device fails. The network is then unchanged.
    pub fn load<E: From<NetworkError>>(
        &mut self,
        find: impl Fn(&str, &[usize]) -> Result<Vec<f32>, E>,
        [steps, n_updates]: [u64; 2],
    ) -> Result<(), E> {
        let changes = found(&self.groups(), find)?;
        set(&changes).map_err(NetworkError::from)?;
        self.adam.set_steps(steps);
        self.n_updates = n_updates;
        Ok(())
    }
}
