//! Trainings for the policies of a suite: finds their checkpoints, and runs missing trainings.
//!
//! `FOLDER/TASK` contains a folder for each training: `filter`, `neural` and `autoencoder` for beliefs, and
//! `decisions-BELIEF` for decisions on a belief.

use super::shared::make_folder;
use super::train::{learn, simulate};
use crate::training::{CHECKPOINT, TrainingSpec, seconds};
use anyhow::{Context, Result, bail, ensure};
use emberwatch_acting::beliefs::WorldForm;
use emberwatch_acting::config::AgentConfig;
use emberwatch_acting::learned::Learned;
use emberwatch_acting::policy::Policy;
use emberwatch_acting::rollout::building;
use emberwatch_learning::learners;
use emberwatch_learning::learners::decisions::DECISIONS;
use emberwatch_network::Device;
use emberwatch_protocol::task::FIRST_TRAINING_SEED;
use emberwatch_sim::config::Checked;
use std::fs::rename;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// The trainings of a policy on a task.
pub struct Trainings<'a> {
    /// The task's folder.
    pub folder: PathBuf,
    /// Settings of the task's worlds.
    pub settings: &'a Checked,
    pub policy: &'a Policy,
    pub config: &'a AgentConfig,
    /// World steps of each training, summed over its worlds; `None`: the number in the settings.
    pub steps: Option<u64>,
}

/// What a policy's trainings produced: its checkpoints and their training time.
pub struct Trained {
    pub learned: Learned,
    /// Processor seconds of the trainings; `None` if one of them has no record.
    pub seconds: Option<f64>,
}

impl Trainings<'_> {
    /// Reads the checkpoints. If `trains`, first runs the trainings that have none.
    ///
    /// # Errors
    /// If a checkpoint is missing or cannot be used, if decisions were not learned on the belief next to them, or if a
    /// learner cannot learn in the task's worlds.
    pub fn complete(&self, trains: bool, world: &WorldForm) -> Result<Trained> {
        let (mut folders, mut seconds) = (Vec::new(), Some(0.0));
        let all: Vec<(&str, PathBuf)> = self.folders().collect();
        for (index, (learner, folder)) in all.iter().enumerate() {
            if trains && !folder.join(CHECKPOINT).exists() {
                // Decisions are of no use with another belief than theirs.
                let mut later = all[index..].iter().map(|(_, folder)| folder);
                if let Some(other) = later.find(|folder| folder.exists()) {
                    let (other, folder) = (other.display(), folder.display());
                    bail!("{other} is in the way of the training for {folder}: remove it");
                }
                let policy = &self.policy.name;
                tracing::info!("training {learner} for {policy}");
                let trained = self.train(learner, read(&folders)?, folder);
                trained.with_context(|| format!("train --learner {learner}"))?;
            }
            let own = seconds::read(folder)?;
            seconds = seconds.zip(own).map(|(sum, own)| sum + own);
            folders.push(folder.clone());
        }
        let learned = read(&folders)?;
        building::check(self.policy, &learned, world)?;
        Ok(Trained { learned, seconds })
    }

    fn folders(&self) -> impl Iterator<Item = (&'static str, PathBuf)> {
        let belief = self.policy.belief;
        let by = belief.learned_by.as_ref();
        let by = by.map(|by| (by.learner, self.folder.join(by.learner)));
        let decisions = format!("{}-{}", DECISIONS.name, belief.name);
        let decisions = (DECISIONS.name, self.folder.join(decisions));
        let decisions = self.policy.chooses_options().then_some(decisions);
        by.into_iter().chain(decisions)
    }

    /// Trains in a temporary folder, and renames it when the training is complete.
    fn train(&self, learner: &str, learned: Learned, folder: &Path) -> Result<()> {
        let mut config = self.config.clone();
        config.learner = learner.into();
        if learner == DECISIONS.name {
            config.decisions.estimator = self.policy.belief.name.into();
        }
        let kind = learners::named(learner).map_err(anyhow::Error::msg)?;
        let steps = self.steps.unwrap_or(kind.full_steps(&config));
        ensure!(
            steps > 0,
            "--train-steps: expected a number of steps, as the {learner} has no default length"
        );
        let spec = TrainingSpec {
            worlds: 0..kind.n_worlds(),
            takeover: false,
            steps,
            resume: false,
            first_seed: None,
            out: self.folder.join(format!("training.{}", std::process::id())),
            device: Device::Cpu,
            config,
            learned,
        };
        let mut settings = self.settings.clone();
        settings.config.seed = FIRST_TRAINING_SEED;
        let mut worlds = simulate(settings, &spec)?;
        make_folder(&spec.out)?;
        learn(&mut worlds, &spec, None, &AtomicBool::new(false))?;
        rename(&spec.out, folder).with_context(|| format!("rename to {}", folder.display()))
    }
}

fn read(folders: &[PathBuf]) -> Result<Learned> {
    let places: Vec<PathBuf> = folders.iter().map(|it| it.join(CHECKPOINT)).collect();
    learners::read(places.iter().map(PathBuf::as_path), &Device::Cpu)
}
