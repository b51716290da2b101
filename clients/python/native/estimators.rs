//! The agent's estimators for Python: beliefs of one kind about `n` worlds, which are corrected with frames.

use crate::detached::detached;
use crate::errors::warn;
use crate::model::{model_of, shape_of};
use crate::origin::{Origin, checkpoint_bytes, decoded, kind_of, no_prior, unfit};
use crate::refusal::{failed, invalid, refused};
use crate::threads::{Pool, Threads};
use emberwatch_acting::beliefs::WorldForm;
use emberwatch_acting::learned::{Learned, WorldNames};
use emberwatch_acting::options::usual;
use emberwatch_belief::brier::{accuracy, brier_score, log_loss};
use emberwatch_belief::estimation::SpatialFilter;
use emberwatch_belief::estimation::belief::{Belief, EntropyKind};
use emberwatch_belief::estimation::estimator::{Estimator, EstimatorError};
use emberwatch_belief::estimation::scoring::score;
use emberwatch_model::frame::FrameError;
use emberwatch_model::{Frame, Grid, Model, Shape};
use numpy::ndarray::{Array3, Array4, ArrayView3, Axis};
use numpy::{IntoPyArray, PyArray1, PyArray3, PyArray4, PyReadonlyArray1, PyReadonlyArray3};
use pyo3::prelude::*;
use pyo3::pybacked::PyBackedBytes;
use pyo3::types::PyTuple;
use std::any::Any;
use std::borrow::Cow;
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, TryLockError};

/// An array with one number per world.
type Numbers<'py> = Bound<'py, PyArray1<f64>>;

/// Beliefs about `n` worlds. Only one thread at a time may use them. In all methods, `chosen` is a mask of worlds,
/// `[n]`. The Python class has checked the shapes of all arrays.
#[pyclass(frozen, module = "emberwatch._native")]
pub struct Estimators {
    #[pyo3(get)]
    kind: &'static str,
    #[pyo3(get)]
    state_names: Vec<String>,
    /// Index of the state with the highest reward.
    #[pyo3(get)]
    target_state: usize,
    #[pyo3(get)]
    n_observations: usize,
    n_worlds: usize,
    shape: Shape,
    origin: Origin,
    state: Mutex<State>,
}

/// The estimators and their threads, which only one call at a time may use.
struct State {
    worlds: Vec<Box<dyn Estimator>>,
    threads: Pool,
}

/// Copies the correlations between cells that a spatial filter has learned. Does nothing for other kinds of estimators.
fn keep_correlations(from: &dyn Estimator, to: &mut dyn Estimator) {
    let from = (from as &dyn Any).downcast_ref::<SpatialFilter>();
    let to = (to as &mut dyn Any).downcast_mut::<SpatialFilter>();
    if let (Some(from), Some(to)) = (from, to) {
        to.set_correlations(from.correlations().clone());
    }
}

#[pymethods]
impl Estimators {
    /// Builds beliefs from a known model. `prior` is the first belief about each world, `[S, H, W]`.
    #[staticmethod]
    fn known(
        py: Python<'_>,
        model: &str,
        prior: PyReadonlyArray3<'_, f32>,
        kind: &Bound<'_, PyAny>,
        n_worlds: usize,
    ) -> PyResult<Self> {
        let kind = kind_of(kind, false)?;
        let (model, prior) = (model_of(model)?, prior.as_array());
        let (n_states, height, width) = prior.dim();
        if n_states != model.n_states() {
            let expected = format!("shape ({}, H, W)", model.n_states());
            return Err(invalid(py, "prior", expected, format!("{:?}", prior.dim())));
        }
        let shape = shape_of(py, height, width)?;
        let prior = Belief::from_probabilities(prior.to_owned());
        let prior = prior.map_err(|error| no_prior(py, error))?;
        let origin = Origin {
            kind,
            model: Some(model),
            prior: Some(prior),
            learned: Learned::default(),
            shape,
        };
        Self::new(py, origin, n_worlds)
    }

    /// Loads beliefs from a checkpoint. `kind` defaults to the kind that the checkpoint was trained for. If a model is
    /// given, checks that the checkpoint fits it.
    #[staticmethod]
    fn load(
        py: Python<'_>,
        checkpoint: PathBuf,
        grid: (usize, usize),
        kind: Option<&Bound<'_, PyAny>>,
        model: Option<&str>,
        n_worlds: usize,
    ) -> PyResult<Self> {
        let shape = shape_of(py, grid.0, grid.1)?;
        let kind = kind.map(|name| kind_of(name, true)).transpose()?;
        let model = model.map(model_of).transpose()?;
        let path = checkpoint.display().to_string();
        let learned = decoded(py, &path, &checkpoint_bytes(py, checkpoint)?)?;
        let kind = kind.unwrap_or_else(|| usual(&learned));
        if kind.learned_by.is_none() {
            let got = format!("decisions on the belief '{}': use known(model)", kind.name);
            return Err(invalid(py, "checkpoint", "a learned belief", got));
        }
        let names = model.as_ref().map(WorldNames::of);
        if let Some(warning) = names.and_then(|names| learned.warning_in(&names)) {
            warn(py, warning)?;
        }
        let form = model.as_ref().map(|model| WorldForm::of(model, shape));
        let fits = form.map_or(Ok(()), |form| kind.check(&learned, &form));
        fits.map_err(|error| refused(py, format!("{error:#}")))?;
        let origin = Origin {
            kind,
            model,
            prior: None,
            learned,
            shape,
        };
        Self::new(py, origin, n_worlds)
    }

    /// Returns the number of worlds, the height and the width.
    #[getter]
    fn shape(&self) -> (usize, usize, usize) {
        (self.n_worlds, self.shape.height(), self.shape.width())
    }

    /// Returns the beliefs, `[S, n, H, W]`: about X_k after `correct`, about X_{k+1} after `predict`.
    fn belief<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray4<f32>>> {
        let state = self.state(py)?;
        let (height, width) = self.shape.dim();
        let dim = (self.state_names.len(), state.worlds.len(), height, width);
        let mut out = Array4::zeros(dim);
        for (world, mut out) in state.worlds.iter().zip(out.axis_iter_mut(Axis(1))) {
            out.assign(&world.belief().view());
        }
        Ok(out.into_pyarray(py))
    }

    /// Returns the entropy of each cell in nats, `[n, H, W]`.
    fn entropy<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        let state = self.state(py)?;
        let (height, width) = self.shape.dim();
        let mut out = Array3::zeros((state.worlds.len(), height, width));
        for (world, mut out) in state.worlds.iter().zip(out.outer_iter_mut()) {
            out.assign(&world.belief().entropy(EntropyKind::Sum));
        }
        Ok(out.into_pyarray(py))
    }

    /// Resets the chosen worlds to the first belief. With `keeps_correlations`, spatial filters keep the correlations
    /// between cells that they have learned.
    fn reset(
        &self,
        py: Python<'_>,
        chosen: PyReadonlyArray1<'_, bool>,
        keeps_correlations: bool,
    ) -> PyResult<()> {
        let mut state = self.state(py)?;
        let chosen = chosen.as_slice()?;
        let n_chosen = chosen.iter().filter(|chosen| **chosen).count();
        let State { worlds, threads } = &mut *state;
        let chosen = worlds.iter_mut().zip(chosen);
        let chosen = chosen.filter_map(|(world, &chosen)| chosen.then_some(world));
        let reset = detached(py, n_chosen * self.n_numbers(), || {
            threads.work(self.origin.is_short(n_chosen), |threads| {
                threads.each(chosen, |world| {
                    let mut new = self.origin.estimator()?;
                    if keeps_correlations {
                        keep_correlations(&**world, &mut *new);
                    }
                    Ok((world, new))
                })
            })
        });
        // Either all worlds are reset, or none.
        let reset: anyhow::Result<Vec<_>> = reset.into_iter().collect();
        for (world, new) in reset.map_err(|error| raise(py, &error))? {
            *world = new;
        }
        Ok(())
    }

    /// Returns the state of the belief about each world, for [`Self::restore`], which continues bit for bit.
    fn to_bytes(&self, py: Python<'_>) -> PyResult<Vec<Cow<'static, [u8]>>> {
        let handover = self.origin.kind.traits.handover;
        let handover = handover.ok_or_else(|| self.not_kept(py))?;
        let state = self.state(py)?;
        let worlds = state.worlds.iter();
        Ok(worlds
            .map(|world| handover(&**world).to_bytes().into())
            .collect())
    }

    /// Restores the beliefs about all worlds from `to_bytes` of beliefs of the same kind. If the bytes do not fit,
    /// earlier worlds may have changed.
    fn restore(&self, py: Python<'_>, worlds: Vec<PyBackedBytes>) -> PyResult<()> {
        let handover = self.origin.kind.traits.handover_mut;
        let handover = handover.ok_or_else(|| self.not_kept(py))?;
        let mut state = self.state(py)?;
        let pairs = state.worlds.iter_mut().zip(&worlds);
        let mut restored = pairs.map(|(world, bytes)| handover(&mut **world).restore(bytes));
        if worlds.len() == self.n_worlds && restored.all(|fits| fits) {
            return Ok(());
        }
        let expected = format!("states of {} beliefs '{}'", self.n_worlds, self.kind);
        Err(invalid(py, "belief", expected, "others"))
    }

    /// Corrects the beliefs about the chosen worlds with their frames. `frames`, `[n, H, W]`, has one frame per world.
    fn correct(
        &self,
        py: Python<'_>,
        frames: PyReadonlyArray3<'_, u8>,
        chosen: PyReadonlyArray1<'_, bool>,
    ) -> PyResult<()> {
        let mut state = self.state(py)?;
        let frames = self.frames(py, frames.as_array(), chosen.as_slice()?)?;
        let State { worlds, threads } = &mut *state;
        let is_short = self.origin.is_short(worlds.len());
        let n_numbers = worlds.len() * self.n_numbers();
        let corrected = detached(py, n_numbers, || {
            threads.work(is_short, |threads| {
                threads.each(worlds.iter_mut().zip(frames), |(world, frame)| {
                    frame.map_or(Ok(()), |frame| world.correct(&frame))
                })
            })
        });
        let n_worlds = corrected.len();
        let refused = corrected.into_iter().enumerate();
        let refused = refused.filter_map(|(world, result)| Some((world, result.err()?)));
        let (refused, errors): (Vec<usize>, Vec<_>) = refused.unzip();
        let Some(first) = errors.into_iter().next() else {
            return Ok(());
        };
        let error = anyhow::Error::from(first);
        let error = if n_worlds > 1 {
            error.context(named(&refused))
        } else {
            error
        };
        let raised = raise(py, &error);
        raised
            .value(py)
            .setattr("worlds", PyTuple::new(py, refused)?)?;
        Err(raised)
    }

    /// Predicts: moves the beliefs about the chosen worlds from X_k to X_{k+1}.
    fn predict(&self, py: Python<'_>, chosen: PyReadonlyArray1<'_, bool>) -> PyResult<()> {
        let mut state = self.state(py)?;
        let chosen = chosen.as_slice()?;
        let State { worlds, threads } = &mut *state;
        let is_short = self.origin.is_short(worlds.len());
        let worlds = worlds.iter_mut().zip(chosen);
        let worlds = worlds.filter_map(|(world, &chosen)| chosen.then_some(&mut **world));
        let worlds: Vec<&mut dyn Estimator> = worlds.collect();
        let n_numbers = worlds.len() * self.n_numbers();
        detached(py, n_numbers, || {
            threads.work(is_short, |threads| self.predict_all(worlds, threads));
        });
        Ok(())
    }

    /// Scores the beliefs against hidden states `[n, H, W]`. Returns three arrays with one value per world: log losses,
    /// Brier scores for the state `target`, and shares of cells whose most probable state is right.
    fn scores<'py>(
        &self,
        py: Python<'py>,
        states: PyReadonlyArray3<'py, u8>,
        target: usize,
    ) -> PyResult<(Numbers<'py>, Numbers<'py>, Numbers<'py>)> {
        let state = self.state(py)?;
        let states = states.as_array();
        let n_states = self.state_names.len();
        if let Some(got) = states.iter().find(|state| usize::from(**state) >= n_states) {
            return Err(invalid(
                py,
                "states",
                format!("values below {n_states}"),
                got,
            ));
        }
        let truths: Vec<Grid<u8>> = states.outer_iter().map(|it| it.to_owned()).collect();
        let figures = |figure: &dyn Fn(&Belief, &Grid<u8>) -> f64| {
            let pairs = state.worlds.iter().zip(&truths);
            let figures = pairs.map(|(world, truth)| figure(world.belief(), truth));
            PyArray1::from_iter(py, figures)
        };
        let brier = |belief: &Belief, truth: &Grid<u8>| {
            brier_score(belief, truth, target, self.target_state)
        };
        Ok((figures(&log_loss), figures(&brier), figures(&accuracy)))
    }

    /// Scores the beliefs' predictions of frames `[n, H, W]`. Returns the log-likelihood, summed over the observed
    /// cells, and the number of observed cells.
    fn score_frames<'py>(
        &self,
        py: Python<'py>,
        frames: PyReadonlyArray3<'py, u8>,
    ) -> PyResult<(Numbers<'py>, Numbers<'py>)> {
        let mut state = self.state(py)?;
        let all = vec![true; state.worlds.len()];
        let frames = self.frames(py, frames.as_array(), &all)?;
        let State { worlds, threads } = &mut *state;
        let scored = worlds.iter_mut().zip(frames.iter().flatten());
        let kind = self.origin.kind;
        let scored = threads.work(self.origin.is_short(1), |_| {
            let scores = scored.filter_map(|(world, frame)| {
                let observation_model = kind.traits.observation_model?(&**world);
                Some(score(
                    world.belief(),
                    &*observation_model.likelihood()?,
                    frame,
                ))
            });
            scores
                .map(|score| (score.log_likelihood, score.n_seen as f64))
                .unzip()
        });
        let (sums, seen): (Vec<f64>, Vec<f64>) = scored;
        Ok((sums.into_pyarray(py), seen.into_pyarray(py)))
    }
}

impl Estimators {
    fn new(py: Python<'_>, origin: Origin, n_worlds: usize) -> PyResult<Self> {
        let kind = origin.kind;
        let conditions = origin.conditions();
        let names = kind
            .state_names(&conditions)
            .and_then(|names| Ok((names, kind.target(&conditions)?)));
        let (state_names, target_state) = names.map_err(|error| unfit(py, &error))?;
        let mut threads = Pool::default();
        let mut worlds = origin.estimators(py, &mut threads, n_worlds, state_names.len())?;
        let of_model = origin.model.as_ref().map(Model::n_observations);
        let first = worlds.first_mut();
        let of_belief = threads.work(origin.is_short(1), |_| {
            let observation_model = kind.traits.observation_model?(&**first?);
            Some(observation_model.likelihood()?.ncols())
        });
        Ok(Self {
            kind: kind.name,
            n_observations: of_model.or(of_belief).unwrap_or(state_names.len()),
            state_names,
            target_state,
            n_worlds,
            shape: origin.shape,
            state: Mutex::new(State { worlds, threads }),
            origin,
        })
    }

    /// Predicts the beliefs about some worlds, in one batch if the kind of belief supports it.
    fn predict_all(&self, mut worlds: Vec<&mut dyn Estimator>, threads: Threads) {
        match self.origin.kind.traits.predict_together {
            Some(together) => together(worlds),
            None => {
                threads.each(worlds.iter_mut(), |world| world.predict());
            }
        }
    }

    /// Returns the number of probabilities in the belief about one world.
    fn n_numbers(&self) -> usize {
        self.state_names.len() * self.shape.n_cells()
    }

    /// Creates the exception for a kind whose state cannot be saved.
    fn not_kept(&self, py: Python<'_>) -> PyErr {
        invalid(py, "belief", "a kind whose state can be saved", self.kind)
    }

    /// Locks the estimators for this thread.
    ///
    /// # Errors
    /// If another thread is using them.
    fn state(&self, py: Python<'_>) -> PyResult<MutexGuard<'_, State>> {
        match self.state.try_lock() {
            Ok(state) => Ok(state),
            Err(TryLockError::Poisoned(left)) => Ok(left.into_inner()),
            Err(TryLockError::WouldBlock) => {
                let expected = "a belief that no other thread is using";
                Err(invalid(py, "belief", expected, "one in use"))
            }
        }
    }

    /// Decodes the frames of the chosen worlds; `None` for the other worlds.
    fn frames(
        &self,
        py: Python<'_>,
        frames: ArrayView3<'_, u8>,
        chosen: &[bool],
    ) -> PyResult<Vec<Option<Frame>>> {
        let frames = frames.as_standard_layout();
        let worlds = frames.outer_iter().zip(chosen);
        let frame = |(frame, &chosen): (numpy::ndarray::ArrayView2<'_, u8>, &bool)| {
            let bytes = frame.to_slice().expect("invariant: row-major");
            let frame = chosen.then(|| Frame::from_bytes(self.shape, self.n_observations, bytes));
            frame.transpose().map_err(|error| self.no_frame(py, &error))
        };
        worlds.map(frame).collect()
    }

    fn no_frame(&self, py: Python<'_>, error: &FrameError) -> PyErr {
        let FrameError::Value {
            index,
            value,
            n_observations,
        } = error
        else {
            return refused(py, error);
        };
        let subject = format!("frame: cell {}", self.shape.cell(*index));
        let expected = format!("a value below {n_observations}, or 255");
        invalid(py, subject, expected, value)
    }
}

/// Names worlds for an error: all, or the first eight and how many more.
fn named(worlds: &[usize]) -> String {
    let (shown, more) = worlds.split_at(worlds.len().min(8));
    let numbers: Vec<String> = shown.iter().map(usize::to_string).collect();
    let plural = if worlds.len() > 1 { "s" } else { "" };
    let more = match more.len() {
        0 => String::new(),
        n => format!(" and {n} more"),
    };
    format!("world{plural} {}{more}", numbers.join(", "))
}

/// Creates the exception for a belief that could not be built, or could not be corrected with a frame.
pub fn raise(py: Python<'_>, error: &anyhow::Error) -> PyErr {
    let is_impossible = matches!(
        error.downcast_ref::<EstimatorError>(),
        Some(EstimatorError::ZeroEvidence(_))
    );
    let code = if is_impossible {
        "impossible_frame"
    } else {
        "program"
    };
    failed(py, &format!("{error:#}"), code)
}
