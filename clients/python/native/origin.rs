//! The sources that beliefs are built from: a model and a first belief, or a checkpoint.

use crate::errors::{check_memory, raised, warn};
use crate::model::{model_of, shape_of};
use crate::refusal::{invalid, refused};
use crate::saved::Saved;
use crate::threads::Pool;
use emberwatch_acting::beliefs::{BELIEFS, BeliefKind, Conditions, Input, KNOWN, WorldForm};
use emberwatch_acting::learned::{Learned, WorldNames};
use emberwatch_acting::options::usual;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::estimator::Estimator;
use emberwatch_learning::checkpoint::read_bytes;
use emberwatch_learning::learners;
use emberwatch_model::{Model, Shape};
use pyo3::prelude::*;
use pyo3::types::PyString;
use std::borrow::Cow;
use std::path::PathBuf;

/// Memory of the tables of a small model, in bytes.
const TABLE_BYTES: usize = 4096;

pub struct Origin {
    pub kind: &'static BeliefKind,
    pub model: Option<Model>,
    /// The model's file, from which a saved belief reads it again.
    pub model_text: Option<String>,
    pub prior: Option<Belief>,
    pub learned: Learned,
    /// The file of the learned values. Empty if nothing was learned.
    pub checkpoint: Vec<u8>,
    pub shape: Shape,
}

/// The fields of Python's `Kind`.
type Facts = (&'static str, bool, bool, bool);

#[pyfunction]
pub fn belief_kinds() -> Vec<(&'static str, Facts)> {
    let facts = |it: &BeliefKind| {
        let is_learned = it.learned_by.is_some();
        (it.about, it.knows_model, is_learned, it.has_options)
    };
    of_frames().map(|it| (it.name, facts(it))).collect()
}

impl Origin {
    pub fn known(
        py: Python<'_>,
        model_text: &str,
        prior: Belief,
        kind: &'static BeliefKind,
    ) -> PyResult<Self> {
        let (model, dim) = (model_of(model_text)?, prior.probabilities().dim());
        if dim.0 != model.n_states() {
            let expected = format!("shape ({}, H, W)", model.n_states());
            return Err(invalid(py, "prior", expected, format!("{dim:?}")));
        }
        Ok(Self {
            kind,
            model: Some(model),
            model_text: Some(model_text.into()),
            shape: prior.shape(),
            prior: Some(prior),
            learned: Learned::default(),
            checkpoint: Vec::new(),
        })
    }

    pub fn learned(
        py: Python<'_>,
        name: &str,
        checkpoint: Vec<u8>,
        shape: Shape,
        kind: Option<&'static BeliefKind>,
        model_text: Option<&str>,
    ) -> PyResult<Self> {
        let model = model_text.map(model_of).transpose()?;
        let learned = decoded(py, name, &checkpoint)?;
        let kind = kind.unwrap_or_else(|| usual(&learned));
        if kind.learned_by.is_none() {
            let got = format!("decisions on the belief '{}': use known(model)", kind.name);
            return Err(invalid(py, "checkpoint", "a learned belief", got));
        }
        let form = model.as_ref().map(|model| WorldForm::of(model, shape));
        let fits = form.map_or(Ok(()), |form| kind.check(&learned, &form));
        fits.map_err(|error| refused(py, format!("{error:#}")))?;
        Ok(Self {
            kind,
            model,
            model_text: model_text.map(Into::into),
            prior: None,
            learned,
            checkpoint,
            shape,
        })
    }

    pub fn saved(py: Python<'_>, saved: &Saved<'_>) -> PyResult<Self> {
        let is_learned = !saved.checkpoint.is_empty();
        let shape = shape_of(py, saved.dim.1, saved.dim.2)?;
        let kind = kind_of(PyString::new(py, saved.kind).as_any(), is_learned)?;
        if is_learned {
            let (name, bytes) = ("of a saved belief", saved.checkpoint.to_vec());
            return Self::learned(py, name, bytes, shape, Some(kind), saved.model);
        }
        let prior = Belief::from_bytes(saved.prior, saved.dim);
        let Some((model, prior)) = saved.model.zip(prior) else {
            let expected = "a saved belief with a model and a first belief";
            return Err(invalid(py, "belief", expected, "one without"));
        };
        Self::known(py, model, prior, kind)
    }

    pub fn warn_of_other_worlds(&self, py: Python<'_>) -> PyResult<()> {
        let names = self.model.as_ref().map(WorldNames::of);
        let warning = names.and_then(|names| self.learned.warning_in(&names));
        warning.map_or(Ok(()), |warning| warn(py, warning))
    }

    pub fn conditions(&self) -> Conditions<'_> {
        Conditions {
            shape: self.shape,
            model: self.model.as_ref(),
            prior: self.prior.as_ref(),
            learned: &self.learned,
        }
    }

    pub fn estimator(&self) -> anyhow::Result<Box<dyn Estimator>> {
        (self.kind.build)(&self.conditions())
    }

    /// Builds the beliefs about `n_worlds` worlds, each with `n_states` states. Signals interrupt it.
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
        memory(TABLE_BYTES + 8 * belief + 4 * saved)?;
        let tasks = (1..n_worlds).collect();
        let others =
            py.detach(|| threads.each(self.is_short(n_worlds), tasks, |_| self.estimator()));
        let others = others.ok_or_else(raised)?;
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

pub fn kind_of(name: &Bound<'_, PyAny>, is_learned: bool) -> PyResult<&'static BeliefKind> {
    let kinds = || of_frames().filter(|kind| kind.learned_by.is_some() == is_learned);
    // Text that UTF-8 cannot encode is treated as an unknown name.
    let text = name.extract::<&str>().unwrap_or_default();
    if let Some(kind) = kinds().find(|kind| kind.name == text) {
        return Ok(kind);
    }
    let names: Vec<&str> = kinds().map(|kind| kind.name).collect();
    let expected = format!("one of {}", names.join(", "));
    Err(invalid(name.py(), "kind", expected, name.repr()?))
}

pub fn unfit(py: Python<'_>, error: &anyhow::Error) -> PyErr {
    refused(py, format!("{error:#}"))
}
