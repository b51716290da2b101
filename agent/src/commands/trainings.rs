//! Trainings for the policies of a suite: finds their checkpoints, and runs missing trainings.
//!
//! `FOLDER/TASK` contains a folder for each training: `filter`, `neural` and `autoencoder` for beliefs, and
//! `decisions-BELIEF` for decisions on a belief. If a policy's folder is missing, the policy uses the checkpoint that
//! `train --out FOLDER/TASK` wrote.

use super::train::{N_WORLDS, learn, start_server};
use crate::training::{CHECKPOINT, TrainingSpec, seconds};
use anyhow::{Context, Result, ensure};
use emberwatch_learning::beliefs::{BELIEFS, WorldForm};
use emberwatch_learning::checkpoint;
use emberwatch_learning::config::AgentConfig;
use emberwatch_learning::learned::Learned;
use emberwatch_learning::learners::decisions::DECISIONS;
use emberwatch_learning::learners::filter::FILTER;
use emberwatch_learning::learners::{self, LearnerKind};
use emberwatch_learning::policy::Policy;
use emberwatch_learning::rollout::building;
use emberwatch_network::Device;
use emberwatch_protocol::program::stop_on_signals;
use emberwatch_protocol::task::{FIRST_TRAINING_SEED, Task};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

/// The checkpoints of a policy on one task.
#[derive(Debug, Default)]
pub struct Lesson {
    pub learned: Learned,
    /// Processor seconds of the policy's trainings; `None` if one of them has no record.
    pub seconds: Option<f64>,
    /// Whether `suite --train` leaves the checkpoints as they are, because the policy needs none or the user ran
    /// `train`.
    pub is_final: bool,
    /// The last training: its learner, and its number of world steps.
    steps: Option<(&'static LearnerKind, u64)>,
}

impl Lesson {
    /// Describes the last training if it has fewer world steps than the settings specify.
    pub fn unfinished(&self, config: &AgentConfig) -> Option<String> {
        let (kind, done) = self.steps.filter(|_| !self.is_final)?;
        let all = steps_of_settings(kind, config);
        (done < all).then(|| format!("{done} of {all} world steps (--learner {})", kind.name))
    }
}

/// Reads a policy's checkpoints from a folder.
///
/// # Errors
/// If a checkpoint is missing or cannot be used.
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
        let has_checkpoint = |folder: &PathBuf| folder.join(CHECKPOINT).exists();
        if own.last().is_some_and(has_checkpoint) {
            check_decisions(&own)?;
            lesson = read(&own)?;
        } else if has_checkpoint(&folder) {
            let by_hand = [folder.join("belief"), folder];
            let with_belief = has_checkpoint(&by_hand[0]);
            lesson = read(&by_hand[usize::from(!with_belief)..])?;
            lesson.is_final = true;
        }
    }
    building::check(policy, &lesson.learned, world)?;
    Ok(lesson)
}

/// Returns a policy's trainings, the belief first, each as the learner's name and the folder.
fn trainings(folder: &Path, policy: &Policy) -> impl Iterator<Item = (&'static str, PathBuf)> {
    let belief = policy.belief.learned_by.as_ref();
    let belief = belief.map(|by| (by.learner, folder.join(by.learner)));
    let decisions = folder.join(format!("{}-{}", DECISIONS.name, policy.belief.label));
    let decisions = policy
        .chooses_options()
        .then_some((DECISIONS.name, decisions));
    belief.into_iter().chain(decisions)
}

/// Reads the last training's checkpoint, which includes the first training's belief. Adds up the processor seconds of
/// all trainings.
fn read(folders: &[PathBuf]) -> Result<Lesson> {
    let seconds = folders.iter().map(|folder| seconds::read(folder));
    let seconds = seconds.collect::<Result<Vec<_>>>()?;
    let last = folders.last().map(|folder| folder.join(CHECKPOINT));
    let step = |place: &PathBuf| -> Result<_> {
        let (name, contents) = checkpoint::read(place)?;
        let kind = learners::of_checkpoint(&name)?;
        Ok((kind, (kind.done)(&contents)?))
    };
    Ok(Lesson {
        steps: last.as_ref().map(step).transpose()?,
        learned: learners::read(last.as_deref(), &Device::Cpu)?,
        seconds: seconds.into_iter().sum(),
        is_final: false,
    })
}

/// Refuses decisions that were not learned on the belief in the neighbouring folder.
fn check_decisions(own: &[PathBuf]) -> Result<()> {
    let places: Vec<PathBuf> = own.iter().map(|folder| folder.join(CHECKPOINT)).collect();
    if let [belief, decisions] = places.as_slice()
        && belief.exists()
        && decisions.exists()
    {
        let both = learners::read([&**belief, &**decisions], &Device::Cpu);
        let [belief, decisions] = [&own[0], &own[1]].map(|folder| folder.display());
        let problem =
            || format!("{decisions} was learned on another belief than {belief}: remove it");
        both.with_context(problem)?;
    }
    Ok(())
}

/// Refuses to train a belief further if decisions were learned on its present state.
fn check_dependents(belief: &Path, learner: &str) -> Result<()> {
    for kind in BELIEFS {
        let decisions = format!("{}-{}", DECISIONS.name, kind.label);
        let decisions = belief.with_file_name(decisions);
        let is_dependent = kind
            .learned_by
            .as_ref()
            .is_some_and(|by| by.learner == learner);
        ensure!(
            !(is_dependent && decisions.join(CHECKPOINT).exists()),
            "{} was learned on the present belief in {}: remove it to train the belief further",
            decisions.display(),
            belief.display()
        );
    }
    Ok(())
}

/// Returns the number of world steps that the settings specify for a training.
fn steps_of_settings(kind: &LearnerKind, config: &AgentConfig) -> u64 {
    match (kind.steps)(config) {
        0 if *kind == FILTER => config.decisions.filter_steps,
        steps => steps,
    }
}

/// Runs the missing trainings of a suite.
pub struct Trainings<'a> {
    pub folder: &'a Path,
    pub config: &'a AgentConfig,
    /// World steps of each training, summed over its worlds; `None`: the number in the settings.
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

    /// Returns whether a signal has asked to stop.
    pub fn is_stopped(&self) -> bool {
        self.stop.load(Relaxed)
    }

    /// Starts or resumes a policy's trainings. Does not change complete trainings.
    ///
    /// # Errors
    /// If a learner cannot learn in the task's worlds, or decisions were learned on another belief.
    pub fn complete(&self, task: &Task, policy: &Policy) -> Result<()> {
        let mut config = self.config.clone();
        let mut learned = Learned::default();
        let own: Vec<_> = trainings(&self.folder.join(&task.name), policy).collect();
        let folders: Vec<PathBuf> = own.iter().map(|(_, out)| out.clone()).collect();
        check_decisions(&folders)?;
        for (learner, out) in own {
            if learner == DECISIONS.name {
                config.decisions.estimator = policy.belief.label.into();
            }
            config.learner = learner.into();
            let trained = self.train(task, policy, self.spec(&config, out, learned)?);
            learned = trained.with_context(|| format!("train --learner {learner}"))?;
        }
        Ok(())
    }

    fn spec(&self, config: &AgentConfig, out: PathBuf, learned: Learned) -> Result<TrainingSpec> {
        let kind = learners::named(&config.learner).map_err(anyhow::Error::msg)?;
        let steps = self.steps.unwrap_or(steps_of_settings(kind, config));
        ensure!(
            steps > 0,
            "--train-steps: expected a number of steps, as the {} has no default length",
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
            device: Device::Cpu,
            config: config.clone(),
            learned,
        })
    }

    /// Trains for the remaining steps, and reads the checkpoint.
    fn train(&self, task: &Task, policy: &Policy, mut training: TrainingSpec) -> Result<Learned> {
        let kind = training.learner()?;
        let contents = training.check()?;
        let done = contents.as_ref().map(kind.done).transpose()?.unwrap_or(0);
        let all = training.steps;
        training.steps = all.saturating_sub(done);
        if let Some(contents) = &contents {
            if training.steps == 0 && training.has_other_settings(contents) {
                let place = training.out.display();
                tracing::warn!("{place} is kept, although it was trained with other settings");
            }
            (kind.adopt)(contents, &mut training.config);
        }
        if training.steps > 0 {
            if contents.is_some() && *kind != DECISIONS {
                check_dependents(&training.out, kind.name)?;
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
