//! The sources that beliefs are built from: a model and a first belief, or a checkpoint.

use crate::errors::check_memory;
use crate::prior::vanishing;
use crate::refusal::{invalid, refused};
use crate::threads::Pool;
use emberwatch_acting::beliefs::{BELIEFS, BeliefKind, Conditions, Input, KNOWN, named};
use emberwatch_acting::learned::Learned;
use emberwatch_belief::estimation::belief::{Belief, BeliefError};
use emberwatch_belief::estimation::estimator::Estimator;
use emberwatch_learning::checkpoint::read_bytes;
use emberwatch_learning::learners;
use emberwatch_model::{Model, ModelError, Shape};
use pyo3::prelude::*;
use std::borrow::Cow;
use std::path::PathBuf;

/// Memory of the tables of a small model, in bytes.
const TABLE_BYTES: usize = 4096;

/// The kind and the sources of beliefs.
pub struct Origin {
    pub kind: &'static BeliefKind,
    pub model: Option<Model>,
    pub prior: Option<Belief>,
    pub learned: Learned,
    pub shape: Shape,
}

/// The fields of Python's `Kind`.
type Facts = (&'static str, bool, bool, bool);

/// Returns the name and the facts of each kind of belief that is corrected with frames.
#[pyfunction]
pub fn belief_kinds() -> Vec<(&'static str, Facts)> {
    let facts = |it: &BeliefKind| {
        (
            it.about,
            it.knows_model,
            it.learned_by.is_some(),
            it.has_options,
        )
    };
    of_frames().map(|kind| (kind.name, facts(kind))).collect()
}

impl Origin {
    pub fn conditions(&self) -> Conditions<'_> {
        Conditions {
            shape: self.shape,
            model: self.model.as_ref(),
            prior: self.prior.as_ref(),
            learned: &self.learned,
        }
    }

    /// Builds the belief about one world before the first frame.
    pub fn estimator(&self) -> anyhow::Result<Box<dyn Estimator>> {
        (self.kind.build)(&self.conditions())
    }

    /// Builds the beliefs about `n_worlds` worlds, each with `n_states` states.
    ///
    /// # Errors
    /// If there is not enough memory, or if the model or checkpoint provides no belief on this grid.
    pub fn estimators(
        &self,
        py: Python<'_>,
        threads: &mut Pool,
        n_worlds: usize,
        n_states: usize,
    ) -> PyResult<Vec<Box<dyn Estimator>>> {
        let memory = |of_world: usize| {
            let what = format_args!("the beliefs about {n_worlds} worlds");
            check_memory(py, what, n_worlds.saturating_mul(of_world))
        };
        // Every kind needs memory for at least a belief and a predictor. How much more is estimated from the state that
        // the first estimator would save.
        memory(2 * n_states * self.shape.n_cells() * size_of::<f32>())?;
        let first = py.detach(|| threads.work(self.is_short(1), |_| self.estimator()));
        let first = first.map_err(|error| unfit(py, &error))?;
        let (expected, got) = (self.shape, first.belief().shape());
        if got != expected {
            let expected = format!("a belief on {expected}");
            return Err(invalid(py, "checkpoint", expected, got));
        }
        let saved = self.kind.traits.handover;
        let saved = saved.map_or(0, |it| it(&*first).to_bytes().len());
        let belief = size_of_val(first.belief().as_slice());
        memory(TABLE_BYTES + 8 * belief + 2 * saved)?;
        let others = py.detach(|| {
            threads.work(self.is_short(n_worlds), |threads| {
                threads.each(1..n_worlds, |_| self.estimator())
            })
        });
        let worlds: anyhow::Result<Vec<_>> = std::iter::once(Ok(first)).chain(others).collect();
        worlds.map_err(|error| unfit(py, &error))
    }

    /// Returns whether a step is too short to divide among threads, as with the plain filter or a single world.
    pub fn is_short(&self, n_worlds: usize) -> bool {
        *self.kind == KNOWN || is_short(self.kind, n_worlds)
    }
}

/// Returns whether the work on some worlds is too short to divide among threads, as with a single world. Never true for
/// parallel kinds: all their work must run on a [`Pool`], as they would use rayon's global pool elsewhere.
pub fn is_short(kind: &BeliefKind, n_worlds: usize) -> bool {
    n_worlds <= 1 && !kind.is_parallel
}

/// Returns the bytes of a checkpoint, to be read only once.
#[pyfunction]
pub fn checkpoint_bytes(py: Python<'_>, path: PathBuf) -> PyResult<Cow<'static, [u8]>> {
    let bytes = py.detach(|| read_bytes(&path));
    let bytes = bytes.map_err(|error| refused(py, format!("{error:#}")))?;
    Ok(bytes.into())
}

/// Decodes the learned values of a checkpoint. `path` names it in errors. Some networks compute when they are created,
/// so this needs a pool.
pub fn decoded(py: Python<'_>, path: &str, bytes: &[u8]) -> PyResult<Learned> {
    let decode = |_| learners::from_bytes(bytes);
    let learned = py.detach(|| Pool::default().work(false, decode));
    learned.map_err(|error| refused(py, format!("checkpoint {path}: {error:#}")))
}

fn of_frames() -> impl Iterator<Item = &'static BeliefKind> {
    let kinds = BELIEFS.iter().copied();
    kinds.filter(|kind| kind.input == Input::Frames)
}

/// Finds a kind of belief by its name, either among the learned kinds or among the kinds that need only a model.
pub fn kind_of(name: &Bound<'_, PyAny>, is_learned: bool) -> PyResult<&'static BeliefKind> {
    let serves =
        |kind: &&BeliefKind| kind.input == Input::Frames && kind.learned_by.is_some() == is_learned;
    // Text that UTF-8 cannot encode is treated as an unknown name.
    let found = name.extract::<&str>().ok().and_then(named);
    if let Some(kind) = found.filter(serves) {
        return Ok(kind);
    }
    let names: Vec<&str> = of_frames().filter(serves).map(|kind| kind.name).collect();
    let expected = format!("one of {}", names.join(", "));
    Err(invalid(name.py(), "kind", expected, name.repr()?))
}

/// Creates the exception for a prior that is not a valid belief.
pub fn no_prior(py: Python<'_>, error: BeliefError) -> PyErr {
    match error {
        BeliefError::Simplex { cell, got } => {
            let (subject, got) = (format!("prior: cell {cell}"), format!("{got:?}"));
            invalid(py, subject, "probabilities >= 0 with sum 1", got)
        }
        other => refused(py, format!("prior: {other}")),
    }
}

/// Creates the exception for a model or a checkpoint from which no belief can be built.
pub fn unfit(py: Python<'_>, error: &anyhow::Error) -> PyErr {
    match error.downcast_ref::<ModelError>() {
        Some(error) => vanishing(py, error),
        None => refused(py, format!("{error:#}")),
    }
}
