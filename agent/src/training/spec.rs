//! What to train on, and why that ended early.

use anyhow::{Context, Result, anyhow, ensure};
use emberwatch_learning::beliefs::BeliefKind;
use emberwatch_learning::checkpoint::{self, Contents};
use emberwatch_learning::config::AgentConfig;
use emberwatch_learning::learned::Learned;
use emberwatch_learning::learners::decisions::{belief_of, belief_of_saved};
use emberwatch_learning::learners::{self, Learner, LearnerKind};
use emberwatch_network::Device;
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::control::ServerInfo;
use emberwatch_protocol::message::Status;
use std::ops::Range;
use std::path::PathBuf;
use std::time::Instant;

/// The checkpoint's name in the folder of a training.
pub const CHECKPOINT: &str = "checkpoint.safetensors";

#[derive(Debug, Clone)]
pub struct TrainingSpec {
    /// The worlds, with all their robots.
    pub worlds: Range<u32>,
    pub takeover: bool,
    /// World steps to act for, of all worlds together; 0: until stopped.
    pub steps: u64,
    /// When to end, with a filter that is learned first too; `None`: until stopped.
    pub deadline: Option<Instant>,
    pub out: PathBuf,
    pub resume: bool,
    pub freeze: bool,
    pub device: Device,
    pub config: AgentConfig,
    /// What was learned before, for decisions on it.
    pub learned: Learned,
}

impl TrainingSpec {
    /// Checks folder and number of worlds, before a server is held or started for them; returns the
    /// contents of the checkpoint to go on from.
    pub fn check(&self) -> Result<Option<Contents>> {
        let place = self.out.join(CHECKPOINT);
        ensure!(
            self.resume || !place.exists(),
            "--out {}: expected --resume or a folder without a checkpoint, got one with it",
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
            kind.checkpoints.contains(&&*got),
            "checkpoint {}: expected a checkpoint of {}, got one of {got}",
            place.display(),
            kind.checkpoints[0]
        );
        Ok(Some(contents))
    }

    /// Whether a checkpoint was trained with settings other than these.
    pub fn has_other_settings(&self, contents: &Contents) -> bool {
        contents
            .settings()
            .map_or(true, |settings| settings != self.config)
    }

    /// What the settings say that learns.
    pub fn learner(&self) -> Result<&'static LearnerKind> {
        learners::named(&self.config.learner).map_err(anyhow::Error::msg)
    }

    /// The belief that decisions are learned on.
    pub fn belief(&self) -> Result<&'static BeliefKind> {
        belief_of(&self.config.decisions.estimator)
    }

    /// The training of the belief that decisions are learned on, in a folder within this one's; `None` if there is nothing
    /// more to learn of it.
    pub fn of_belief(&self) -> Result<Option<Self>> {
        let Some(by) = &self.belief()?.learned_by else {
            return Ok(None);
        };
        let mut belief = self.clone();
        belief.out = self.belief_folder();
        belief.config.learner = by.learner.into();
        belief.resume = self.resume && belief.out.join(CHECKPOINT).exists();
        let kind = belief.learner()?;
        let done = belief.check()?.map(|contents| (kind.done)(&contents));
        let all = match (kind.steps)(&self.config) {
            0 => self.config.decisions.filter_steps,
            steps => steps,
        };
        belief.steps = all.saturating_sub(done.transpose()?.unwrap_or(0));
        Ok((belief.steps > 0).then_some(belief))
    }

    /// Whose belief decisions are to be learned on, if their training was left while that was learned; settings that its
    /// checkpoint decides become those.
    pub fn go_on_with_belief(&mut self) -> Result<Option<&'static BeliefKind>> {
        let place = self.belief_folder().join(CHECKPOINT);
        if self.out.join(CHECKPOINT).exists() || !place.exists() {
            return Ok(None);
        }
        let (_, contents) = checkpoint::read(&place)?;
        let settings = contents.settings();
        let settings = settings.with_context(|| format!("checkpoint {}", place.display()))?;
        let belief = belief_of_saved(&settings.decisions.estimator);
        let belief = belief.with_context(|| format!("checkpoint {}", place.display()))?;
        let Some(by) = &belief.learned_by else {
            return Ok(None);
        };
        let learner = learners::named(by.learner).map_err(anyhow::Error::msg)?;
        (learner.adopt)(&contents, &mut self.config);
        Ok(Some(belief))
    }

    /// Where [`Self::of_belief`] leaves its checkpoint.
    pub fn belief_folder(&self) -> PathBuf {
        self.out.join("belief")
    }

    /// The numbers of the robots on a server.
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
        let (first, end) = ends.context("--world: expected a world that the server has")?;
        Ok(first..end)
    }

    /// The error for a learner that cannot go on; what it learned is saved when training ends.
    pub(super) fn stopped(&self, problem: anyhow::Error, learner: &dyn Learner) -> anyhow::Error {
        if problem.is::<ConnectionError>() {
            return problem;
        }
        anyhow!(
            "after {} world steps: {problem:#}; what was learned before is in {}",
            learner.world_steps(),
            self.out.join(CHECKPOINT).display()
        )
    }
}
