//! `train`: learns a model while acting.

use super::shared::{WaitFlag, make_folder, parse_seconds};
use super::worlds::GridFlags;
use agent::benchmark::report::training::draw_training;
use agent::client::launch::OwnServer;
use agent::config::{AgentFlags, LearnerKind, Preset};
use agent::learning::checkpoint::Contents;
use agent::learning::learned::Learned;
use agent::learning::learners::decisions::SavedDecisions;
use agent::learning::train::{CHECKPOINT, TrainingSpec, train};
use agent::policy::EstimatorKind;
use anyhow::{Context, Result, ensure};
use clap::Args;
use network::DeviceKind;
use protocol::channels::Instance;
use protocol::program::stop_on_signals;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};

/// First seed of the worlds to train on; those below are for tests.
const TRAINING_SEED: u64 = 1000;

/// Learn a model while acting on a server's worlds.
#[derive(Args)]
pub struct TrainCommand {
    /// Act on this running server; without it, one is started and stopped
    #[arg(long)]
    instance: Option<String>,
    #[command(flatten)]
    wait: WaitFlag,
    /// The first world to act on
    #[arg(long, default_value_t = 0)]
    world: u32,
    /// Number of worlds to act on at once [default: 16, or the autoencoder's 1]
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=1024))]
    worlds: Option<u32>,
    /// What to learn [default: filter; of preset paper: autoencoder]
    #[arg(long)]
    learner: Option<LearnerKind>,
    /// World steps to act for, of all worlds together; 0: until stopped [default: 0; of decisions: those of the
    /// settings]
    #[arg(long)]
    steps: Option<u64>,
    /// Whose belief decisions are learned on [default: learned_filter]
    #[arg(long, value_name = "NAME")]
    estimator: Option<EstimatorKind>,
    /// The filter for that, of an earlier training; without it, one is learned first
    #[arg(long, value_name = "FILE")]
    checkpoint: Option<PathBuf>,
    /// Seconds to act for
    #[arg(long, value_name = "SECONDS", value_parser = parse_seconds)]
    time_limit: Option<Duration>,
    /// Folder for checkpoint.safetensors, metrics.csv and training.png; a filter that is learned first has a folder in it
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Go on from the folder's checkpoint, bit for bit in worlds that stand where it left them
    #[arg(long)]
    resume: bool,
    /// Act on the checkpoint's parameters without learning
    #[arg(long, requires = "resume")]
    freeze: bool,
    /// Where an autoencoder computes: cpu, cuda or metal
    #[arg(long, value_name = "DEVICE", default_value_t)]
    device: DeviceKind,
    /// Take the worlds from their holder
    #[arg(long)]
    takeover: bool,
    /// The server's program, if it is not beside this one
    #[arg(long, value_name = "PROGRAM", conflicts_with = "instance")]
    server: Option<PathBuf>,
    /// First seed of the worlds of the server that is started
    #[arg(long, default_value_t = TRAINING_SEED, conflicts_with = "instance")]
    seed: u64,
    /// Burn-in of the server that is started [default: 25000; of preset paper: 0]
    #[arg(long, conflicts_with_all = ["instance", "states"])]
    burn_in: Option<u64>,
    #[command(flatten)]
    grid: GridFlags,
    #[command(flatten)]
    settings: AgentFlags,
}

impl TrainCommand {
    pub fn run(&self) -> Result<()> {
        let stop = stop_on_signals().context("handle signals")?;
        let (start, mut training) = (Instant::now(), self.training()?);
        let contents = if self.resume && self.goes_on_with_filter(&training) {
            None
        } else {
            training.check()?
        };
        if let Some(contents) = contents.as_ref().filter(|_| decides(&training)) {
            self.go_on_from(contents.state()?, &mut training)?;
        }
        let (instance, own) = self.server(&training)?;
        if own.is_none() && !self.wait.for_server(&instance, || stop.load(Relaxed))? {
            return Ok(());
        }
        if contents.is_none() && needs_filter(&training) {
            if let Some(filter) = training.of_filter()? {
                make_folder(&filter.out)?;
                let contents = filter.check()?;
                learn(&instance, &filter, contents, &stop)?;
            }
            training.resume = true;
            if stop.load(Relaxed) || training.of_filter()?.is_some() {
                tracing::warn!("the filter is not learned yet: continue with --resume");
                return Ok(());
            }
            let limit = &mut training.time_limit;
            *limit = limit.map(|limit| limit.saturating_sub(start.elapsed()));
            let filter = training.filter_folder().join(CHECKPOINT);
            training.learned = Learned::read([&*filter], &training.device)?;
            training.resume = false;
        }
        learn(&instance, &training, contents, &stop)
    }

    fn training(&self) -> Result<TrainingSpec> {
        let mut config = self.settings.effective()?;
        config.learner = self.learner.unwrap_or(config.learner);
        let estimator = self.estimator.unwrap_or(config.decisions.estimator);
        config.decisions.estimator = estimator;
        let is_of_decisions = self.estimator.is_some() || self.checkpoint.is_some();
        ensure!(
            config.learner == LearnerKind::Decisions || !is_of_decisions,
            "--estimator, --checkpoint: expected them with --learner decisions alone, got another learner"
        );
        let n_worlds = self.worlds.unwrap_or(match config.learner {
            LearnerKind::Autoencoder => 1,
            _ => 16,
        });
        let last = self.world.checked_add(n_worlds);
        let last = last.context("--world: expected a world that a server may have")?;
        make_folder(&self.out)?;
        let steps = match config.learner {
            LearnerKind::Decisions => config.decisions.steps,
            _ => 0,
        };
        let device = self.device.open()?;
        let learned = Learned::read(self.checkpoint.as_deref(), &device)?;
        ensure!(
            self.checkpoint.is_none() || learned.filter(estimator).is_some(),
            "--checkpoint: expected a filter for the belief {}, got another",
            estimator.label()
        );
        Ok(TrainingSpec {
            worlds: self.world..last,
            takeover: self.takeover,
            steps: self.steps.unwrap_or(steps),
            time_limit: self.time_limit,
            out: self.out.clone(),
            resume: self.resume,
            freeze: self.freeze,
            learned,
            device,
            config,
        })
    }

    /// Goes on with decisions where their checkpoint left them: on its belief, for the steps that are left.
    fn go_on_from(&self, saved: SavedDecisions, training: &mut TrainingSpec) -> Result<()> {
        let own = saved.estimator;
        ensure!(
            self.estimator.is_none_or(|estimator| estimator == own),
            "--estimator: expected that of the checkpoint, {}, got {}",
            own.label(),
            training.config.decisions.estimator.label()
        );
        ensure!(
            self.checkpoint.is_none(),
            "--checkpoint: expected none with --resume, as the checkpoint of --out has its filter"
        );
        training.config.decisions.estimator = own;
        if self.steps.is_none() && !self.freeze {
            training.steps = training.steps.saturating_sub(saved.world_steps);
            ensure!(
                training.steps > 0,
                "--resume: all {} steps of decisions are made: expected --steps with more",
                saved.world_steps
            );
        }
        Ok(())
    }

    /// Whether a training of decisions was left while its filter was learned.
    fn goes_on_with_filter(&self, training: &TrainingSpec) -> bool {
        !self.freeze
            && needs_filter(training)
            && training.filter_folder().join(CHECKPOINT).exists()
            && !training.out.join(CHECKPOINT).exists()
    }

    /// The server, and itself if it was started: dropped, it stops.
    fn server(&self, training: &TrainingSpec) -> Result<(Instance, Option<OwnServer>)> {
        if let Some(name) = &self.instance {
            return Ok((Instance::new(name)?, None));
        }
        self.grid.check()?;
        ensure!(
            self.world == 0,
            "--world: expected 0 on a server of its own, got {}",
            self.world
        );
        let burn_in = self.burn_in.unwrap_or(match self.settings.preset {
            Preset::Default => 25_000,
            Preset::Paper => 0,
        });
        let n_worlds = training.worlds.len() as u32;
        let mut arguments = self.grid.arguments(n_worlds, self.seed, burn_in);
        let decisions = &training.config.decisions;
        let decides = decides(training);
        // Who learns a model does not look at it, and could not.
        let reveals = (decides && decisions.estimator.knows_model()).to_string();
        let rest = ["--reveal-model", &reveals, "--coverage", "client"];
        arguments.extend(rest.map(String::from));
        if decides {
            let episode = decisions.episode_steps.to_string();
            arguments.extend(["--max-steps".into(), episode]);
        }
        let server = OwnServer::start(self.server.clone(), &arguments)?;
        Ok((server.instance().clone(), Some(server)))
    }
}

fn decides(training: &TrainingSpec) -> bool {
    training.config.learner == LearnerKind::Decisions
}

/// Whether decisions are to be learned on the belief of a filter that is yet to be learned.
fn needs_filter(training: &TrainingSpec) -> bool {
    let estimator = training.config.decisions.estimator;
    decides(training) && estimator.is_learned() && training.learned.filter(estimator).is_none()
}

/// Trains, and says what that gave.
fn learn(
    instance: &Instance,
    training: &TrainingSpec,
    contents: Option<Contents>,
    stop: &AtomicBool,
) -> Result<()> {
    let kind = training.config.learner;
    tracing::info!(learner = ?kind, steps = training.steps, out = %training.out.display(), "learning");
    let summary = train(instance, training, contents, stop)?;
    let mean_reward = summary.reward / summary.steps.max(1) as f64;
    tracing::info!(
        steps = summary.steps,
        updates = summary.updates,
        mean_reward,
        "done"
    );
    for (part, time) in summary.times {
        tracing::info!(part, seconds = time.as_secs_f64(), "time");
    }
    if summary.steps > 0 && !training.freeze {
        draw_training(&training.out)?;
    }
    Ok(())
}
