//! Options for Python: beliefs about worlds of one robot each, and the plans that a learner chooses from.

use crate::airspace::Given;
use crate::errors::warn;
use crate::estimators::raise;
use crate::model::{model_of, shape_of};
use crate::origin::decoded;
use crate::owned::Owned;
use crate::planned_worlds::PlannedWorlds;
use crate::prior::first_belief;
use crate::refusal::{invalid, refused};
use emberwatch_acting::beliefs::{self, BeliefKind};
use emberwatch_acting::config::{AgentConfig, PriorKind};
use emberwatch_acting::learned::{Learned, WorldNames};
use emberwatch_acting::options::{OptionSetup, usual};
use emberwatch_belief::Belief;
use emberwatch_belief::estimation::Prior;
use emberwatch_belief::planning::OPTIONS;
use emberwatch_belief::planning::options::feature_names;
use emberwatch_model::{Description, Model};
use numpy::{IntoPyArray, PyArray3, PyReadonlyArray1, PyReadonlyArray3};
use pyo3::prelude::*;
use pyo3::pybacked::PyBackedBytes;
use std::sync::OnceLock;

type Plans<'py> = (Bound<'py, PyArray3<f32>>, Bound<'py, PyArray3<u8>>);

#[pyfunction]
pub fn option_names() -> (Vec<&'static str>, Vec<String>) {
    (
        OPTIONS.iter().map(|option| option.name).collect(),
        feature_names(),
    )
}

/// The attributes of Python's `WorldSpec` that beliefs and plans depend on.
#[derive(FromPyObject)]
pub struct Spec<'py> {
    height: usize,
    width: usize,
    n_moves: usize,
    n_observations: usize,
    burn_in: u64,
    model: Option<Text>,
    description: Option<Text>,
    airspace: Given<'py>,
}

/// A Python `Model` or `Description`, as text.
#[derive(FromPyObject)]
struct Text {
    toml: String,
}

#[pyclass(frozen, module = "emberwatch._native")]
pub struct Options {
    #[pyo3(get)]
    estimator: String,
    first: (Prior, Model),
    prior: OnceLock<Belief>,
    worlds: Owned<PlannedWorlds>,
}

#[pymethods]
impl Options {
    /// Checks all arguments. Beliefs exist only after [`Self::begin`]. `checkpoint` is a path, for errors, and the bytes
    /// of its file.
    #[new]
    fn new(
        py: Python<'_>,
        spec: Spec<'_>,
        n_worlds: usize,
        estimator: Option<&str>,
        checkpoint: Option<(String, PyBackedBytes)>,
        prior: &str,
    ) -> PyResult<Self> {
        let estimator = estimator.map(beliefs::of_options).transpose();
        let estimator =
            estimator.map_err(|problem| refused(py, format!("estimator: {problem}")))?;
        let kind: PriorKind = serde_json::from_value(prior.into()).map_err(|_| {
            let got = format!("'{prior}'");
            invalid(py, "prior", "'simulated', 'initial' or 'uniform'", got)
        })?;
        let learned = checkpoint.map_or(Ok(Learned::default()), |(path, bytes)| {
            decoded(py, &path, &bytes)
        })?;
        let shape = shape_of(py, spec.height, spec.width)?;
        let kind_of_belief = estimator.unwrap_or_else(|| usual(&learned));
        let model = model(py, &spec, kind_of_belief)?;
        let is_known = spec.model.is_some() || spec.description.is_some();
        let names = is_known.then(|| WorldNames::of(&model));
        if let Some(warning) = names.and_then(|names| learned.warning_in(&names)) {
            warn(py, warning)?;
        }
        let setup = OptionSetup::new(estimator, learned, model, shape, spec.n_moves);
        let setup = setup.map_err(|error| refused(py, format!("{error:#}")))?;
        let config = AgentConfig {
            prior: kind,
            ..AgentConfig::default()
        };
        let first = if setup.estimator().knows_model {
            config.prior(spec.burn_in)
        } else {
            Prior::Initial
        };
        Ok(Self {
            estimator: setup.estimator().name.into(),
            first: (first, setup.model().clone()),
            prior: OnceLock::new(),
            worlds: Owned::new("options", PlannedWorlds::new(setup, n_worlds)),
        })
    }

    /// Starts episodes with the first belief in the worlds marked in `chosen`. `results`, here and below, are the bytes of
    /// `wire.RESULT_DTYPE` for all worlds. The first call may have to simulate the first belief, which takes seconds.
    fn start_episodes(
        &self,
        py: Python<'_>,
        chosen: PyReadonlyArray1<'_, bool>,
        results: PyReadonlyArray1<'_, u8>,
    ) -> PyResult<()> {
        let prior = match self.prior.get() {
            Some(prior) => prior,
            None => {
                let shape = self.worlds.with(py, |worlds| worlds.setup.shape())?;
                let (prior, model) = &self.first;
                let prior = first_belief(py, *prior, model, shape)?;
                self.prior.get_or_init(|| prior)
            }
        };
        let (chosen, results) = (chosen.as_slice()?, results.as_slice()?);
        let begun = self
            .worlds
            .with(py, |worlds| worlds.start_episodes(chosen, results, prior));
        begun?.map_err(|error| raise(py, &error))
    }

    /// Resumes a world's episode with the belief that another agent left for the current step. Returns whether this
    /// belief fits the estimator.
    fn take_over(&self, py: Python<'_>, world: usize, kind: &str, data: &[u8]) -> PyResult<bool> {
        self.worlds.with(py, |worlds| {
            let planned = worlds.world(world);
            planned.is_some_and(|planned| planned.take_over(kind, data))
        })
    }

    fn left(&self, py: Python<'_>, world: usize) -> PyResult<Option<(String, Vec<u8>)>> {
        self.worlds.with(py, |worlds| {
            let agent = worlds.world(world)?.agent();
            agent.handover_kind().zip(agent.handover())
        })
    }

    /// `result` and `frame`, `[1, H, W]`, are of an earlier step.
    fn recall(
        &self,
        py: Python<'_>,
        world: usize,
        result: PyReadonlyArray1<'_, u8>,
        frame: PyReadonlyArray3<'_, u8>,
    ) -> PyResult<()> {
        let (result, frame) = (result.as_slice()?, frame.as_slice()?);
        let recalled = self.worlds.with(py, |it| it.recall(world, result, frame));
        recalled?.map_err(|error| raise(py, &error))
    }

    /// `frames` has the shape `[n, H, W]`.
    fn update(
        &self,
        py: Python<'_>,
        chosen: PyReadonlyArray1<'_, bool>,
        results: PyReadonlyArray1<'_, u8>,
        frames: PyReadonlyArray3<'_, u8>,
    ) -> PyResult<()> {
        let (chosen, results) = (chosen.as_slice()?, results.as_slice()?);
        let frames = frames.as_slice()?;
        let seen = self
            .worlds
            .with(py, |it| it.update(chosen, results, frames));
        seen?.map_err(|error| raise(py, &error))
    }

    /// Returns features `[n_worlds, options, features]` and paths `[n_worlds, options, T]`, also of worlds that do not plan.
    fn plan<'py>(
        &self,
        py: Python<'py>,
        chosen: PyReadonlyArray1<'_, bool>,
        results: PyReadonlyArray1<'_, u8>,
    ) -> PyResult<Plans<'py>> {
        let (chosen, results) = (chosen.as_slice()?, results.as_slice()?);
        let (features, paths) = self.worlds.with(py, |it| it.plan(chosen, results))?;
        Ok((features.into_pyarray(py), paths.into_pyarray(py)))
    }

    fn close(&self, py: Python<'_>) -> PyResult<()> {
        self.worlds.close(py)
    }
}

/// Returns the worlds' model. If the model is hidden and the estimator needs none, returns a stand-in without dynamics.
fn model(py: Python<'_>, spec: &Spec<'_>, estimator: &BeliefKind) -> PyResult<Model> {
    if let Some(model) = &spec.model {
        return model_of(&model.toml);
    }
    if estimator.knows_model {
        let got = match spec.description {
            Some(_) => "recorded worlds, which have none",
            None => "a server that hides its own",
        };
        let expected = format!(
            "a model for the estimator '{}', or a checkpoint of a learned belief",
            estimator.name
        );
        return Err(invalid(py, "model", expected, got));
    }
    let model = match &spec.description {
        Some(description) => Description::model_of(&description.toml),
        None => spec.airspace.seen(spec.n_observations).unchanging(),
    };
    model.map_err(|error| refused(py, error.to_string()))
}
