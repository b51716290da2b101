//! The dynamic autoencoder as the agent uses it: frames in, estimates and predictions out; windows of
//! frames in, learnt parameters out.

use super::adam::{Adam, AdamSettings};
use super::dropout::Dropout;
use super::gradient::{Trajectory, Workspace};
use super::inference::{Advance, Decode, Inference};
use super::lanes::dispatch;
use super::loss::{LossSettings, softmax_of_columns};
use super::parameters::{OBSERVATION, Tensors, normal};
use super::shape::NetworkShape;
use super::window::Window;
use crate::belief::Belief;
use crate::estimator::ZeroEvidence;
use protocol::frame::Frame;
use protocol::grid::{Probabilities, Shape};
use protocol::randomness::{Purpose, stream};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Sizes and step size.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AutoencoderSettings {
    /// Length of the encoder's output.
    pub encoding: usize,
    /// Length of the hidden vector h.
    pub hidden: usize,
    /// Frames in a window that is learnt from; all but the first are predicted.
    pub window: usize,
    /// Frames remembered.
    pub replay: usize,
    /// The loss.
    pub loss: LossSettings,
    /// The optimiser.
    pub adam: AdamSettings,
}

impl AutoencoderSettings {
    /// What the authors ran for their table.
    pub fn paper() -> Self {
        Self {
            encoding: 4,
            hidden: 4,
            window: 1000,
            replay: 5000,
            loss: LossSettings::paper(),
            adam: AdamSettings::paper(1e-4),
        }
    }

    /// The authors' larger network, with the larger of their step sizes.
    pub fn paper_large() -> Self {
        Self {
            encoding: 16,
            hidden: 16,
            adam: AdamSettings::paper(1e-3),
            ..Self::paper()
        }
    }
}

/// A number that is not finite: training must stop.
#[derive(Debug, Error, PartialEq)]
#[error("update {update}: expected finite numbers, got one that is not in {tensor}")]
pub struct NotFinite {
    /// Updates before this one.
    pub update: u64,
    /// The tensor, a gradient's with the prefix `gradient of`; or the loss.
    pub tensor: String,
}

/// Why a frame was not taken in; nothing has changed then.
#[derive(Debug, Error, PartialEq)]
pub enum StepError {
    /// The predictor rules out what was seen.
    #[error(transparent)]
    ZeroEvidence(#[from] ZeroEvidence),
    /// The hidden vector has a number that is not finite.
    #[error(transparent)]
    NotFinite(#[from] NotFinite),
}

/// The network, its optimiser, and the state of the world that it follows.
#[derive(Debug)]
pub struct Autoencoder {
    settings: AutoencoderSettings,
    shape: NetworkShape,
    seed: u64,
    pub(crate) parameters: Tensors,
    pub(crate) statistics: Tensors,
    pub(crate) adam: Adam,
    pub(crate) n_updates: u64,
    pub(crate) hidden: Vec<f32>,
    /// The hidden vector before the last frame.
    before: Vec<f32>,
    /// The predictor `u_k` of the next frame.
    prediction: Belief,
    /// Of the present parameters, if any frame was read since they changed.
    inference: Option<Inference>,
    workspace: Option<Workspace>,
}

impl Autoencoder {
    /// A new network of a seed, which is also that of its masks and hidden vectors.
    pub fn new(
        settings: AutoencoderSettings,
        grid: Shape,
        n_states: usize,
        n_observations: usize,
        seed: u64,
    ) -> Self {
        let shape = NetworkShape {
            grid,
            n_states,
            n_observations,
            encoding: settings.encoding,
            hidden: settings.hidden,
        };
        let mut parameters = Tensors::parameters(&shape);
        parameters.initialise(seed);
        let mut autoencoder = Self {
            settings,
            shape,
            seed,
            statistics: Tensors::statistics(&shape),
            adam: Adam::new(parameters.numbers.len()),
            parameters,
            n_updates: 0,
            hidden: Vec::new(),
            before: Vec::new(),
            prediction: Belief::uniform(n_states, grid),
            inference: None,
            workspace: None,
        };
        autoencoder.forget();
        autoencoder
    }

    /// Sizes and step size.
    pub fn settings(&self) -> &AutoencoderSettings {
        &self.settings
    }

    /// Grid, states and observations.
    pub fn shape(&self) -> &NetworkShape {
        &self.shape
    }

    /// Updates so far.
    pub fn n_updates(&self) -> u64 {
        self.n_updates
    }

    /// The hidden vector `h_k`.
    pub fn hidden(&self) -> &[f32] {
        &self.hidden
    }

    /// The hidden vector before the last frame was read.
    pub fn hidden_before(&self) -> &[f32] {
        &self.before
    }

    /// Puts another in place of [`Self::hidden_before`].
    pub fn set_hidden_before(&mut self, before: Vec<f32>) {
        self.before = before;
    }

    /// The predictor `u_k` of the next frame.
    pub fn prediction(&self) -> &Belief {
        &self.prediction
    }

    /// The learnt observation matrix `O`, row-major `[observation][state]`; columns sum to one.
    pub fn observation_matrix(&self) -> Vec<f32> {
        softmax_of_columns(self.parameters.get(OBSERVATION), self.shape.n_states)
    }

    /// What Adam moves.
    pub fn parameters(&self) -> &Tensors {
        &self.parameters
    }

    /// Other parameters, as for a step size of their own.
    pub fn parameters_mut(&mut self) -> &mut Tensors {
        self.inference = None;
        &mut self.parameters
    }

    /// The running statistics of the batch normalisations.
    pub fn statistics(&self) -> &Tensors {
        &self.statistics
    }

    /// Changes the step size.
    pub fn set_learning_rate(&mut self, learning_rate: f32) {
        self.settings.adam.learning_rate = learning_rate;
    }

    /// The same network with its parameters fixed, for another world: before its first frame.
    pub fn follower(&self) -> Self {
        let mut follower = Self::new(
            self.settings,
            self.shape.grid,
            self.shape.n_states,
            self.shape.n_observations,
            self.seed,
        );
        follower.parameters = self.parameters.clone();
        follower.statistics = self.statistics.clone();
        follower.inference = None;
        follower.forget();
        follower
    }

    /// Forgets all frames: `h ~ N(0, I)`, the same for a seed.
    pub fn forget(&mut self) {
        let hidden = self.draw_hidden(&mut stream(self.seed, Purpose::Hidden, u64::MAX));
        self.restart(hidden);
    }

    /// Forgets all frames: from here on, `h` is `hidden` and the predictor is decoded from it.
    ///
    /// # Panics
    /// If `hidden` has another length.
    pub fn restart(&mut self, hidden: Vec<f32>) {
        assert_eq!(hidden.len(), self.shape.hidden, "numbers of h");
        self.before.clone_from(&hidden);
        self.hidden = hidden;
        let mut inference = self.take_inference();
        let mut prediction = self.no_prediction();
        dispatch(Decode {
            inference: &mut inference,
            hidden: &self.hidden,
            prediction: slice(&mut prediction),
        });
        self.inference = Some(inference);
        self.prediction = accepted(prediction);
    }

    /// Puts a predictor in place of the decoded one.
    pub fn set_prediction(&mut self, prediction: Belief) {
        self.prediction = prediction;
    }

    /// Reads a frame: the estimate `p_k` (Bayes' rule, eq. 10, at visited cells), after which
    /// [`Self::prediction`] is `u_{k+1}` and [`Self::hidden`] is `h_{k+1}`.
    ///
    /// # Errors
    /// [`StepError`]; nothing has changed then.
    ///
    /// # Panics
    /// If the frame is of another grid, or of more observations.
    pub fn step(&mut self, frame: &Frame) -> Result<Belief, StepError> {
        let window = Window::new([frame]);
        assert_eq!(frame.values().dim(), self.shape.grid.dim(), "frame: grid");
        assert!(window.fits(&self.shape), "frame: observations");
        let estimate = self.correct(frame)?;
        let mut inference = self.take_inference();
        let mut prediction = self.no_prediction();
        let mut hidden = self.hidden.clone();
        dispatch(Advance {
            inference: &mut inference,
            visits: window.visits(0),
            hidden: &mut hidden,
            prediction: slice(&mut prediction),
        });
        self.inference = Some(inference);
        // Softmax and ReLU would make numbers again of what is none.
        if hidden.iter().any(|number| !number.is_finite()) {
            let (update, tensor) = (self.n_updates, "the hidden vector".into());
            return Err(NotFinite { update, tensor }.into());
        }
        self.before = std::mem::replace(&mut self.hidden, hidden);
        self.prediction = accepted(prediction);
        Ok(estimate)
    }

    /// Bayes' rule with the learnt `O` at visited cells; the predictor elsewhere.
    fn correct(&self, frame: &Frame) -> Result<Belief, ZeroEvidence> {
        let (n_states, n_cells) = (self.shape.n_states, self.shape.grid.n_cells());
        let matrix = self.observation_matrix();
        let mut estimate = self.prediction.probabilities().clone();
        let cells = slice(&mut estimate);
        for (cell, observed) in frame.observed() {
            let likelihood = &matrix[usize::from(observed) * n_states..][..n_states];
            let prior = self.prediction.as_slice()[cell..].iter().step_by(n_cells);
            let joint = || {
                prior
                    .clone()
                    .zip(likelihood)
                    .map(|(&u, &o)| f64::from(u) * f64::from(o))
            };
            let evidence: f64 = joint().sum();
            if evidence <= 0.0 {
                return Err(ZeroEvidence {
                    cell: self.shape.grid.cell(cell),
                    observed,
                    belief: prior.copied().collect(),
                });
            }
            for (p, joint) in cells[cell..].iter_mut().step_by(n_cells).zip(joint()) {
                *p = (joint / evidence) as f32;
            }
        }
        Ok(accepted(estimate))
    }

    /// [`Self::update_on`] one window.
    ///
    /// # Errors
    /// [`NotFinite`] for a number that is not; nothing has changed then.
    ///
    /// # Panics
    /// If the window has fewer than two frames or is of another grid.
    pub fn update(&mut self, window: &Window) -> Result<f64, NotFinite> {
        self.update_on(std::slice::from_ref(window))
    }

    /// One step of Adam on the mean over some windows, each with dropout and `h_0` of its own, drawn from
    /// this update's streams one after the other; the loss before it.
    ///
    /// # Errors
    /// [`NotFinite`] for a number that is not; nothing has changed then.
    ///
    /// # Panics
    /// If there is no window, or one has fewer than two frames, another length or another grid.
    pub fn update_on(&mut self, windows: &[Window]) -> Result<f64, NotFinite> {
        let mut coins = stream(self.seed, Purpose::Dropout, self.n_updates);
        let mut hidden = stream(self.seed, Purpose::Hidden, self.n_updates);
        let drawn: Vec<_> = windows
            .iter()
            .map(|window| {
                let dropout = Dropout::draw_from(window.len(), &mut coins);
                (window, dropout, self.draw_hidden(&mut hidden))
            })
            .collect();
        let trajectories = drawn.iter().map(|(window, dropout, first)| Trajectory {
            window,
            dropout,
            first,
        });
        self.update_with(&trajectories.collect::<Vec<_>>())
    }

    /// [`Self::update_on`] with given masks and `h_0`.
    ///
    /// # Errors
    /// [`NotFinite`] for a number that is not; nothing has changed then.
    ///
    /// # Panics
    /// If there is no window, or one has fewer than two frames, another length or another grid.
    pub fn update_with(&mut self, trajectories: &[Trajectory<'_>]) -> Result<f64, NotFinite> {
        for Trajectory { window, .. } in trajectories {
            assert!(window.len() > 1, "window: expected two frames or more");
            assert!(window.fits(&self.shape), "window: grid or observations");
        }
        let mut workspace = self.take_workspace(trajectories[0].window.len());
        let mut statistics = self.statistics.clone();
        let loss = workspace.mean_loss_and_gradient(
            &self.parameters,
            &mut statistics,
            trajectories,
            &self.settings.loss,
        );
        let broken = self.not_finite(loss, &workspace.gradient);
        let broken = broken.or_else(|| self.move_by(&workspace.gradient, statistics));
        self.workspace = Some(workspace);
        broken.map_or(Ok(loss), |tensor| {
            let update = self.n_updates;
            Err(NotFinite { update, tensor })
        })
    }

    /// A step of Adam, unless it leads to a number that is not finite: then the tensor's name.
    fn move_by(&mut self, gradient: &Tensors, statistics: Tensors) -> Option<String> {
        let (mut adam, mut parameters) = (self.adam.clone(), self.parameters.clone());
        let numbers = &mut parameters.numbers;
        adam.step(&self.settings.adam, numbers, &gradient.numbers);
        let broken = [&statistics, &parameters]
            .into_iter()
            .find_map(Tensors::not_finite);
        if let Some(tensor) = broken {
            return Some(format!("{tensor} after the update"));
        }
        for (name, moment) in [("first", &adam.first), ("second", &adam.second)] {
            if let Some(tensor) = parameters.with_numbers(moment).not_finite() {
                return Some(format!("adam.{name}.{tensor}"));
            }
        }
        (self.adam, self.parameters, self.statistics) = (adam, parameters, statistics);
        self.inference = None;
        self.n_updates += 1;
        None
    }

    /// The gradient of the last update.
    pub fn gradient(&self) -> Option<&Tensors> {
        self.workspace.as_ref().map(|workspace| &workspace.gradient)
    }

    /// The first thing that is not finite: a cause before what follows from it.
    fn not_finite(&self, loss: f64, gradient: &Tensors) -> Option<String> {
        let tensors = [&self.parameters, &self.statistics];
        let tensor = tensors.into_iter().find_map(Tensors::not_finite);
        let gradient = || {
            let tensor = gradient.not_finite()?;
            Some(format!("gradient of {tensor}"))
        };
        let loss = || (!loss.is_finite()).then(|| "loss".to_owned());
        tensor.map(str::to_owned).or_else(gradient).or_else(loss)
    }

    /// `h_0 ~ N(0, I)`.
    fn draw_hidden(&self, rng: &mut ChaCha8Rng) -> Vec<f32> {
        (0..self.shape.hidden).map(|_| normal(rng)).collect()
    }

    fn take_inference(&mut self) -> Inference {
        let inference = self.inference.take();
        inference.unwrap_or_else(|| Inference::new(&self.shape, &self.parameters, &self.statistics))
    }

    fn take_workspace(&mut self, n_frames: usize) -> Workspace {
        let workspace = self.workspace.take();
        workspace
            .filter(|workspace| workspace.n_frames() == n_frames)
            .unwrap_or_else(|| Workspace::new(&self.shape, &self.parameters, n_frames))
    }

    fn no_prediction(&self) -> Probabilities {
        let (height, width) = self.shape.grid.dim();
        Probabilities::zeros((self.shape.n_states, height, width))
    }
}

fn slice(probabilities: &mut Probabilities) -> &mut [f32] {
    let slice = probabilities.as_slice_mut();
    slice.expect("invariant: probabilities are row-major")
}

fn accepted(probabilities: Probabilities) -> Belief {
    Belief::from_probabilities(probabilities).expect("invariant: a softmax is on the simplex")
}
