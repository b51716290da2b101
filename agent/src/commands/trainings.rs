//! What policies of a suite learn of each task: where it is, and the trainings that are missing.
//!
//! `FOLDER/TASK` has a folder for each training: `filter`, `neural` and `autoencoder` for beliefs,
//! `decisions-BELIEF` for decisions on a belief. What `train --out FOLDER/TASK` left there itself counts, too.

use super::train::{N_WORLDS, learn, start_server};
use crate::training::{CHECKPOINT, TrainingSpec, seconds};
use anyhow::{Context, Result, ensure};
use emberwatch_learning::beliefs::WorldForm;
use emberwatch_learning::config::AgentConfig;
use emberwatch_learning::learned::Learned;
use emberwatch_learning::learners;
use emberwatch_learning::learners::decisions::DECISIONS;
use emberwatch_learning::learners::filter::FILTER;
use emberwatch_learning::policy::Policy;
use emberwatch_learning::rollout::building;
use emberwatch_network::Device;
use emberwatch_protocol::program::stop_on_signals;
use emberwatch_protocol::task::{FIRST_TRAINING_SEED, Task};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

/// What a policy acts on.
#[derive(Debug, Default)]
pub struct Lesson {
    pub learned: Learned,
    /// Processor seconds of its trainings; `None` if one of them kept none.
    pub seconds: Option<f64>,
    /// Whether it is used as it is: nothing was learned, or `train` was called by hand.
    pub is_final: bool,
}

/// Finds what a policy acts on in a folder of checkpoints.
///
/// # Errors
/// Says what `train` has to learn, or why a checkpoint cannot be used.
pub fn find(
    folder: Option<&Path>,
    task: &Task,
    policy: &Policy,
    world: &WorldForm,
) -> Result<Lesson> {
    if !policy.needs_checkpoint() {
        return Ok(Lesson {
            seconds: Some(0.0),
            is_final: true,
            ..Lesson::default()
        });
    }
    let mut lesson = Lesson::default();
    if let Some(folder) = folder {
        let folder = folder.join(&task.name);
        let own: Vec<PathBuf> = trainings(&folder, policy).map(|(_, own)| own).collect();
        let by_hand = [folder.clone(), folder.join("belief")];
        // Decisions, which are learned last, hold the belief that they are made on.
        if own
            .last()
            .is_some_and(|last| last.join(CHECKPOINT).exists())
        {
            lesson = read(&own)?;
        } else if folder.join(CHECKPOINT).exists() {
            let is_there = |folder: &&PathBuf| folder.join(CHECKPOINT).exists();
            let mut folders: Vec<PathBuf> = by_hand.iter().filter(is_there).cloned().collect();
            folders.reverse();
            lesson = read(&folders)?;
            lesson.is_final = true;
        }
    }
    building::check(policy, &lesson.learned, world)?;
    Ok(lesson)
}

/// The trainings of a policy in their order: the learner's name and the folder.
fn trainings(folder: &Path, policy: &Policy) -> impl Iterator<Item = (&'static str, PathBuf)> {
    let belief = policy.belief.learned_by.as_ref();
    let belief = belief.map(|by| (by.learner, folder.join(by.learner)));
    let decisions = folder.join(format!("{}-{}", DECISIONS.name, policy.belief.label));
    let decisions = policy
        .chooses_options()
        .then_some((DECISIONS.name, decisions));
    belief.into_iter().chain(decisions)
}

/// What the last of some trainings left, and the seconds of all.
fn read(folders: &[PathBuf]) -> Result<Lesson> {
    let seconds = folders.iter().map(|folder| seconds::read(folder));
    let seconds = seconds.collect::<Result<Vec<_>>>()?;
    let last = folders.last().map(|folder| folder.join(CHECKPOINT));
    Ok(Lesson {
        learned: learners::read(last.as_deref(), &Device::Cpu)?,
        seconds: seconds.into_iter().sum(),
        is_final: false,
    })
}

/// Trains what policies lack.
pub struct Trainings<'a> {
    pub folder: &'a Path,
    pub config: &'a AgentConfig,
    /// World steps of each training; `None`: those of the settings.
    pub steps: Option<u64>,
    pub server: Option<PathBuf>,
    pub stop: Arc<AtomicBool>,
}

impl<'a> Trainings<'a> {
    pub fn new(
        folder: &'a Path,
        config: &'a AgentConfig,
        steps: Option<u64>,
        server: Option<PathBuf>,
    ) -> Result<Self> {
        Ok(Self {
            folder,
            config,
            steps,
            server,
            stop: stop_on_signals().context("handle signals")?,
        })
    }

    /// Whether a signal has asked to stop.
    pub fn is_stopped(&self) -> bool {
        self.stop.load(Relaxed)
    }

    /// Makes or completes the trainings that a policy acts on; those that are complete are left as they are.
    ///
    /// # Errors
    /// If a learner cannot learn in the task's worlds.
    pub fn complete(&self, task: &Task, policy: &Policy) -> Result<()> {
        let mut config = self.config.clone();
        config.decisions.estimator = policy.belief.label.into();
        let mut learned = Learned::default();
        for (learner, out) in trainings(&self.folder.join(&task.name), policy) {
            config.learner = learner.into();
            let trained = self.train(task, policy, self.spec(&config, out, learned)?);
            learned = trained.with_context(|| format!("train --learner {learner}"))?;
        }
        Ok(())
    }

    fn spec(&self, config: &AgentConfig, out: PathBuf, learned: Learned) -> Result<TrainingSpec> {
        let kind = learners::named(&config.learner).map_err(anyhow::Error::msg)?;
        let of_settings = match (kind.steps)(config) {
            0 if *kind == FILTER => config.decisions.filter_steps,
            steps => steps,
        };
        let steps = self.steps.unwrap_or(of_settings);
        ensure!(
            steps > 0,
            "expected --train-steps, as the {} has no default length",
            kind.name
        );
        Ok(TrainingSpec {
            worlds: 0..if kind.is_single { 1 } else { N_WORLDS },
            takeover: false,
            steps,
            deadline: None,
            resume: out.join(CHECKPOINT).exists(),
            out,
            freeze: false,
            full_frames: false,
            device: Device::Cpu,
            config: config.clone(),
            learned,
        })
    }

    /// Trains for the steps that are left; returns what was learned.
    fn train(&self, task: &Task, policy: &Policy, mut training: TrainingSpec) -> Result<Learned> {
        let kind = training.learner()?;
        let contents = training.check()?;
        let done = contents.as_ref().map(kind.done).transpose()?.unwrap_or(0);
        let all = training.steps;
        training.steps = all.saturating_sub(done);
        if training.steps > 0 {
            if let Some(contents) = &contents {
                (kind.adopt)(contents, &mut training.config);
            }
            std::fs::create_dir_all(&training.out)
                .with_context(|| format!("create {}", training.out.display()))?;
            tracing::info!(
                "task {}: training {} for {}, {done} of {all} world steps done",
                task.name,
                kind.name,
                policy.name
            );
            let [worlds, seed] =
                [training.worlds.len() as u64, FIRST_TRAINING_SEED].map(|it| it.to_string());
            let flags = ["--task", &task.source, "--worlds", &worlds, "--seed", &seed];
            let server = start_server(
                self.server.clone(),
                flags.map(String::from).into(),
                &training,
            )?;
            learn(server.instance(), &training, contents, &self.stop)?;
        }
        ensure!(!self.is_stopped(), "stopped");
        learners::read([&*training.out.join(CHECKPOINT)], &Device::Cpu)
    }
}
