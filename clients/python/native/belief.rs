//! Beliefs about `n` worlds in double precision, `[S, n, H, W]`: Bayes' rule, the operator `Phi`, and simulated priors.

use crate::detached::detached;
use crate::errors::{check_memory, no_memory, no_threads};
use crate::model::{model_of, shape_of};
use crate::refusal::{failed, invalid};
use emberwatch_belief::estimation::bayes::correct_cells;
use emberwatch_belief::{Belief, estimation::KeptBelief, estimation::Prior};
use emberwatch_messages::limits::memory::with_capacity;
use emberwatch_messages::limits::threads::NoThreads;
use emberwatch_model::{Model, ModelError};
use emberwatch_model::{Shape, UNOBSERVED, transition};
use numpy::ndarray::{Array3, Array4, ArrayView3, Axis};
use numpy::{
    IntoPyArray, PyArray3, PyArray4, PyArrayMethods, PyReadonlyArray2, PyReadonlyArray3, ToPyArray,
};
use pyo3::prelude::*;
use rayon::ThreadPoolBuilder;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, TryLockError};
use std::time::Duration;

/// Time between two checks for Ctrl-C in a long computation.
const LOOK: Duration = Duration::from_millis(2);

/// The operator `Phi` of one model on one grid. Only one thread at a time may use it.
#[pyclass(frozen, module = "emberwatch._native")]
pub struct Transition {
    /// The model file's text.
    model: String,
    shape: Shape,
    work: Mutex<Work>,
}

/// The operator with its scratch memory, which only one call at a time may use.
struct Work {
    /// The operator, or the error that `apply` raises because eq. 3 could divide by zero.
    operator: Result<transition::Transition<f64>, ModelError>,
    belief: Array3<f64>,
    predictor: Array3<f64>,
}

#[pymethods]
impl Transition {
    #[new]
    fn new(py: Python<'_>, model: String, height: usize, width: usize) -> PyResult<Self> {
        let (parameters, shape) = (model_of(&model)?, shape_of(py, height, width)?);
        // The scratch memory holds two beliefs, and a third one with margins around the grid.
        let n_bytes = 3 * parameters.n_states() * shape.n_cells() * size_of::<f64>();
        check_memory(py, "beliefs", n_bytes)?;
        let none = Array3::zeros((parameters.n_states(), height, width));
        let work = Work {
            operator: transition::Transition::new(&parameters, shape),
            belief: none.clone(),
            predictor: none,
        };
        Ok(Self {
            model,
            shape,
            work: Mutex::new(work),
        })
    }

    /// Applies `Phi` to beliefs `[S, n, H, W]`. Returns a new array of the same shape.
    fn apply<'py>(
        &self,
        py: Python<'py>,
        beliefs: &Bound<'py, PyArray4<f64>>,
    ) -> PyResult<Bound<'py, PyArray4<f64>>> {
        let mut work = match self.work.try_lock() {
            Ok(work) => work,
            Err(TryLockError::Poisoned(left)) => left.into_inner(),
            Err(TryLockError::WouldBlock) => {
                let expected = "a transition or filter that no other thread is using";
                return Err(invalid(py, "transition", expected, "one in use"));
            }
        };
        let Work {
            operator,
            belief,
            predictor,
        } = &mut *work;
        let operator = operator.as_mut().map_err(|error| vanishing(py, error))?;
        let beliefs = beliefs.try_readonly();
        let expected = "an array that no other thread corrects";
        let beliefs = beliefs.map_err(|_| invalid(py, "belief", expected, "one in use"))?;
        let beliefs = beliefs.as_array();
        let (n_states, height, width) = belief.dim();
        let (_, n_worlds, _, _) = beliefs.dim();
        if beliefs.dim() != (n_states, n_worlds, height, width) {
            let expected = format!("shape ({n_states}, n, {height}, {width})");
            return Err(invalid(
                py,
                "belief",
                expected,
                format!("{:?}", beliefs.dim()),
            ));
        }
        let probe = with_capacity::<f64>("predicted beliefs", beliefs.len());
        probe.map_err(|short| no_memory(py, &short))?;
        let mut out = Array4::zeros(beliefs.dim());
        detached(py, beliefs.len(), || {
            let worlds = beliefs.axis_iter(Axis(1)).zip(out.axis_iter_mut(Axis(1)));
            for (world, mut next) in worlds {
                belief.assign(&world);
                operator.apply(belief, predictor);
                next.assign(predictor);
            }
        });
        Ok(out.into_pyarray(py))
    }

    /// Returns the constructor's arguments, for copies and pickles.
    fn __getnewargs__(&self) -> (&str, usize, usize) {
        (&self.model, self.shape.height(), self.shape.width())
    }
}

/// Creates the exception for a model whose transition weights can all be 0, or can lose their precision.
pub fn vanishing(py: Python<'_>, error: &ModelError) -> PyErr {
    match error {
        ModelError::ZeroWeight { cell, .. } => {
            let subject = format!("model: transition weights of cell {cell}");
            let got = "weights that can all be 0";
            invalid(py, subject, "a positive sum for every neighbourhood", got)
        }
        ModelError::Value {
            what,
            expected,
            got,
            ..
        } => invalid(py, format!("model: {what}"), expected, got),
        other => invalid(py, "model", "weights that keep their precision", other),
    }
}

/// Corrects beliefs in place by Bayes' rule (eq. 5), in the cells that the frames `[n, H, W]` show. `likelihood` is
/// `P(y | x)`, `[S, O]`.
#[pyfunction]
pub fn correct<'py>(
    py: Python<'py>,
    beliefs: &Bound<'py, PyArray4<f64>>,
    likelihood: PyReadonlyArray2<'py, f64>,
    frames: PyReadonlyArray3<'py, u8>,
) -> PyResult<()> {
    let beliefs = beliefs.try_readwrite();
    let expected = "a writable array that no other thread uses";
    let got = "a read-only array, or one in use";
    let mut beliefs = beliefs.map_err(|_| invalid(py, "belief", expected, got))?;
    let (likelihood, frames) = (likelihood.as_array(), frames.as_array());
    let (n_worlds, height, width) = frames.dim();
    let expected = (likelihood.nrows(), n_worlds, height, width);
    let got = beliefs.as_array().dim();
    if got != expected || got.0 == 0 {
        let (expected, got) = (format!("shape {expected:?}"), format!("{got:?}"));
        return Err(invalid(py, "belief", expected, got));
    }
    let likelihood = likelihood.to_owned();
    let values = detached(py, frames.len(), || shown(frames));
    let cell = |index: usize| {
        let (row, col) = (index / width % height, index % width);
        format!("frame: cell ({row}, {col})")
    };
    let n_observations = likelihood.ncols();
    if let Some((index, value)) = values.iter().find(|it| usize::from(it.1) >= n_observations) {
        let expected = format!("a value below {n_observations}, or {UNOBSERVED}");
        return Err(invalid(py, cell(*index), expected, value));
    }
    let probabilities = beliefs.as_slice_mut()?;
    let corrected = detached(py, frames.len(), || {
        correct_cells(probabilities, &likelihood, || values.iter().copied())
    });
    corrected.map_err(|impossible| {
        let (subject, belief) = (cell(impossible.index), impossible.belief);
        let expected = format!("expected an observation that the belief {belief:?} allows");
        let problem = format!("{subject}: {expected}, got {}", impossible.observed);
        failed(py, &problem, "impossible_frame")
    })
}

/// Returns the index and the value of each observed cell.
fn shown(frames: ArrayView3<'_, u8>) -> Vec<(usize, u8)> {
    let values = frames.iter().copied().enumerate();
    values.filter(|&(_, value)| value != UNOBSERVED).collect()
}

/// Simulates 64 worlds. Returns the share of worlds in which each cell is in each state after the burn-in, `[S, H, W]`.
#[pyfunction]
pub fn simulated_prior<'py>(
    py: Python<'py>,
    model: &str,
    height: usize,
    width: usize,
    burn_in: u64,
) -> PyResult<Bound<'py, PyArray3<f32>>> {
    let (model, shape) = (model_of(model)?, shape_of(py, height, width)?);
    let n_worlds = Prior::N_WORLDS;
    let prior = Prior::Simulated { n_worlds, burn_in };
    let belief = first_belief(py, prior, &model, shape)?;
    Ok(belief.probabilities().to_pyarray(py))
}

/// Returns the belief before the first frame. Caches a simulated belief in a file for other processes. Ctrl-C ends the
/// wait for another process that simulates it.
pub fn first_belief(py: Python<'_>, prior: Prior, model: &Model, shape: Shape) -> PyResult<Belief> {
    let is_simulated = matches!(prior, Prior::Simulated { .. });
    let kept = is_simulated.then(|| KeptBelief::new(prior, model, shape, 0));
    let pause = |time| {
        py.detach(|| std::thread::sleep(time));
        py.check_signals()
    };
    let make = || simulated(py, prior, model, shape);
    match kept.flatten() {
        Some(kept) => kept.read_or_make(pause, make),
        None => make(),
    }
}

/// Simulates a prior on new threads, because a global pool is unusable after a fork. Ctrl-C ends the simulation.
fn simulated(py: Python<'_>, prior: Prior, model: &Model, shape: Shape) -> PyResult<Belief> {
    let cancelled = AtomicBool::new(false);
    let n_threads = std::thread::available_parallelism().map_or(1, usize::from);
    // Each thread simulates one world at a time, and counts for each cell how often each state occurs.
    let of_thread = shape.n_cells() * (model.n_states() * size_of::<u32>() + 5);
    let n_bytes = 2 * n_threads * of_thread;
    check_memory(py, "the worlds of a first belief", n_bytes)?;
    let pool = emberwatch_sim::limits::start(ThreadPoolBuilder::new(), n_threads);
    let pool = pool.map_err(|short| no_threads(py, &short))?;
    let simulated = std::thread::scope(|scope| {
        let work = || pool.install(|| prior.belief_unless(&cancelled, model, shape, 0));
        let worker = std::thread::Builder::new().spawn_scoped(scope, work);
        let worker = worker.map_err(|error| no_threads(py, &NoThreads::new(1, &error)))?;
        while !worker.is_finished() {
            py.detach(|| std::thread::sleep(LOOK));
            if let Err(interrupt) = py.check_signals() {
                cancelled.store(true, Ordering::Relaxed);
                return Err(interrupt);
            }
        }
        Ok(worker.join())
    })?;
    match simulated {
        Ok(Ok(Some(belief))) => Ok(belief),
        Ok(Err(error)) => Err(vanishing(py, &error)),
        Ok(Ok(None)) | Err(_) => Err(failed(
            py,
            "the first belief could not be simulated",
            "program",
        )),
    }
}
