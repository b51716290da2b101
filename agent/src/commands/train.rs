//! `train`: trains a learner while it acts.

use super::shared::{make_folder, open_device};
use super::worlds::{BURN_IN, SimulationFlags};
use crate::benchmark::report::training::draw_training;
use crate::client::worlds::Worlds;
use crate::flags::{AgentFlags, Preset};
use crate::training::{CHECKPOINT, TrainingSpec, train};
use anyhow::{Context, Result, ensure};
use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser};
use emberwatch_acting::beliefs::{self, BeliefKind};
use emberwatch_acting::config::AgentConfig;
use emberwatch_acting::learned::Learned;
use emberwatch_learning::checkpoint::Contents;
use emberwatch_learning::learners::{self, LEARNERS, LearnerKind};
use emberwatch_network::{DEVICES, Device};
use emberwatch_protocol::channels::{Instance, MAX_WORLDS};
use emberwatch_protocol::client::Backend;
use emberwatch_protocol::control::CoverageRule;
use emberwatch_protocol::model::randomness::{Purpose, stream};
use emberwatch_protocol::program::stop_on_signals;
use emberwatch_protocol::task::FIRST_TRAINING_SEED;
use emberwatch_sim::config::{Checked, ServerConfig};
use rand_chacha::rand_core::Rng;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;

/// Learn a model while acting.
#[derive(Args)]
pub struct TrainCommand {
    /// What to learn [default: filter; with --preset paper: autoencoder]
    #[arg(long, value_parser = PossibleValuesParser::new(LEARNERS.iter().map(|kind| PossibleValue::new(kind.name).help(kind.about))))]
    learner: Option<String>,
    /// Folder for checkpoint.safetensors, metrics.csv and training.svg, with a subfolder for an estimator trained first
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// World steps to act, summed over all worlds; 0: until stopped [default: 0; with --learner neural or decisions:
    /// the remaining steps of the settings]
    #[arg(long)]
    steps: Option<u64>,
    /// Checkpoint of the --estimator from an earlier training; without it, a learned estimator is trained first. With
    /// --learner neural: a filter whose belief the network corrects
    #[arg(long, value_name = "FILE", conflicts_with = "resume")]
    checkpoint: Option<PathBuf>,
    /// Resume from the folder's checkpoint, in worlds that the training has not seen. The replay buffer starts empty
    #[arg(long)]
    resume: bool,
    /// Estimator whose belief decisions are learned on [default: learned; with --resume: the checkpoint's]
    #[arg(long, value_name = "NAME", value_parser = beliefs::of_options, conflicts_with = "resume")]
    estimator: Option<&'static BeliefKind>,
    /// Cells that frames show to a filter in training: path (those in sight of the path) or full (every cell, if the
    /// server's coverage is `client` or `full`) [default: from the settings; with --resume: the checkpoint's]
    #[arg(long, value_name = "CELLS", value_parser = ["path", "full"], conflicts_with = "resume")]
    coverage: Option<String>,
    /// Device for an autoencoder or a neural belief: cpu, cuda or metal
    #[arg(long, value_name = "DEVICE", default_value = "cpu", value_parser = DEVICES)]
    device: String,
    /// Train on this running server, instead of simulating worlds
    #[arg(help_heading = "Worlds", long, conflicts_with = "settings")]
    instance: Option<String>,
    /// Number of the server's first world to act on
    #[arg(
        help_heading = "Worlds",
        long,
        default_value_t = 0,
        requires = "instance"
    )]
    world: u32,
    /// Number of worlds to act on at once [default: 16; with --learner autoencoder: 1]
    #[arg(help_heading = "Worlds", long, value_parser = clap::value_parser!(u32).range(1..=MAX_WORLDS as i64))]
    worlds: Option<u32>,
    /// Take the worlds over from the client that holds them
    #[arg(help_heading = "Worlds", long, requires = "instance")]
    takeover: bool,
    /// Seed of the first world [default: 1000; with --resume: the next]
    #[arg(help_heading = "Worlds", long, conflicts_with = "instance")]
    seed: Option<u64>,
    #[command(flatten, next_help_heading = "Worlds")]
    simulation: SimulationFlags,
    #[command(flatten)]
    settings: AgentFlags,
}

impl TrainCommand {
    pub fn run(&self) -> Result<()> {
        let stop = stop_on_signals().context("handle signals")?;
        let mut training = self.training()?;
        let contents = self.contents(&mut training)?;
        let mut worlds = self.worlds(&training)?;
        if contents.is_none() && needs_belief(&training)? {
            learn_belief(&mut worlds, &training, &stop)?;
            if stop.load(Relaxed) {
                return Ok(());
            }
            let belief = training.belief_folder().join(CHECKPOINT);
            training.learned = learners::read([&*belief], &training.device)?;
            (training.resume, training.first_seed) = (false, None);
        }
        learn(&mut worlds, &training, contents, &stop)
    }

    fn training(&self) -> Result<TrainingSpec> {
        let mut config = self.settings.effective()?;
        if let Some(learner) = &self.learner {
            config.learner.clone_from(learner);
        }
        if let Some(estimator) = self.estimator {
            config.decisions.estimator = estimator.name.into();
        }
        let kind = learners::named(&config.learner).map_err(anyhow::Error::msg)?;
        self.check_flags(kind)?;
        if let Some(coverage) = &self.coverage {
            config.full_frames = coverage == "full";
        }
        let n_worlds = self.worlds.unwrap_or(kind.n_worlds());
        let last = self.world.checked_add(n_worlds);
        let last = last.with_context(|| {
            let world = self.world;
            format!("--world: expected a world that a server can have, got {world}")
        })?;
        let steps = (kind.steps)(&config);
        let device = open_device(&self.device)?;
        let learned = self.learned(kind, &config, &device)?;
        make_folder(&self.out)?;
        Ok(TrainingSpec {
            worlds: self.world..last,
            takeover: self.takeover,
            steps: self.steps.unwrap_or(steps),
            out: self.out.clone(),
            resume: self.resume,
            first_seed: None,
            learned,
            device,
            config,
        })
    }

    fn check_flags(&self, kind: &LearnerKind) -> Result<()> {
        for (flag, is_given) in [
            ("coverage", self.coverage.is_some()),
            ("estimator", self.estimator.is_some()),
            ("checkpoint", self.checkpoint.is_some()),
        ] {
            let with = LEARNERS.iter().filter(|other| other.flags.contains(&flag));
            let with: Vec<&str> = with.map(|other| other.name).collect();
            ensure!(
                !is_given || kind.flags.contains(&flag),
                "--{flag} applies only with --learner {}, got --learner {}",
                with.join(" or "),
                kind.name
            );
        }
        Ok(())
    }

    fn learned(
        &self,
        kind: &LearnerKind,
        config: &AgentConfig,
        device: &Device,
    ) -> Result<Learned> {
        let (base, learned) = (
            (kind.base)(config)?,
            learners::read(self.checkpoint.as_deref(), device)?,
        );
        if let Some((path, base)) = self.checkpoint.as_ref().zip(base) {
            ensure!(
                matches!(base.learned(&learned), Ok(Some(_))),
                "--checkpoint {}: expected a checkpoint for the estimator {}, got one of another kind",
                path.display(),
                base.name
            );
        }
        Ok(learned)
    }

    /// `None` without `--resume`, or if a training was interrupted while it still trained its belief.
    fn contents(&self, training: &mut TrainingSpec) -> Result<Option<Contents>> {
        if !self.resume {
            return training.check();
        }
        let done = training.adopt_belief()?;
        let contents = match done {
            Some(_) => None,
            None => training.check()?,
        };
        let kind = training.learner()?;
        let done = match &contents {
            Some(contents) => {
                (kind.adopt)(contents, &mut training.config)?;
                let done = (kind.done)(contents)?;
                self.limit_steps(done, training)?;
                done
            }
            None => done.unwrap_or(0),
        };
        training.first_seed = Some(self.next_seed(done));
        Ok(contents)
    }

    fn next_seed(&self, done: u64) -> u64 {
        let drawn = || stream(FIRST_TRAINING_SEED, Purpose::Episode, done).next_u64() >> 11;
        self.seed.unwrap_or_else(drawn)
    }

    fn limit_steps(&self, done: u64, training: &mut TrainingSpec) -> Result<()> {
        let all = (training.learner()?.steps)(&training.config);
        if self.steps.is_none() && all > 0 {
            training.steps = all.saturating_sub(done);
            ensure!(
                training.steps > 0,
                "--steps: expected a number of steps, as all {all} steps of the settings are done"
            );
        }
        Ok(())
    }

    fn worlds(&self, training: &TrainingSpec) -> Result<Worlds> {
        let episode_steps = (training.learner()?.episode_steps)(&training.config);
        if let Some(name) = &self.instance {
            let worlds = Worlds::attach(&Instance::new(name)?, false)?;
            if let Some(steps) = episode_steps
                && worlds.info().shortest_episode().is_none()
            {
                tracing::warn!(
                    "instance {name:?}: its episodes have no end: in worlds of its own, this training ends them \
                     (--max-steps {steps} of a server)"
                );
            }
            return Ok(worlds);
        }
        let mut default = ServerConfig {
            seed: training
                .first_seed
                .or(self.seed)
                .unwrap_or(FIRST_TRAINING_SEED),
            ..ServerConfig::default()
        };
        default.world.burn_in = match self.settings.preset {
            Preset::Default => BURN_IN,
            Preset::Paper => 0,
        };
        default.world.max_steps = episode_steps.unwrap_or(0);
        simulate(self.simulation.check(default)?, training)
    }
}

pub(super) fn simulate(mut settings: Checked, training: &TrainingSpec) -> Result<Worlds> {
    // A learner that learns a model must not see the true model.
    settings.config.reveal_model = training.base()?.is_some_and(|base| base.knows_model);
    settings.config.coverage = CoverageRule::Client;
    Worlds::simulate(settings.with_worlds(training.worlds.len() as u32)?)
}

fn needs_belief(training: &TrainingSpec) -> Result<bool> {
    let is_missing = |base: &BeliefKind| base.learned(&training.learned).is_err();
    Ok(training.learner()?.needs_base && training.base()?.is_some_and(is_missing))
}

fn learn_belief(worlds: &mut Worlds, training: &TrainingSpec, stop: &AtomicBool) -> Result<()> {
    let Some(belief) = training.belief_training()? else {
        return Ok(());
    };
    make_folder(&belief.out)?;
    learn(worlds, &belief, belief.check()?, stop)
}

pub(super) fn learn(
    worlds: &mut Worlds,
    training: &TrainingSpec,
    contents: Option<Contents>,
    stop: &AtomicBool,
) -> Result<()> {
    let learner = &training.config.learner;
    tracing::info!(learner, steps = training.steps, out = %training.out.display(), "learning");
    let summary = train(worlds, training, contents, stop)?;
    let mean_reward = summary.reward / summary.steps.max(1) as f64;
    tracing::info!(
        steps = summary.steps,
        updates = summary.updates,
        mean_reward,
        "done"
    );
    if summary.steps > 0 {
        draw_training(&training.out)?;
    }
    Ok(())
}
