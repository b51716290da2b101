//! What to train on, and why that ended early.

use anyhow::{Context, Result, anyhow, bail, ensure};
use emberwatch_learning::checkpoint::{self, Contents};
use emberwatch_learning::config::{AgentConfig, LearnerKind};
use emberwatch_learning::learned::Learned;
use emberwatch_learning::learners::filter::SavedFilter;
use emberwatch_learning::learners::filter::fit;
use emberwatch_learning::learners::neural::{self, SavedNeural};
use emberwatch_learning::learners::{Learner, decisions, network};
use emberwatch_learning::policy::EstimatorKind;
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
        let n_worlds = self.worlds.len();
        let kind = match self.config.learner {
            LearnerKind::Filter => fit::KIND,
            LearnerKind::OwnFilter => fit::OWN_KIND,
            LearnerKind::Neural => neural::KIND,
            LearnerKind::Autoencoder if n_worlds != 1 => {
                bail!(
                    "--worlds: expected 1 for the autoencoder, which follows one world, got {n_worlds}"
                )
            }
            LearnerKind::Autoencoder => network::KIND,
            LearnerKind::Decisions => decisions::KIND,
        };
        if !self.resume {
            return Ok(None);
        }
        let (_, contents) = checkpoint::read(&place, &[kind])?;
        Ok(Some(contents))
    }

    /// The training of the belief that decisions are learned on, in a folder within this one's; `None` if there is nothing
    /// more to learn of it.
    pub fn of_belief(&self) -> Result<Option<Self>> {
        let estimator = self.config.decisions.estimator;
        let mut belief = self.clone();
        belief.out = self.belief_folder();
        belief.config.learner = match estimator {
            EstimatorKind::Neural => LearnerKind::Neural,
            _ if estimator.sees_own_state() => LearnerKind::OwnFilter,
            _ => LearnerKind::Filter,
        };
        belief.resume = self.resume && belief.out.join(CHECKPOINT).exists();
        let contents = belief.check()?;
        let learned = contents.map(|contents| match belief.config.learner {
            LearnerKind::Neural => Ok(contents.state::<SavedNeural>()?.world_steps),
            _ => Ok::<_, anyhow::Error>(contents.state::<SavedFilter>()?.fit.world_steps),
        });
        let all = match belief.config.learner {
            LearnerKind::Neural => self.config.neural.steps,
            _ => self.config.decisions.filter_steps,
        };
        belief.steps = all.saturating_sub(learned.transpose()?.unwrap_or(0));
        Ok((belief.steps > 0).then_some(belief))
    }

    /// Whose belief decisions are to be learned on, if their training was left while that was learned.
    pub fn estimator_of_belief(&self) -> Result<Option<EstimatorKind>> {
        let place = self.belief_folder().join(CHECKPOINT);
        if self.out.join(CHECKPOINT).exists() || !place.exists() {
            return Ok(None);
        }
        let (_, contents) = checkpoint::read(&place, &[fit::KIND, fit::OWN_KIND, neural::KIND])?;
        let settings = contents.settings();
        let settings = settings.with_context(|| format!("checkpoint {}", place.display()))?;
        let estimator = settings.decisions.estimator;
        Ok(estimator.is_learned().then_some(estimator))
    }

    /// Where [`Self::of_belief`] leaves its checkpoint.
    pub fn belief_folder(&self) -> PathBuf {
        self.out.join("belief")
    }

    /// The numbers of the robots on a server.
    pub(super) fn robots(&self, info: &ServerInfo) -> Result<Range<u32>> {
        let team = info.n_robots;
        if self.config.learner == LearnerKind::Autoencoder {
            ensure!(
                team == 1,
                "the autoencoder follows one robot: expected a server with --robots 1, got {team}"
            );
        }
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
