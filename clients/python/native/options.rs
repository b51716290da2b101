//! Options: beliefs about worlds of one robot each, and the plans among which a learner chooses.

use crate::airspace::Given;
use crate::answer::RESULT_BYTES;
use crate::belief::first_belief;
use crate::connection::checked;
use crate::estimators::raise;
use crate::model::{model_of, shape_of};
use crate::owned::Owned;
use crate::refusal::{invalid, refused};
use crate::threads::{Pool, Threads};
use crate::wire::{Feed, View};
use anyhow::{Context, Result, ensure};
use emberwatch_belief::Belief;
use emberwatch_belief::estimation::Prior;
use emberwatch_belief::planning::OPTIONS;
use emberwatch_belief::planning::options::{N_FEATURES, feature_names};
use emberwatch_learning::beliefs::{self, BeliefKind, NEURAL};
use emberwatch_learning::config::{AgentConfig, PriorKind};
use emberwatch_learning::learners;
use emberwatch_learning::options::{Crew, Planned, Shown, usual};
use emberwatch_messages::agent_belief::Intent;
use emberwatch_messages::instance::Instance;
use emberwatch_messages::message::{RobotResult, WorldResult};
use emberwatch_messages::payload::WORLD_BYTES;
use emberwatch_model::Description;
use emberwatch_model::path::path_to_bytes;
use emberwatch_model::{Frame, Model};
use emberwatch_network::Device;
use numpy::ndarray::{Array3, ArrayView1, s};
use numpy::{IntoPyArray, PyArray3, PyReadonlyArray1, PyReadonlyArray3};
use pyo3::prelude::*;
use std::path::PathBuf;
use std::sync::OnceLock;

/// Features and paths of plans.
type Plans<'py> = (Bound<'py, PyArray3<f32>>, Bound<'py, PyArray3<u8>>);

/// Names of the options, and names of the features that describe each plan.
#[pyfunction]
pub fn option_names() -> (Vec<&'static str>, Vec<String>) {
    (
        OPTIONS.iter().map(|option| option.name).collect(),
        feature_names(),
    )
}

/// Name of each estimator that options can be planned on, and what it is.
#[pyfunction]
pub fn estimator_names() -> Vec<(&'static str, &'static str)> {
    let serves = |kind: &&BeliefKind| beliefs::of_options(kind.label).is_ok();
    let kinds = beliefs::BELIEFS.iter().copied().filter(serves);
    kinds.map(|kind| (kind.label, kind.about)).collect()
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

/// A file's text.
#[derive(FromPyObject)]
struct Text {
    toml: String,
}

/// Beliefs about many worlds, and the plans of all options in each.
#[pyclass(frozen, module = "emberwatch._native")]
pub struct Options {
    /// Name of the estimator that keeps the beliefs.
    #[pyo3(get)]
    estimator: String,
    /// How the first belief is made, once it is needed.
    first: (Prior, Model),
    prior: OnceLock<Belief>,
    state: Owned<State>,
}

struct State {
    crew: Crew,
    /// `None` before a world's first episode.
    worlds: Vec<Option<Planned>>,
    threads: Pool,
    watched: Option<Watched>,
}

/// The channel on which beliefs are published to observers.
struct Watched {
    instance: Instance,
    first_world: u32,
    feed: Option<Feed>,
}

/// The observation of one world, and what to do with it.
struct WorldWork<'a> {
    index: usize,
    planned: &'a mut Planned,
    world: WorldResult,
    robot: RobotResult,
    /// Seen before, if there is none.
    frame: Option<&'a [u8]>,
    flown: Option<usize>,
    plans: bool,
    is_shown: bool,
}

/// The published state of a world: the belief after its frame.
struct Outlook {
    index: usize,
    world: WorldResult,
    belief: Belief,
    intent: Intent,
}

#[pymethods]
impl Options {
    /// Checks all arguments; beliefs begin later. `watched`: the instance on which beliefs are shown, and its first
    /// world here.
    #[new]
    fn new(
        py: Python<'_>,
        spec: Spec<'_>,
        n_worlds: usize,
        estimator: Option<&str>,
        checkpoint: Option<PathBuf>,
        prior: &str,
        watched: Option<(String, u32)>,
    ) -> PyResult<Self> {
        let estimator = estimator.map(beliefs::of_options).transpose();
        let estimator =
            estimator.map_err(|problem| refused(py, format!("estimator: {problem}")))?;
        let kind: PriorKind = serde_json::from_value(prior.into()).map_err(|_| {
            let got = format!("'{prior}'");
            invalid(py, "prior", "'simulated', 'initial' or 'uniform'", got)
        })?;
        let learned = py.detach(|| learners::read(checkpoint.as_deref(), &Device::Cpu));
        let learned = learned.map_err(|error| refused(py, format!("{error:#}")))?;
        let shape = shape_of(py, spec.height, spec.width)?;
        let kind_of_belief = estimator.unwrap_or_else(|| usual(&learned));
        let model = model(py, &spec, kind_of_belief)?;
        let crew = Crew::new(estimator, learned, model, shape, spec.n_moves);
        let crew = crew.map_err(|error| refused(py, format!("{error:#}")))?;
        let config = AgentConfig {
            prior: kind,
            ..AgentConfig::default()
        };
        let first = if crew.estimator().knows_model {
            config.prior(spec.burn_in)
        } else {
            Prior::Initial
        };
        let watched = watched.map(|(instance, first_world)| {
            Ok::<_, PyErr>(Watched {
                instance: checked(py, &instance)?,
                first_world,
                feed: None,
            })
        });
        Ok(Self {
            estimator: crew.estimator().label.into(),
            first: (first, crew.model().clone()),
            prior: OnceLock::new(),
            state: Owned::new(
                "options",
                State {
                    crew,
                    worlds: (0..n_worlds).map(|_| None).collect(),
                    threads: Pool::default(),
                    watched: watched.transpose()?,
                },
            ),
        })
    }

    /// New beliefs, before the first frame of some worlds with these seeds; the first time the first one may be
    /// simulated.
    fn begin(&self, py: Python<'_>, worlds: Vec<usize>, seeds: Vec<u64>) -> PyResult<()> {
        let prior = match self.prior.get() {
            Some(prior) => prior,
            None => {
                let shape = self.state.with(py, |state| state.crew.shape())?;
                let (prior, model) = &self.first;
                let prior = first_belief(py, *prior, model, shape)?;
                self.prior.get_or_init(|| prior)
            }
        };
        let begun = self.state.with(py, |state| {
            state.begin(worlds.into_iter().zip(seeds), prior)
        });
        begun?.map_err(|error| raise(py, &error))
    }

    /// Continues in a world with the belief that another agent left for the present step. Returns whether it fits.
    fn take_over(&self, py: Python<'_>, world: usize, kind: &str, data: &[u8]) -> PyResult<bool> {
        self.state.with(py, |state| {
            let planned = state.worlds.get_mut(world).and_then(Option::as_mut);
            planned.is_some_and(|planned| planned.take_over(kind, data))
        })
    }

    /// Kind and bytes of the belief about a world, for the next client.
    fn left(&self, py: Python<'_>, world: usize) -> PyResult<Option<(String, Vec<u8>)>> {
        self.state.with(py, |state| {
            let agent = state.worlds.get(world)?.as_ref()?.agent();
            agent.handover_kind().zip(agent.handover())
        })
    }

    /// Updates beliefs with an earlier step of some worlds: bytes of `wire.RESULT_DTYPE`, and frames `[n, H, W]`.
    fn see(
        &self,
        py: Python<'_>,
        worlds: Vec<usize>,
        results: PyReadonlyArray1<'_, u8>,
        frames: PyReadonlyArray3<'_, u8>,
    ) -> PyResult<()> {
        let (results, frames) = (results.as_slice()?, frames.as_slice()?);
        let seen = self.state.with(py, |state| {
            state.update(&worlds, results, Some(frames), None, false)
        });
        seen?.map_err(|error| raise(py, &error))
    }

    /// Updates beliefs with the present step of some worlds, unless they include it already, and plans all options.
    /// Features `[n_worlds, options, features]` and paths `[n_worlds, options, T]` of all worlds; `flown`: which
    /// options brought them there.
    fn plan<'py>(
        &self,
        py: Python<'py>,
        worlds: Vec<usize>,
        results: PyReadonlyArray1<'py, u8>,
        frames: Option<PyReadonlyArray3<'py, u8>>,
        flown: Option<Vec<usize>>,
    ) -> PyResult<Plans<'py>> {
        let results = results.as_slice()?;
        let frames = frames.as_ref().map(|frames| frames.as_slice());
        let frames = frames.transpose()?;
        let plans = self.state.with(py, |state| {
            state.update(&worlds, results, frames, flown.as_deref(), true)?;
            Ok(state.plans())
        });
        let (features, paths) = plans?.map_err(|error| raise(py, &error))?;
        Ok((features.into_pyarray(py), paths.into_pyarray(py)))
    }

    fn close(&self, py: Python<'_>) -> PyResult<()> {
        self.state.close(py)
    }
}

impl State {
    fn begin(&mut self, seeds: impl Iterator<Item = (usize, u64)>, prior: &Belief) -> Result<()> {
        let seeds: Vec<(usize, u64)> = seeds.collect();
        let Self { crew, threads, .. } = self;
        let begin = |(world, seed)| Ok::<_, anyhow::Error>((world, crew.begun(prior, seed)?));
        let n_worlds = seeds.len();
        let begun = threads.work(is_short(crew, n_worlds), |threads| {
            threads.each(seeds, begin)
        });
        for begun in begun {
            let (world, planned) = begun?;
            let n_worlds = self.worlds.len();
            let place = self.worlds.get_mut(world);
            *place.with_context(|| no_such_world(n_worlds, world))? = Some(planned);
        }
        Ok(())
    }

    /// Updates beliefs with frames, and plans.
    fn update(
        &mut self,
        worlds: &[usize],
        results: &[u8],
        frames: Option<&[u8]>,
        flown: Option<&[usize]>,
        plans: bool,
    ) -> Result<()> {
        let n_cells = self.crew.shape().n_cells();
        ensure!(
            results.len() == worlds.len() * RESULT_BYTES
                && frames.is_none_or(|frames| frames.len() == worlds.len() * n_cells)
                && flown.is_none_or(|flown| flown.len() == worlds.len()),
            "options: expected a result, a frame and an option for each of {} worlds, got others",
            worlds.len()
        );
        let shown = self.shown(worlds.len() * usize::from(plans && frames.is_some()));
        let mut row_of = vec![None; self.worlds.len()];
        for (row, &world) in worlds.iter().enumerate() {
            let place = row_of.get_mut(world);
            *place.with_context(|| no_such_world(self.worlds.len(), world))? = Some(row);
        }
        let Self {
            crew,
            threads,
            worlds: all,
            ..
        } = self;
        let tasks = all.iter_mut().zip(row_of).enumerate();
        let tasks = tasks.filter_map(|(index, (planned, row))| {
            let (planned, row) = (planned.as_mut()?, row?);
            let result = &results[row * RESULT_BYTES..][..RESULT_BYTES];
            let (world, robot) = result.split_at(WORLD_BYTES);
            Some(WorldWork {
                index,
                planned,
                world: bytemuck::pod_read_unaligned(world),
                robot: bytemuck::pod_read_unaligned(robot),
                frame: frames.map(|frames| &frames[row * n_cells..][..n_cells]),
                flown: flown.map(|flown| flown[row]),
                plans,
                is_shown: shown.contains(&row),
            })
        });
        let tasks: Vec<WorldWork<'_>> = tasks.collect();
        let done = threads.work(is_short(crew, tasks.len()), |threads| {
            work_on(crew, tasks, threads)
        });
        let outlooks: Vec<Option<Outlook>> = done.into_iter().collect::<Result<_>>()?;
        self.show(outlooks.into_iter().flatten());
        Ok(())
    }

    /// Features and paths of the last plans of all worlds.
    fn plans(&self) -> (Array3<f32>, Array3<u8>) {
        let dim = (self.worlds.len(), OPTIONS.len());
        let mut features = Array3::zeros((dim.0, dim.1, N_FEATURES));
        let mut paths = Array3::zeros((dim.0, dim.1, self.crew.n_moves()));
        for (world, planned) in self.worlds.iter().enumerate() {
            let proposals = planned.iter().flat_map(Planned::proposals);
            for (option, proposal) in proposals.enumerate() {
                let of_option = s![world, option, ..];
                features
                    .slice_mut(of_option)
                    .assign(&ArrayView1::from(&proposal.features));
                let moves = path_to_bytes(&proposal.plan.moves);
                paths.slice_mut(of_option).assign(&ArrayView1::from(&moves));
            }
        }
        (features, paths)
    }

    /// Selects the worlds to publish now.
    fn shown(&mut self, n_worlds: usize) -> Vec<usize> {
        let begun = self.worlds.iter().flatten().next();
        let (Some(watched), Some(begun)) = (&mut self.watched, begun) else {
            return Vec::new();
        };
        let belief = || begun.agent().belief().probabilities();
        let feed = watched
            .feed
            .get_or_insert_with(|| Feed::open(&watched.instance, belief()));
        if n_worlds == 0 {
            Vec::new()
        } else {
            feed.due(n_worlds)
        }
    }

    fn show(&mut self, outlooks: impl Iterator<Item = Outlook>) {
        let Some(watched) = &mut self.watched else {
            return;
        };
        for outlook in outlooks {
            let world = watched.first_world + outlook.index as u32;
            let view = View {
                world,
                robots: world..world + 1,
                result: &outlook.world,
                belief: outlook.belief.probabilities(),
                intent: outlook.intent,
            };
            if let Some(feed) = &mut watched.feed {
                feed.show(&view);
            }
        }
    }
}

/// Corrects and predicts the beliefs, then plans. Worlds with a refused frame stay unchanged.
fn work_on(
    crew: &Crew,
    mut tasks: Vec<WorldWork<'_>>,
    threads: Threads,
) -> Vec<Result<Option<Outlook>>> {
    let seen = threads.each(&mut tasks, |task| task.see(crew));
    let fits = tasks
        .into_iter()
        .zip(&seen)
        .filter(|(_, seen)| seen.is_ok());
    let mut tasks: Vec<_> = fits.map(|(task, _)| task).collect();
    let new = tasks.iter_mut().filter(|task| task.frame.is_some());
    let new = new.map(|task| &mut *task.planned);
    match threads {
        Threads::Several => Planned::predict_all(new),
        Threads::One => new.for_each(|planned| Planned::predict_all([planned])),
    }
    let planning = tasks.into_iter().filter(|task| task.plans);
    threads.each(planning, |task| task.planned.plan(task.robot.cell()));
    seen
}

impl WorldWork<'_> {
    /// Corrects the belief with the frame, if there is one.
    fn see(&mut self, crew: &Crew) -> Result<Option<Outlook>> {
        let Some(frame) = self.frame else {
            return Ok(None);
        };
        let intent = self.is_shown.then(|| self.planned.intent(self.flown));
        let n_observations = crew.model().n_observations();
        self.planned.see(&Shown {
            frame: Frame::from_bytes(crew.shape(), n_observations, frame)?,
            reward: (self.world.step > 0).then_some(self.robot.reward),
        })?;
        Ok(intent.map(|intent| Outlook {
            index: self.index,
            world: self.world,
            belief: self.planned.agent().belief().clone(),
            intent,
        }))
    }
}

/// Whether the work on some worlds is too short for other threads: one world alone, but for networks, whose own threads
/// must be among the pool's.
fn is_short(crew: &Crew, n_worlds: usize) -> bool {
    n_worlds == 1 && *crew.estimator() != NEURAL
}

/// The model that filters know, or a stand-in where the worlds' model is hidden.
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
            "one for the estimator '{}', or a checkpoint of a learned belief",
            estimator.label
        );
        return Err(invalid(py, "model", expected, got));
    }
    let model = match &spec.description {
        Some(description) => Description::model_of(&description.toml),
        None => spec.airspace.seen(spec.n_observations).unchanging(),
    };
    model.map_err(|error| refused(py, error.to_string()))
}

fn no_such_world(n_worlds: usize, got: usize) -> String {
    format!("options: expected a world below {n_worlds}, got {got}")
}
