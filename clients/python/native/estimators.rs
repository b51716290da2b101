//! The agent's estimators for Python: beliefs of one kind about `n` worlds, which are corrected with frames.

use crate::detached::detached;
use crate::errors::{check_memory, raised};
use crate::model::shape_of;
use crate::origin::{Origin, checkpoint_bytes, kind_of, unfit};
use crate::refusal::{failed, invalid, refused};
use crate::saved::{Saved, is_saved};
use crate::threads::Pool;
use emberwatch_belief::brier::{accuracy, brier_score, log_loss};
use emberwatch_belief::estimation::SpatialFilter;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::estimator::{Estimator, EstimatorError};
use emberwatch_belief::estimation::scoring::score;
use emberwatch_learning::file::replace_file;
use emberwatch_model::randomness::{Purpose, stream};
use emberwatch_model::text::shortened;
use emberwatch_model::{Frame, Grid, Model, Shape};
use numpy::ndarray::{Array3, Array4, ArrayView3, Axis};
use numpy::{
    Element, IntoPyArray, PyArray1, PyArray3, PyArray4, PyReadonlyArray1, PyReadonlyArray3,
};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyTuple};
use std::any::Any;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError};

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
    /// Whether Python's arrays have no axis for worlds.
    #[pyo3(get)]
    is_single: bool,
    shape: Shape,
    origin: Arc<Origin>,
    state: Mutex<State>,
    threads: Mutex<Pool>,
}

struct State {
    worlds: Vec<Box<dyn Estimator>>,
    /// Number of predictions of each world since the first belief.
    steps: Vec<u64>,
    /// Whether a signal interrupted a call, so that it is unknown which beliefs the call changed.
    is_unfinished: bool,
}

fn keep_correlations(from: &dyn Estimator, to: &mut dyn Estimator) {
    let from = (from as &dyn Any).downcast_ref::<SpatialFilter>();
    let to = (to as &mut dyn Any).downcast_mut::<SpatialFilter>();
    if let (Some(from), Some(to)) = (from, to) {
        to.set_correlations(from.correlations().clone());
    }
}

#[pymethods]
impl Estimators {
    #[staticmethod]
    fn known(
        py: Python<'_>,
        model: &str,
        prior: PyReadonlyArray3<'_, f32>,
        kind: &Bound<'_, PyAny>,
        n_worlds: Option<usize>,
    ) -> PyResult<Self> {
        let kind = kind_of(kind, false)?;
        let (_, height, width) = prior.as_array().dim();
        shape_of(py, height, width)?;
        let prior = Belief::from_probabilities(prior.as_array().to_owned());
        let prior = prior.map_err(|error| refused(py, format!("prior: {error}")))?;
        Self::new(py, Origin::known(py, model, prior, kind)?.into(), n_worlds)
    }

    /// Loads a checkpoint, or a file of `save`.
    #[staticmethod]
    fn load(
        py: Python<'_>,
        file: PathBuf,
        grid: Option<(usize, usize)>,
        kind: Option<&Bound<'_, PyAny>>,
        model: Option<&str>,
        n_worlds: Option<usize>,
    ) -> PyResult<Self> {
        let name = file.display().to_string();
        let bytes = checkpoint_bytes(py, file)?;
        if is_saved(&bytes) {
            let is_bare = grid.is_none() && kind.is_none() && model.is_none() && n_worlds.is_none();
            if !is_bare {
                let expected = "no other arguments, as a saved belief has its own";
                return Err(invalid(py, format!("belief {name}"), expected, "some"));
            }
            return Self::from_bytes(py, &bytes);
        }
        let Some((height, width)) = grid else {
            let expected = "the sides of the grid, as the file is a checkpoint";
            return Err(invalid(py, "height and width", expected, "None"));
        };
        let shape = shape_of(py, height, width)?;
        let kind = kind.map(|name| kind_of(name, true)).transpose()?;
        let origin = Origin::learned(py, &name, bytes.into_owned(), shape, kind, model)?;
        origin.warn_of_other_worlds(py)?;
        Self::new(py, origin.into(), n_worlds)
    }

    fn copy(&self, py: Python<'_>) -> PyResult<Self> {
        let worlds = self.saved(py)?;
        let n_worlds = (!self.is_single).then_some(self.n_worlds);
        let copy = Self::new(py, Arc::clone(&self.origin), n_worlds)?;
        copy.restore(py, &worlds)?;
        Ok(copy)
    }

    fn to_bytes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        Ok(PyBytes::new(py, &self.encoded(py)?))
    }

    #[staticmethod]
    fn from_bytes(py: Python<'_>, bytes: &[u8]) -> PyResult<Self> {
        let saved = Saved::from_bytes(bytes)
            .ok_or_else(|| invalid(py, "belief", "bytes of a saved belief", "damaged ones"))?;
        let origin = Origin::saved(py, &saved)?;
        let n_worlds = (!saved.is_single).then_some(saved.worlds.len());
        let it = Self::new(py, origin.into(), n_worlds)?;
        it.restore(py, &saved.worlds)?;
        Ok(it)
    }

    fn save(&self, py: Python<'_>, file: PathBuf) -> PyResult<()> {
        let bytes = self.encoded(py)?;
        let written = py.detach(|| replace_file(&file, &bytes));
        written.map_err(|error| refused(py, format!("belief: {error:#}")))
    }

    /// Returns the number of predictions of each world since the first belief. `None` after an interrupted call.
    fn steps(&self, py: Python<'_>) -> PyResult<Option<Vec<u64>>> {
        let state = self.locked(py)?;
        Ok((!state.is_unfinished).then(|| state.steps.clone()))
    }

    fn sample<'py>(&self, py: Python<'py>, seed: u64) -> PyResult<Bound<'py, PyArray3<u8>>> {
        if self.origin.kind.is_of_observations {
            let got = format!("'{}', which predicts observations", self.kind);
            return Err(invalid(py, "sample", "a belief about states", got));
        }
        self.of_cells(py, false, |index, belief| {
            belief.sample(&mut stream(seed, Purpose::Sample, index as u64))
        })
    }

    #[getter]
    fn shape(&self) -> (usize, usize, usize) {
        (self.n_worlds, self.shape.height(), self.shape.width())
    }

    /// Returns the beliefs, `[S, n, H, W]`: about X_k after `correct`, about X_{k+1} after `predict`.
    fn belief<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray4<f32>>> {
        let mut state = self.state(py)?;
        let worlds = &mut state.worlds;
        let (height, width) = self.shape.dim();
        let mut out = Array4::zeros((self.state_names.len(), worlds.len(), height, width));
        let tasks = worlds.iter_mut().zip(out.axis_iter_mut(Axis(1)));
        self.each(py, true, tasks, |(world, mut out)| {
            out.assign(&world.belief().view());
        })?;
        Ok(out.into_pyarray(py))
    }

    fn entropy<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        self.of_cells(py, true, |_, belief| belief.entropy())
    }

    fn reset(
        &self,
        py: Python<'_>,
        chosen: PyReadonlyArray1<'_, bool>,
        keeps_correlations: bool,
    ) -> PyResult<()> {
        let mut state = self.locked(py)?;
        let chosen = chosen.as_slice()?;
        let State { worlds, steps, .. } = &mut *state;
        let tasks = worlds.iter_mut().zip(steps).zip(chosen);
        let tasks = tasks.filter_map(|(world, &chosen)| chosen.then_some(world));
        let reset = self.each(py, false, tasks, |(world, step)| {
            let mut new = self.origin.estimator()?;
            if keeps_correlations {
                keep_correlations(&**world, &mut *new);
            }
            Ok((world, step, new))
        });
        let reset: anyhow::Result<Vec<_>> = reset?.into_iter().collect();
        for (world, step, new) in reset.map_err(|error| raise(py, &error))? {
            (*world, *step) = (new, 0);
        }
        state.is_unfinished &= chosen.contains(&false);
        Ok(())
    }

    fn correct(
        &self,
        py: Python<'_>,
        frames: PyReadonlyArray3<'_, u8>,
        chosen: PyReadonlyArray1<'_, bool>,
    ) -> PyResult<()> {
        let mut state = self.state(py)?;
        let chosen = chosen.as_slice()?;
        let frames = self.frames(py, frames.as_array(), chosen)?;
        let tasks = state.worlds.iter_mut().zip(frames).enumerate();
        let corrected = self.each(py, false, tasks, |(index, (world, frame))| {
            let corrected = world.correct(&frame?);
            Some((index, corrected.err()?))
        });
        state.is_unfinished = corrected.is_err();
        let (refused, errors): (Vec<usize>, Vec<_>) = corrected?.into_iter().flatten().unzip();
        let Some(first) = errors.into_iter().next() else {
            return Ok(());
        };
        let error = anyhow::Error::from(first);
        let error = if self.n_worlds > 1 {
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

    fn predict(&self, py: Python<'_>, chosen: PyReadonlyArray1<'_, bool>) -> PyResult<()> {
        let mut state = self.state(py)?;
        let chosen = chosen.as_slice()?;
        let tasks = state.worlds.iter_mut().zip(chosen);
        let tasks = tasks.filter_map(|(world, &chosen)| chosen.then_some(world));
        let predicted = self.each(py, false, tasks, |world| world.predict());
        state.is_unfinished = predicted.is_err();
        for (step, &chosen) in state.steps.iter_mut().zip(chosen) {
            *step += u64::from(chosen);
        }
        predicted.map(|_| ())
    }

    /// Returns log losses, Brier scores for the state `target`, and shares of cells whose most probable state is right.
    fn scores<'py>(
        &self,
        py: Python<'py>,
        states: PyReadonlyArray3<'py, u8>,
        target: usize,
    ) -> PyResult<(Numbers<'py>, Numbers<'py>, Numbers<'py>)> {
        let mut state = self.state(py)?;
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
        let worlds = &mut state.worlds;
        let tasks = worlds.iter_mut().zip(&truths);
        let figures = self.each(py, true, tasks, |(world, truth)| {
            let belief = world.belief();
            let brier = brier_score(belief, truth, target, self.target_state);
            [log_loss(belief, truth), brier, accuracy(belief, truth)]
        })?;
        let [losses, briers, accuracies] =
            [0, 1, 2].map(|it| PyArray1::from_iter(py, figures.iter().map(|all| all[it])));
        Ok((losses, briers, accuracies))
    }

    /// Returns the log-likelihood, summed over the observed cells, and the number of these cells.
    fn score_frames<'py>(
        &self,
        py: Python<'py>,
        frames: PyReadonlyArray3<'py, u8>,
    ) -> PyResult<(Numbers<'py>, Numbers<'py>)> {
        let mut state = self.state(py)?;
        let all = vec![true; state.worlds.len()];
        let frames = self.frames(py, frames.as_array(), &all)?;
        let worlds = &mut state.worlds;
        let tasks = worlds.iter_mut().zip(frames.iter().flatten());
        let kind = self.origin.kind;
        let scored = self.each(py, !kind.is_parallel, tasks, |(world, frame)| {
            let observation_model = kind.traits.observation_model?(&**world);
            let likelihood = observation_model.likelihood()?;
            let score = score(world.belief(), &likelihood, frame);
            Some((score.log_likelihood, score.n_seen as f64))
        })?;
        let (sums, seen): (Vec<f64>, Vec<f64>) = scored.into_iter().flatten().unzip();
        Ok((sums.into_pyarray(py), seen.into_pyarray(py)))
    }
}

impl Estimators {
    fn new(py: Python<'_>, origin: Arc<Origin>, n_worlds: Option<usize>) -> PyResult<Self> {
        let (is_single, n_worlds) = (n_worlds.is_none(), n_worlds.unwrap_or(1));
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
        let state = State {
            worlds,
            steps: vec![0; n_worlds],
            is_unfinished: false,
        };
        Ok(Self {
            kind: kind.name,
            n_observations: of_model.or(of_belief).unwrap_or(state_names.len()),
            state_names,
            target_state,
            n_worlds,
            is_single,
            shape: origin.shape,
            state: Mutex::new(state),
            threads: Mutex::new(threads),
            origin,
        })
    }

    fn saved(&self, py: Python<'_>) -> PyResult<Vec<(u64, Vec<u8>)>> {
        let Some(handover) = self.origin.kind.traits.handover else {
            let got = format!("'{}', which cannot", self.kind);
            let expected = "a kind that can be copied and saved";
            return Err(invalid(py, "belief", expected, got));
        };
        let mut state = self.state(py)?;
        let State { worlds, steps, .. } = &mut *state;
        let what = format_args!("a copy of the beliefs about {} worlds", self.n_worlds);
        let of_world = handover(&*worlds[0]).to_bytes().len();
        check_memory(py, what, self.n_worlds.saturating_mul(2 * of_world))?;
        let save = |world: &mut Box<dyn Estimator>| handover(&**world).to_bytes();
        let worlds = self.each(py, false, worlds.iter_mut(), save)?;
        Ok(steps.iter().copied().zip(worlds).collect())
    }

    fn encoded(&self, py: Python<'_>) -> PyResult<Vec<u8>> {
        let worlds = self.saved(py)?;
        let (height, width) = self.shape.dim();
        let prior = self.origin.prior.as_ref().map(Belief::to_bytes);
        let saved = Saved {
            kind: self.kind,
            model: self.origin.model_text.as_deref(),
            dim: (self.state_names.len(), height, width),
            is_single: self.is_single,
            prior: prior.as_deref().unwrap_or_default(),
            checkpoint: &self.origin.checkpoint,
            worlds: worlds.iter().map(|it| (it.0, &*it.1)).collect(),
        };
        Ok(py.detach(|| saved.to_bytes()))
    }

    fn restore<W: AsRef<[u8]> + Sync>(&self, py: Python<'_>, saved: &[(u64, W)]) -> PyResult<()> {
        let mut state = self.state(py)?;
        let handover = self.origin.kind.traits.handover_mut;
        let tasks = state.worlds.iter_mut().zip(saved);
        let restored = self.each(py, false, tasks, |(world, (_, saved))| {
            handover.is_some_and(|it| it(&mut **world).restore(saved.as_ref()))
        })?;
        if restored != vec![true; self.n_worlds] {
            let (kind, n) = (self.kind, self.n_worlds);
            let expected = format!("states of a belief '{kind}' about {n} worlds");
            let got = "others, or a prediction that failed";
            return Err(invalid(py, "belief", expected, got));
        }
        state.steps = saved.iter().map(|it| it.0).collect();
        Ok(())
    }

    /// Applies `work` to each task, until a signal handler raises an exception. Cheap work runs on this thread.
    fn each<T: Send, U: Send>(
        &self,
        py: Python<'_>,
        is_cheap: bool,
        tasks: impl Iterator<Item = T>,
        work: impl Fn(T) -> U + Sync + Send,
    ) -> PyResult<Vec<U>> {
        let tasks: Vec<T> = tasks.collect();
        let is_short = is_cheap || self.origin.is_short(tasks.len());
        let n_numbers = tasks.len() * self.n_numbers();
        // No other call holds the lock, as the caller has locked the state.
        let threads = || self.threads.lock().unwrap_or_else(PoisonError::into_inner);
        let done = detached(py, n_numbers, || threads().each(is_short, tasks, work));
        done.ok_or_else(raised)
    }

    fn of_cells<'py, T: Element + Copy + Default + Send>(
        &self,
        py: Python<'py>,
        is_cheap: bool,
        work: impl Fn(usize, &Belief) -> Grid<T> + Sync + Send,
    ) -> PyResult<Bound<'py, PyArray3<T>>> {
        let mut state = self.state(py)?;
        let (height, width) = self.shape.dim();
        let mut out = Array3::default((self.n_worlds, height, width));
        let tasks = state.worlds.iter_mut().zip(out.outer_iter_mut());
        self.each(
            py,
            is_cheap,
            tasks.enumerate(),
            |(index, (world, mut out))| {
                out.assign(&work(index, world.belief()));
            },
        )?;
        Ok(out.into_pyarray(py))
    }

    fn n_numbers(&self) -> usize {
        self.state_names.len() * self.shape.n_cells()
    }

    /// Refuses beliefs that another thread uses, or that a signal left unfinished.
    fn state(&self, py: Python<'_>) -> PyResult<MutexGuard<'_, State>> {
        let state = self.locked(py)?;
        if state.is_unfinished {
            let problem = "belief: an interrupted call left it unfinished: reset all worlds first";
            return Err(failed(py, problem, "interrupted"));
        }
        Ok(state)
    }

    fn locked(&self, py: Python<'_>) -> PyResult<MutexGuard<'_, State>> {
        match self.state.try_lock() {
            Ok(state) => Ok(state),
            Err(TryLockError::Poisoned(left)) => Ok(left.into_inner()),
            Err(TryLockError::WouldBlock) => {
                let expected = "a belief that no other thread is using";
                Err(invalid(py, "belief", expected, "one in use"))
            }
        }
    }

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
            frame.transpose().map_err(|error| refused(py, error))
        };
        worlds.map(frame).collect()
    }
}

/// Names worlds for an error; of many, the first and the last.
fn named(worlds: &[usize]) -> String {
    let numbers: Vec<String> = worlds.iter().map(usize::to_string).collect();
    let plural = if worlds.len() > 1 { "s" } else { "" };
    format!("world{plural} {}", shortened(&numbers.join(", ")))
}

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
