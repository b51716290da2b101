//! The specification of a training, and the error of a training that ended early.

use anyhow::{Context, Result, anyhow, ensure};
use emberwatch_acting::beliefs::BeliefKind;
use emberwatch_acting::config::AgentConfig;
use emberwatch_acting::learned::Learned;
use emberwatch_learning::checkpoint::{self, Contents};
use emberwatch_learning::learners::decisions::belief_of;
use emberwatch_learning::learners::{self, Learner, LearnerKind};
use emberwatch_network::Device;
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::control::ServerInfo;
use emberwatch_protocol::message::Status;
use std::ops::Range;
use std::path::PathBuf;

/// Name of the checkpoint in the folder of a training.
pub const CHECKPOINT: &str = "checkpoint.safetensors";

#[derive(Clone)]
pub struct TrainingSpec {
    /// Worlds to train on, with all their robots.
    pub worlds: Range<u32>,
    pub takeover: bool,
    /// World steps to act, summed over all worlds; 0: until stopped.
    pub steps: u64,
    pub out: PathBuf,
    pub resume: bool,
    /// Seed of the first world; world i begins with this seed plus i. `None`: running episodes continue.
    pub first_seed: Option<u64>,
    pub device: Device,
    pub config: AgentConfig,
    /// Beliefs from earlier trainings, for decisions that are based on them.
    pub learned: Learned,
}

impl TrainingSpec {
    /// Checks folder and number of worlds before anything is opened. Returns the checkpoint to resume.
    pub fn check(&self) -> Result<Option<Contents>> {
        let place = self.out.join(CHECKPOINT);
        ensure!(
            self.resume || !place.exists(),
            "--out {}: expected a folder without a checkpoint, got one with it: add --resume, or choose another",
            self.out.display()
        );
        let (kind, n_worlds) = (self.learner()?, self.worlds.len());
        ensure!(
            n_worlds == 1 || !kind.is_single,
            "--worlds: expected 1 for the {}, which follows one world, got {n_worlds}",
            kind.name
        );
        if !self.resume {
            return Ok(None);
        }
        let (got, contents) = checkpoint::read(&place)?;
        ensure!(
            kind.checkpoint == got,
            "checkpoint {}: expected a checkpoint of {}, got one of {got}",
            place.display(),
            kind.checkpoint
        );
        Ok(Some(contents))
    }

    /// Returns the learner that the settings name.
    pub fn learner(&self) -> Result<&'static LearnerKind> {
        learners::named(&self.config.learner).map_err(anyhow::Error::msg)
    }

    /// Returns the belief that the learner builds on, if any.
    pub fn base(&self) -> Result<Option<&'static BeliefKind>> {
        (self.learner()?.base)(&self.config)
    }

    /// Returns the training of the belief that the learner needs first, in a subfolder, unless it is complete.
    pub fn belief_training(&self) -> Result<Option<Self>> {
        let by = self.base()?.and_then(|base| base.learned_by.as_ref());
        let Some(by) = by else { return Ok(None) };
        let mut belief = self.clone();
        belief.out = self.belief_folder();
        belief.config.learner = by.learner.into();
        belief.resume = self.resume && belief.out.join(CHECKPOINT).exists();
        let kind = belief.learner()?;
        let done = belief.check()?.map(|contents| (kind.done)(&contents));
        let all = kind.full_steps(&self.config);
        belief.steps = all.saturating_sub(done.transpose()?.unwrap_or(0));
        Ok((belief.steps > 0).then_some(belief))
    }

    /// If the training was interrupted while its belief was trained, adopts the settings that the belief's checkpoint
    /// determines, and returns the number of world steps done.
    pub fn adopt_belief(&mut self) -> Result<Option<u64>> {
        let place = self.belief_folder().join(CHECKPOINT);
        if !self.learner()?.needs_base || self.out.join(CHECKPOINT).exists() || !place.exists() {
            return Ok(None);
        }
        let (_, contents) = checkpoint::read(&place)?;
        let settings = contents.settings();
        let settings = settings.with_context(|| format!("checkpoint {}", place.display()))?;
        let belief = belief_of(&settings.decisions.estimator);
        let belief = belief.with_context(|| format!("checkpoint {}", place.display()))?;
        let Some(by) = &belief.learned_by else {
            return Ok(None);
        };
        let learner = learners::named(by.learner).map_err(anyhow::Error::msg)?;
        (learner.adopt)(&contents, &mut self.config)?;
        self.config.decisions.estimator = belief.name.into();
        (learner.done)(&contents).map(Some)
    }

    /// Returns the folder of [`Self::belief_training`].
    pub fn belief_folder(&self) -> PathBuf {
        self.out.join("belief")
    }

    pub(super) fn robots(&self, info: &ServerInfo) -> Result<Range<u32>> {
        let team = info.n_robots;
        let kind = self.learner()?;
        ensure!(
            team == 1 || !kind.is_single,
            "the {} follows one robot: expected a server with --robots 1, got {team}",
            kind.name
        );
        let n_worlds = info.n_worlds;
        ensure!(
            self.worlds.end <= n_worlds,
            "{}",
            Status::NoSuchWorld.explain(n_worlds.into())
        );
        let number = |world: u32| world.checked_mul(team);
        let ends = number(self.worlds.start).zip(number(self.worlds.end));
        let (first, end) = ends.context("--world: expected a world of the server")?;
        Ok(first..end)
    }

    /// Returns the error for a learner that cannot continue. It names the checkpoint that the training writes.
    pub(super) fn stopped(&self, problem: anyhow::Error, learner: &dyn Learner) -> anyhow::Error {
        if problem.is::<ConnectionError>() {
            return problem;
        }
        anyhow!(
            "after {} world steps: {problem:#}; the last checkpoint, if there is one, is {}",
            learner.world_steps(),
            self.out.join(CHECKPOINT).display()
        )
    }
}
