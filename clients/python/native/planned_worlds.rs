//! Single-robot worlds with their beliefs and plans: belief updates, planning, and publishing to observers.

use crate::answer::RESULT_BYTES;
use crate::origin::is_short;
use crate::threads::{Pool, Threads};
use crate::wire::{Feed, View};
use anyhow::{Context, Result, ensure};
use emberwatch_acting::options::{OptionAgent, OptionSetup, Shown};
use emberwatch_belief::Belief;
use emberwatch_belief::planning::OPTIONS;
use emberwatch_belief::planning::options::N_FEATURES;
use emberwatch_messages::agent_belief::Intent;
use emberwatch_messages::instance::Instance;
use emberwatch_messages::message::{RobotResult, WorldResult};
use emberwatch_messages::payload::WORLD_BYTES;
use emberwatch_model::Frame;
use emberwatch_model::path::path_to_bytes;
use numpy::ndarray::{Array3, ArrayView1, s};

/// Beliefs and plans of many worlds.
pub struct PlannedWorlds {
    pub setup: OptionSetup,
    /// `None` before a world's first episode.
    worlds: Vec<Option<OptionAgent>>,
    threads: Pool,
    watched: Option<Watched>,
}

/// The channel on which beliefs are published to observers.
pub struct Watched {
    pub instance: Instance,
    /// The instance's number of the first of these worlds.
    pub first_world: u32,
    /// `None` until the first frame, which opens the channel.
    pub feed: Option<Feed>,
}

/// The observations of some worlds, one row per world.
#[derive(Clone, Copy)]
pub struct Observed<'a> {
    pub worlds: &'a [usize],
    /// Bytes of `wire.RESULT_DTYPE`.
    pub results: &'a [u8],
    /// The frames, `[n, H, W]`; `None` if the beliefs already include them.
    pub frames: Option<&'a [u8]>,
    /// The option that each robot has just flown.
    pub flown: Option<&'a [usize]>,
}

/// A row of [`Observed`].
struct Row<'a> {
    world: WorldResult,
    robot: RobotResult,
    frame: Option<&'a [u8]>,
    flown: Option<usize>,
}

/// The work on one world: its observation, and whether to plan and to publish.
struct WorldWork<'a> {
    index: usize,
    planned: &'a mut OptionAgent,
    observed: Row<'a>,
    plans: bool,
    is_shown: bool,
}

/// The data to publish about a world: its belief after the frame, and the plan.
struct Outlook {
    index: usize,
    world: WorldResult,
    belief: Belief,
    intent: Intent,
}

impl PlannedWorlds {
    pub fn new(setup: OptionSetup, n_worlds: usize, watched: Option<Watched>) -> Self {
        Self {
            setup,
            worlds: (0..n_worlds).map(|_| None).collect(),
            threads: Pool::default(),
            watched,
        }
    }

    /// Returns the world with this number, if an episode has begun there.
    pub fn world(&mut self, world: usize) -> Option<&mut OptionAgent> {
        self.worlds.get_mut(world)?.as_mut()
    }

    /// Begins episodes with a first belief. `seeds` lists pairs of a world and its seed.
    ///
    /// # Errors
    /// If a world's number is out of range, or if a belief cannot be built.
    pub fn start_episodes(
        &mut self,
        seeds: impl Iterator<Item = (usize, u64)>,
        prior: &Belief,
    ) -> Result<()> {
        let seeds: Vec<(usize, u64)> = seeds.collect();
        let worlds: Vec<usize> = seeds.iter().map(|&(world, _)| world).collect();
        self.rows(&worlds)?;
        let Self { setup, threads, .. } = self;
        let begin = |(world, seed)| Ok::<_, anyhow::Error>((world, setup.begun(prior, seed)?));
        let n_worlds = seeds.len();
        let begun = threads.work(is_short(setup.estimator(), n_worlds), |threads| {
            threads.each(seeds, begin)
        });
        // Either all episodes begin, or none.
        for (world, planned) in begun.into_iter().collect::<Result<Vec<_>>>()? {
            self.worlds[world] = Some(planned);
        }
        Ok(())
    }

    /// Updates beliefs with frames. If `plans` is set, also plans all options.
    ///
    /// # Errors
    /// If the arrays differ in length, a world's number is out of range, or a belief refuses its frame.
    pub fn update(&mut self, observed: Observed<'_>, plans: bool) -> Result<()> {
        let n_cells = self.setup.shape().n_cells();
        observed.check(n_cells)?;
        let is_new = plans && observed.frames.is_some();
        let shown = self.shown(observed.worlds.len() * usize::from(is_new));
        let rows = self.rows(observed.worlds)?;
        let Self {
            setup,
            threads,
            worlds,
            ..
        } = self;
        let tasks = worlds.iter_mut().zip(rows).enumerate();
        let tasks = tasks.filter_map(|(index, (planned, row))| {
            let (planned, row) = (planned.as_mut()?, row?);
            Some(WorldWork {
                index,
                planned,
                observed: observed.row(row, n_cells),
                plans,
                is_shown: shown.contains(&row),
            })
        });
        let tasks: Vec<WorldWork<'_>> = tasks.collect();
        let done = threads.work(is_short(setup.estimator(), tasks.len()), |threads| {
            work_on(setup, tasks, threads)
        });
        let outlooks: Vec<Option<Outlook>> = done.into_iter().collect::<Result<_>>()?;
        self.show(outlooks.into_iter().flatten());
        Ok(())
    }

    /// Returns, for each world here, its index in `worlds`; `None` if it is not listed there.
    fn rows(&self, worlds: &[usize]) -> Result<Vec<Option<usize>>> {
        let mut rows = vec![None; self.worlds.len()];
        for (row, &world) in worlds.iter().enumerate() {
            let (place, n_worlds) = (rows.get_mut(world), self.worlds.len());
            *place.with_context(|| {
                format!("options: expected a world below {n_worlds}, got {world}")
            })? = Some(row);
        }
        Ok(rows)
    }

    /// Returns features `[n_worlds, options, features]` and paths `[n_worlds, options, T]` of the last plans of all
    /// worlds.
    pub fn plans(&self) -> (Array3<f32>, Array3<u8>) {
        let dim = (self.worlds.len(), OPTIONS.len());
        let mut features = Array3::zeros((dim.0, dim.1, N_FEATURES));
        let mut paths = Array3::zeros((dim.0, dim.1, self.setup.n_moves()));
        for (world, planned) in self.worlds.iter().enumerate() {
            let proposals = planned.iter().flat_map(OptionAgent::proposals);
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

    /// Returns which of the rows 0 to `n_worlds - 1` to publish now. The first call opens the channel.
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

impl<'a> Observed<'a> {
    fn check(&self, n_cells: usize) -> Result<()> {
        let n_worlds = self.worlds.len();
        ensure!(
            self.results.len() == n_worlds * RESULT_BYTES
                && self.frames.is_none_or(|it| it.len() == n_worlds * n_cells)
                && self.flown.is_none_or(|it| it.len() == n_worlds),
            "options: expected a result, a frame and an option for each of {n_worlds} worlds, got other lengths"
        );
        Ok(())
    }

    fn row(&self, row: usize, n_cells: usize) -> Row<'a> {
        let result = &self.results[row * RESULT_BYTES..][..RESULT_BYTES];
        let (world, robot) = result.split_at(WORLD_BYTES);
        Row {
            world: bytemuck::pod_read_unaligned(world),
            robot: bytemuck::pod_read_unaligned(robot),
            frame: self.frames.map(|it| &it[row * n_cells..][..n_cells]),
            flown: self.flown.map(|it| it[row]),
        }
    }
}

/// Corrects and predicts the beliefs, then plans. Worlds with a refused frame stay unchanged.
fn work_on(
    setup: &OptionSetup,
    mut tasks: Vec<WorldWork<'_>>,
    threads: Threads,
) -> Vec<Result<Option<Outlook>>> {
    let seen = threads.each(&mut tasks, |task| task.see(setup));
    let fits = tasks
        .into_iter()
        .zip(&seen)
        .filter(|(_, seen)| seen.is_ok());
    let mut tasks: Vec<_> = fits.map(|(task, _)| task).collect();
    let new = tasks
        .iter_mut()
        .filter(|task| task.observed.frame.is_some());
    let new = new.map(|task| &mut *task.planned);
    match threads {
        Threads::Several => OptionAgent::predict_all(new),
        Threads::One => new.for_each(|planned| OptionAgent::predict_all([planned])),
    }
    let planning = tasks.into_iter().filter(|task| task.plans);
    threads.each(planning, |task| {
        task.planned.plan(task.observed.robot.cell())
    });
    seen
}

impl WorldWork<'_> {
    /// Corrects the belief with the frame, if there is one.
    fn see(&mut self, setup: &OptionSetup) -> Result<Option<Outlook>> {
        let Some(frame) = self.observed.frame else {
            return Ok(None);
        };
        let intent = self
            .is_shown
            .then(|| self.planned.intent(self.observed.flown));
        let n_observations = setup.model().n_observations();
        self.planned.see(&Shown {
            frame: Frame::from_bytes(setup.shape(), n_observations, frame)?,
            reward: (self.observed.world.step > 0).then_some(self.observed.robot.reward),
        })?;
        Ok(intent.map(|intent| Outlook {
            index: self.index,
            world: self.observed.world,
            belief: self.planned.agent().belief().clone(),
            intent,
        }))
    }
}
