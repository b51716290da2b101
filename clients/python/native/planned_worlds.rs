//! Single-robot worlds with their beliefs and the plans of all options.

use crate::answer::RESULT_BYTES;
use crate::origin::is_short;
use crate::threads::{Pool, Threads};
use anyhow::{Context, Result, ensure};
use emberwatch_acting::options::{OptionAgent, OptionSetup, Shown};
use emberwatch_belief::Belief;
use emberwatch_belief::planning::OPTIONS;
use emberwatch_belief::planning::options::N_FEATURES;
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
}

/// The observations of some worlds, one row per world.
#[derive(Clone, Copy)]
pub struct Observed<'a> {
    pub worlds: &'a [usize],
    /// Bytes of `wire.RESULT_DTYPE`.
    pub results: &'a [u8],
    /// The frames, `[n, H, W]`; `None` if the beliefs already include them.
    pub frames: Option<&'a [u8]>,
}

/// A world that is updated: its belief and plans, and its row of [`Observed`].
struct WorldWork<'a> {
    planned: &'a mut OptionAgent,
    world: WorldResult,
    robot: RobotResult,
    frame: Option<&'a [u8]>,
}

impl PlannedWorlds {
    pub fn new(setup: OptionSetup, n_worlds: usize) -> Self {
        Self {
            setup,
            worlds: (0..n_worlds).map(|_| None).collect(),
            threads: Pool::default(),
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

    /// Updates beliefs with frames. If `plans` is set, also plans all options. A world whose belief refuses its frame
    /// stays unchanged.
    ///
    /// # Errors
    /// If the arrays differ in length, a world's number is out of range, or a belief refuses its frame.
    pub fn update(&mut self, observed: Observed<'_>, plans: bool) -> Result<()> {
        let n_cells = self.setup.shape().n_cells();
        observed.check(n_cells)?;
        let rows = self.rows(observed.worlds)?;
        let Self {
            setup,
            threads,
            worlds,
        } = self;
        let works = worlds.iter_mut().zip(rows);
        let works = works
            .filter_map(|(planned, row)| Some(observed.work(planned.as_mut()?, row?, n_cells)));
        let works: Vec<WorldWork<'_>> = works.collect();
        let is_short = is_short(setup.estimator(), works.len());
        threads.work(is_short, |threads| update(setup, works, plans, threads))
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
}

impl<'a> Observed<'a> {
    fn check(&self, n_cells: usize) -> Result<()> {
        let n_worlds = self.worlds.len();
        ensure!(
            self.results.len() == n_worlds * RESULT_BYTES
                && self.frames.is_none_or(|it| it.len() == n_worlds * n_cells),
            "options: expected a result and a frame for each of {n_worlds} worlds, got other lengths"
        );
        Ok(())
    }

    fn work(&self, planned: &'a mut OptionAgent, row: usize, n_cells: usize) -> WorldWork<'a> {
        let result = &self.results[row * RESULT_BYTES..][..RESULT_BYTES];
        let (world, robot) = result.split_at(WORLD_BYTES);
        WorldWork {
            planned,
            world: bytemuck::pod_read_unaligned(world),
            robot: bytemuck::pod_read_unaligned(robot),
            frame: self.frames.map(|it| &it[row * n_cells..][..n_cells]),
        }
    }
}

/// Corrects and predicts the beliefs, then plans.
fn update(
    setup: &OptionSetup,
    mut works: Vec<WorldWork<'_>>,
    plans: bool,
    threads: Threads,
) -> Result<()> {
    let seen = threads.each(&mut works, |work| work.see(setup));
    let fits = works.into_iter().zip(&seen);
    let mut works: Vec<_> = fits
        .filter_map(|(work, seen)| seen.is_ok().then_some(work))
        .collect();
    let new = works.iter_mut().filter(|work| work.frame.is_some());
    let new = new.map(|work| &mut *work.planned);
    match threads {
        Threads::Several => OptionAgent::predict_all(new),
        Threads::One => new.for_each(|planned| OptionAgent::predict_all([planned])),
    }
    if plans {
        threads.each(works, |work| work.planned.plan(work.robot.cell()));
    }
    seen.into_iter().collect()
}

impl WorldWork<'_> {
    /// Corrects the belief with the frame, if there is one.
    fn see(&mut self, setup: &OptionSetup) -> Result<()> {
        let Some(frame) = self.frame else {
            return Ok(());
        };
        let n_observations = setup.model().n_observations();
        self.planned.see(&Shown {
            frame: Frame::from_bytes(setup.shape(), n_observations, frame)?,
            reward: (self.world.step > 0).then_some(self.robot.reward),
        })
    }
}
