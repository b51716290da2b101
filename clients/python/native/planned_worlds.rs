//! Single-robot worlds with their beliefs and the plans of all options.
//!
//! Arrays have one row per world; `chosen` marks the rows that a call is about. `results` are bytes of
//! `wire.RESULT_DTYPE`, `frames` have the shape `[n_worlds, H, W]`.

use crate::answer::RESULT_BYTES;
use crate::origin::is_short;
use crate::threads::{Pool, Threads};
use anyhow::Result;
use emberwatch_acting::options::{OptionAgent, OptionSetup, Shown};
use emberwatch_belief::Belief;
use emberwatch_belief::planning::OPTIONS;
use emberwatch_belief::planning::options::N_FEATURES;
use emberwatch_messages::message::{RobotResult, WorldResult};
use emberwatch_messages::payload::WORLD_BYTES;
use emberwatch_model::Frame;
use emberwatch_model::path::path_to_bytes;
use numpy::ndarray::{Array3, ArrayView1, s};

pub struct PlannedWorlds {
    pub setup: OptionSetup,
    worlds: Vec<Option<OptionAgent>>,
    threads: Pool,
}

type Seen<'a> = (&'a mut OptionAgent, &'a [u8], &'a [u8]);

impl PlannedWorlds {
    pub fn new(setup: OptionSetup, n_worlds: usize) -> Self {
        Self {
            setup,
            worlds: (0..n_worlds).map(|_| None).collect(),
            threads: Pool::default(),
        }
    }

    pub fn world(&mut self, world: usize) -> Option<&mut OptionAgent> {
        self.worlds.get_mut(world)?.as_mut()
    }

    /// Begins episodes with a first belief: either in all chosen worlds, or in none.
    pub fn start_episodes(
        &mut self,
        chosen: &[bool],
        results: &[u8],
        prior: &Belief,
    ) -> Result<()> {
        let rows = results.chunks_exact(RESULT_BYTES).zip(chosen).enumerate();
        let rows = rows.filter(|(_, (_, chosen))| **chosen);
        let seeds = rows.map(|(world, (result, _))| (world, parsed(result).0.seed));
        let seeds: Vec<(usize, u64)> = seeds.collect();
        let Self { setup, threads, .. } = self;
        let is_short = is_short(setup.estimator(), seeds.len());
        let begin = |(world, seed)| anyhow::Ok((world, setup.begun(prior, seed)?));
        let begun = threads.work(is_short, |threads| threads.each(seeds, begin));
        for (world, planned) in begun.into_iter().collect::<Result<Vec<_>>>()? {
            self.worlds[world] = Some(planned);
        }
        Ok(())
    }

    /// Updates the beliefs about the chosen worlds with a step. A world whose belief refuses its frame stays unchanged.
    pub fn update(&mut self, chosen: &[bool], results: &[u8], frames: &[u8]) -> Result<()> {
        let frames = frames.chunks_exact(self.setup.shape().n_cells());
        let rows = results.chunks_exact(RESULT_BYTES).zip(frames).zip(chosen);
        let seen = self.worlds.iter_mut().zip(rows);
        let seen = seen.filter_map(|(planned, ((result, frame), &chosen))| {
            Some((planned.as_mut().filter(|_| chosen)?, result, frame))
        });
        let seen: Vec<Seen<'_>> = seen.collect();
        let is_short = is_short(self.setup.estimator(), seen.len());
        let setup = &self.setup;
        self.threads
            .work(is_short, |threads| update(setup, seen, threads))
    }

    /// `result` and `frame` are of an earlier step.
    pub fn recall(&mut self, world: usize, result: &[u8], frame: &[u8]) -> Result<()> {
        let Some(planned) = self.worlds.get_mut(world).and_then(Option::as_mut) else {
            return Ok(());
        };
        let (setup, seen) = (&self.setup, vec![(planned, result, frame)]);
        let is_short = is_short(setup.estimator(), 1);
        self.threads
            .work(is_short, |threads| update(setup, seen, threads))
    }

    /// Plans in the chosen worlds. Returns the last plans of all worlds: features `[n_worlds, options, features]` and
    /// paths `[n_worlds, options, T]`.
    pub fn plan(&mut self, chosen: &[bool], results: &[u8]) -> (Array3<f32>, Array3<u8>) {
        let rows = results.chunks_exact(RESULT_BYTES).zip(chosen);
        let planning = self.worlds.iter_mut().zip(rows);
        let planning = planning.filter_map(|(planned, (result, &chosen))| {
            Some((
                planned.as_mut().filter(|_| chosen)?,
                parsed(result).1.cell(),
            ))
        });
        let planning: Vec<_> = planning.collect();
        let is_short = is_short(self.setup.estimator(), planning.len());
        self.threads.work(is_short, |threads| {
            threads.each(planning, |(planned, robot)| planned.plan(robot))
        });
        self.plans()
    }

    fn plans(&self) -> (Array3<f32>, Array3<u8>) {
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

fn update(setup: &OptionSetup, mut seen: Vec<Seen<'_>>, threads: Threads) -> Result<()> {
    let corrected = threads.each(&mut seen, |(planned, result, frame)| {
        let (world, robot) = parsed(result);
        planned.see(&Shown {
            frame: Frame::from_bytes(setup.shape(), setup.model().n_observations(), frame)?,
            reward: (world.step > 0).then_some(robot.reward),
        })
    });
    let fits = seen.into_iter().zip(&corrected);
    let fits = fits.filter_map(|((planned, ..), it)| it.is_ok().then_some(planned));
    match threads {
        Threads::Several => OptionAgent::predict_all(fits),
        Threads::One => fits.for_each(|planned| OptionAgent::predict_all([planned])),
    }
    corrected.into_iter().collect()
}

fn parsed(result: &[u8]) -> (WorldResult, RobotResult) {
    let (world, robot) = result.split_at(WORLD_BYTES);
    (
        bytemuck::pod_read_unaligned(world),
        bytemuck::pod_read_unaligned(robot),
    )
}
