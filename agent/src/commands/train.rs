//! `train`: learns a model while acting.

use super::shared::{WaitFlag, make_folder, parse_seconds};
use super::worlds::GridFlags;
use anyhow::{Context, Result, ensure};
use clap::Args;
use emberwatch_agent::benchmark::report::training::draw_training;
use emberwatch_agent::client::launch::OwnServer;
use emberwatch_agent::flags::{AgentFlags, Preset, one_of};
use emberwatch_agent::training::{CHECKPOINT, TrainingSpec, train};
use emberwatch_learning::checkpoint::Contents;
use emberwatch_learning::config::{AgentConfig, LearnerKind};
use emberwatch_learning::learned::Learned;
use emberwatch_learning::learners::decisions::SavedDecisions;
use emberwatch_learning::learners::neural::SavedNeural;
use emberwatch_learning::policy::EstimatorKind;
use emberwatch_network::{Device, DeviceKind};
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::program::stop_on_signals;
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
    #[arg(long, value_parser = one_of(&LearnerKind::ALL))]
    learner: Option<LearnerKind>,
    /// World steps to act for, of all worlds together; 0: until stopped [default: 0; of neural and decisions: what
    /// is left of those of the settings]
    #[arg(long)]
    steps: Option<u64>,
    /// Whose belief decisions are learned on [default: learned_filter, or the checkpoint's to go on from]
    #[arg(long, value_name = "NAME")]
    estimator: Option<EstimatorKind>,
    /// That belief, of an earlier training; without it, one is learned first. With --learner neural: a filter, whose
    /// belief the network then corrects
    #[arg(long, value_name = "FILE")]
    checkpoint: Option<PathBuf>,
    /// Seconds to act for, with a belief that is learned first
    #[arg(long, value_name = "SECONDS", value_parser = parse_seconds)]
    time_limit: Option<Duration>,
    /// Folder for checkpoint.safetensors, metrics.csv and training.png; a belief that is learned first has a folder in it
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Go on from the folder's checkpoint, bit for bit in worlds that stand where it left them
    #[arg(long)]
    resume: bool,
    /// Act on the checkpoint's parameters without learning
    #[arg(long, requires = "resume")]
    freeze: bool,
    /// Where an autoencoder or a neural belief computes: cpu, cuda or metal
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
    #[arg(long, conflicts_with_all = ["instance", "states", "task"])]
    burn_in: Option<u64>,
    #[command(flatten)]
    grid: GridFlags,
    #[command(flatten)]
    settings: AgentFlags,
}

impl TrainCommand {
    pub fn run(&self) -> Result<()> {
        let stop = stop_on_signals().context("handle signals")?;
        let mut training = self.training()?;
        let contents = self.contents(&mut training)?;
        let (instance, own) = self.server(&training)?;
        if own.is_none() && !self.wait.for_server(&instance, || stop.load(Relaxed))? {
            return Ok(());
        }
        let end = |limit| Instant::now().checked_add(limit);
        training.deadline = self.time_limit.and_then(end);
        if contents.is_none() && needs_belief(&training) {
            learn_belief(&instance, &training, &stop)?;
            if stop.load(Relaxed) {
                return Ok(());
            }
            let belief = training.belief_folder().join(CHECKPOINT);
            training.learned = Learned::read([&*belief], &training.device)?;
            training.resume = false;
        }
        learn(&instance, &training, contents, &stop).map(drop)
    }

    fn training(&self) -> Result<TrainingSpec> {
        let mut config = self.settings.effective()?;
        config.learner = self.learner.unwrap_or(config.learner);
        let decisions = &mut config.decisions;
        decisions.estimator = self.estimator.unwrap_or(decisions.estimator);
        let n_worlds = self.worlds.unwrap_or(match config.learner {
            LearnerKind::Autoencoder => 1,
            _ => 16,
        });
        let last = self.world.checked_add(n_worlds);
        let last = last.context("--world: expected a world that a server may have")?;
        let steps = all_steps(&config).unwrap_or(0);
        let device = self.device.open()?;
        let learned = self.learned(&config, &device)?;
        make_folder(&self.out)?;
        Ok(TrainingSpec {
            worlds: self.world..last,
            takeover: self.takeover,
            steps: self.steps.unwrap_or(steps),
            deadline: None,
            out: self.out.clone(),
            resume: self.resume,
            freeze: self.freeze,
            learned,
            device,
            config,
        })
    }

    /// The belief that was given for decisions, or for a network to correct; refuses what would be ignored.
    fn learned(&self, config: &AgentConfig, device: &Device) -> Result<Learned> {
        let is_neural = config.learner == LearnerKind::Neural;
        let decides = config.learner == LearnerKind::Decisions;
        ensure!(
            self.estimator.is_none() || decides,
            "--estimator: expected none, or --learner decisions"
        );
        ensure!(
            self.checkpoint.is_none() || decides || is_neural,
            "--checkpoint: expected none, or --learner decisions or neural"
        );
        let learned = Learned::read(self.checkpoint.as_deref(), device)?;
        let estimator = if is_neural {
            EstimatorKind::LEARNED
        } else {
            config.decisions.estimator
        };
        if let Some(path) = &self.checkpoint {
            ensure!(
                learned.belief(estimator).is_some(),
                "--checkpoint {}: expected what {} acts on, got another",
                path.display(),
                estimator.label()
            );
        }
        Ok(learned)
    }

    /// What to go on from, if that is asked for; `None` also if it is a belief, before decisions on it.
    /// Decisions go on with the estimator that they began with.
    fn contents(&self, training: &mut TrainingSpec) -> Result<Option<Contents>> {
        if training.config.learner != LearnerKind::Decisions || !self.resume {
            let contents = training.check()?;
            if training.config.learner == LearnerKind::Neural
                && let Some(contents) = &contents
            {
                self.check_no_checkpoint()?;
                self.go_on_for(contents.state::<SavedNeural>()?.world_steps, training)?;
            }
            return Ok(contents);
        }
        if let Some(estimator) = training.estimator_of_belief()? {
            ensure!(
                !self.freeze,
                "--freeze: expected a checkpoint of decisions in {}, got one of their belief alone",
                self.out.display()
            );
            self.go_on_with(estimator, training)?;
            return Ok(None);
        }
        let contents = training.check()?;
        if let Some(contents) = &contents {
            let saved: SavedDecisions = contents.state()?;
            self.go_on_with(saved.estimator, training)?;
            self.go_on_for(saved.world_steps, training)?;
        }
        Ok(contents)
    }

    /// Goes on for the steps that are left of those of the settings, unless a flag says otherwise.
    fn go_on_for(&self, done: u64, training: &mut TrainingSpec) -> Result<()> {
        let all = all_steps(&training.config).unwrap_or(0);
        if self.steps.is_none() && !self.freeze && all > 0 {
            training.steps = all.saturating_sub(done);
            ensure!(
                training.steps > 0,
                "--steps: expected a number, as the {all} of the settings are done"
            );
        }
        Ok(())
    }

    fn go_on_with(&self, estimator: EstimatorKind, training: &mut TrainingSpec) -> Result<()> {
        let (expected, got) = (estimator, self.estimator.unwrap_or(estimator));
        ensure!(
            got == expected,
            "--estimator: expected {} as in the checkpoint, got {}",
            expected.label(),
            got.label()
        );
        self.check_no_checkpoint()?;
        training.config.decisions.estimator = estimator;
        Ok(())
    }

    fn check_no_checkpoint(&self) -> Result<()> {
        ensure!(
            self.checkpoint.is_none(),
            "--checkpoint: expected none beside --resume, which goes on with the belief of {}",
            self.out.display()
        );
        Ok(())
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
        let (learner, decisions) = (training.config.learner, &training.config.decisions);
        let decides = learner == LearnerKind::Decisions;
        // Who learns a model does not look at it, and could not.
        let reveals = (decides && decisions.estimator.knows_model()).to_string();
        let rest = ["--reveal-model", &reveals, "--coverage", "client"];
        arguments.extend(rest.map(String::from));
        let episode_steps = match learner {
            LearnerKind::Decisions => Some(decisions.episode_steps),
            LearnerKind::Neural => Some(training.config.neural.episode_steps),
            _ => None,
        };
        // A task has its own.
        let episode_steps = episode_steps.filter(|_| self.grid.task.is_none());
        let episode = episode_steps.map(|steps| ["--max-steps".into(), steps.to_string()]);
        arguments.extend(episode.into_iter().flatten());
        let server = OwnServer::start(self.server.clone(), &arguments)?;
        Ok((server.instance().clone(), Some(server)))
    }
}

/// World steps of a whole training, where the settings say how many.
fn all_steps(config: &AgentConfig) -> Option<u64> {
    match config.learner {
        LearnerKind::Decisions => Some(config.decisions.steps),
        LearnerKind::Neural => Some(config.neural.steps),
        _ => None,
    }
}

/// Whether decisions are to be learned on a belief that is yet to be learned.
fn needs_belief(training: &TrainingSpec) -> bool {
    let estimator = training.config.decisions.estimator;
    training.config.learner == LearnerKind::Decisions
        && estimator.is_learned()
        && training.learned.belief(estimator).is_none()
}

/// Learns the belief that decisions are to be learned on, unless that is done.
fn learn_belief(instance: &Instance, training: &TrainingSpec, stop: &AtomicBool) -> Result<()> {
    let Some(belief) = training.of_belief()? else {
        return Ok(());
    };
    make_folder(&belief.out)?;
    let n_steps = learn(instance, &belief, belief.check()?, stop)?;
    ensure!(
        n_steps >= belief.steps || stop.load(Relaxed),
        "--time-limit: the belief is not learned yet: continue with --resume"
    );
    Ok(())
}

/// Trains, says what that gave, and returns the world steps that were acted.
fn learn(
    instance: &Instance,
    training: &TrainingSpec,
    contents: Option<Contents>,
    stop: &AtomicBool,
) -> Result<u64> {
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
    Ok(summary.steps)
}
