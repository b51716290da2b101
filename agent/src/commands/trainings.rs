//! Trainings for the policies of a suite: finds their checkpoints, and runs missing trainings.
//!
//! `FOLDER/TASK` contains a folder for each training: `filter`, `neural` and `autoencoder` for beliefs, and
//! `decisions-BELIEF` for decisions on a belief.

use super::shared::make_folder;
use super::train::{N_WORLDS, learn, start_server};
use crate::training::{CHECKPOINT, TrainingSpec, seconds};
use anyhow::{Context, Result, bail, ensure};
use emberwatch_learning::beliefs::WorldForm;
use emberwatch_learning::config::AgentConfig;
use emberwatch_learning::learned::Learned;
use emberwatch_learning::learners;
use emberwatch_learning::learners::decisions::DECISIONS;
use emberwatch_learning::learners::filter::FILTER;
use emberwatch_learning::policy::Policy;
use emberwatch_learning::rollout::building;
use emberwatch_network::Device;
use emberwatch_protocol::task::{FIRST_TRAINING_SEED, Task};
use std::fs::rename;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// The trainings of a policy on a task.
pub struct Trainings<'a> {
    /// The task's folder.
    pub folder: PathBuf,
    pub task: &'a Task,
    pub policy: &'a Policy,
}

/// What a policy's trainings produced: its checkpoints and their training time.
pub struct Trained {
    pub learned: Learned,
    /// Processor seconds of the trainings; `None` if one of them has no record.
    pub seconds: Option<f64>,
}

impl Trainings<'_> {
    /// Reads the checkpoints.
    ///
    /// # Errors
    /// If a checkpoint is missing or cannot be used, or if decisions were not learned on the belief next to them.
    pub fn read(&self, world: &WorldForm) -> Result<Trained> {
        let folders: Vec<PathBuf> = self.folders().map(|(_, folder)| folder).collect();
        let seconds = folders.iter().map(|folder| seconds::read(folder));
        let seconds = seconds.collect::<Result<Vec<_>>>()?;
        let learned = read(folders.iter())?;
        building::check(self.policy, &learned, world)?;
        let seconds = seconds.into_iter().sum();
        Ok(Trained { learned, seconds })
    }

    /// Runs the trainings that have no checkpoint. `steps`: world steps of each, summed over its worlds; `None`: the
    /// number in the settings.
    ///
    /// # Errors
    /// If a learner cannot learn in the task's worlds.
    pub fn complete(
        &self,
        config: &AgentConfig,
        steps: Option<u64>,
        server: &Option<PathBuf>,
    ) -> Result<()> {
        let folders: Vec<(&str, PathBuf)> = self.folders().collect();
        for (index, (learner, folder)) in folders.iter().enumerate() {
            if folder.join(CHECKPOINT).exists() {
                continue;
            }
            // Decisions are of no use with another belief than theirs.
            let mut later = folders[index..].iter().map(|(_, folder)| folder);
            if let Some(other) = later.find(|folder| folder.exists()) {
                let (other, folder) = (other.display(), folder.display());
                bail!("{other} is in the way of the training for {folder}: remove it");
            }
            let (task, policy) = (&self.task.name, &self.policy.name);
            tracing::info!("task {task}: training {learner} for {policy}");
            let before = folders[..index].iter().map(|(_, folder)| folder);
            let spec = self.spec(learner, config, steps, read(before)?)?;
            let trained = self.train(spec, folder, server.clone());
            trained.with_context(|| format!("train --learner {learner}"))?;
        }
        Ok(())
    }

    /// Returns learner and folder of each training, the belief first.
    fn folders(&self) -> impl Iterator<Item = (&'static str, PathBuf)> {
        let belief = self.policy.belief;
        let by = belief.learned_by.as_ref();
        let by = by.map(|by| (by.learner, self.folder.join(by.learner)));
        let decisions = format!("{}-{}", DECISIONS.name, belief.label);
        let decisions = (DECISIONS.name, self.folder.join(decisions));
        let decisions = self.policy.chooses_options().then_some(decisions);
        by.into_iter().chain(decisions)
    }

    fn spec(
        &self,
        learner: &str,
        config: &AgentConfig,
        steps: Option<u64>,
        learned: Learned,
    ) -> Result<TrainingSpec> {
        let mut config = config.clone();
        config.learner = learner.into();
        if learner == DECISIONS.name {
            config.decisions.estimator = self.policy.belief.label.into();
        }
        let kind = learners::named(learner).map_err(anyhow::Error::msg)?;
        let steps = steps.unwrap_or(match (kind.steps)(&config) {
            0 if *kind == FILTER => config.decisions.filter_steps,
            steps => steps,
        });
        ensure!(
            steps > 0,
            "--train-steps: expected a number of steps, as the {learner} has no default length"
        );
        Ok(TrainingSpec {
            worlds: 0..if kind.is_single { 1 } else { N_WORLDS },
            takeover: false,
            steps,
            deadline: None,
            resume: false,
            out: self.folder.join(format!("training.{}", std::process::id())),
            freeze: false,
            device: Device::Cpu,
            config,
            learned,
        })
    }

    /// Trains in a temporary folder, and renames it when the training is complete.
    fn train(&self, spec: TrainingSpec, folder: &Path, server: Option<PathBuf>) -> Result<()> {
        make_folder(&spec.out)?;
        let worlds = spec.worlds.len().to_string();
        let (task, seed) = (&self.task.source, FIRST_TRAINING_SEED.to_string());
        let flags = ["--task", task, "--worlds", &worlds, "--seed", &seed];
        let server = start_server(server, flags.map(String::from).into(), &spec)?;
        learn(server.instance(), &spec, None, &AtomicBool::new(false))?;
        rename(&spec.out, folder).with_context(|| format!("rename to {}", folder.display()))
    }
}

fn read<'a>(folders: impl Iterator<Item = &'a PathBuf>) -> Result<Learned> {
    let places: Vec<PathBuf> = folders.map(|it| it.join(CHECKPOINT)).collect();
    learners::read(places.iter().map(PathBuf::as_path), &Device::Cpu)
}
