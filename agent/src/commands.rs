//! The subcommands: flags in, library calls, files and tables out.

mod decisions;
mod prior;

pub use decisions::ServeDecisionsCommand;
pub use prior::PriorCommand;

use agent::arena::{Arena, MAX_BATCH};
use agent::compare::{Comparison, Moment, Results, compare};
use agent::config::AgentFlags;
use agent::decisions::DecisionsError;
use agent::launch::OwnServer;
use agent::policy::Policy;
use agent::report::{
    Snapshot, draw_ladder, draw_rewards, draw_snapshot, figures::FIRE_CELLS_PER_STEP, render_table,
    write_csv,
};
use agent::run::{Mission, RunError, run};
use anyhow::{Context, Result, ensure};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use protocol::channels::Instance;
use protocol::connection::ConnectionError;
use protocol::message::Status;
use protocol::program::stop_on_signals;
use protocol::{Model, Shape};
use std::io::Write;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Most worlds of a comparison.
const MAX_SEEDS: u64 = 100_000;

/// Exit code of a run whose lease was lost.
const LEASE_LOST: u8 = 3;

/// Act on one world of a running server.
#[derive(Args)]
pub struct RunCommand {
    /// The server's instance name
    #[arg(long, default_value = "default")]
    instance: String,
    /// The world to act on
    #[arg(long, default_value_t = 0)]
    world: u32,
    /// The policy
    #[arg(long, default_value = "beam_exploit")]
    policy: String,
    /// Steps to act for; 0: until stopped
    #[arg(long, default_value_t = 0)]
    steps: u64,
    /// Take the world from its holder
    #[arg(long)]
    takeover: bool,
    /// The model file, where the server does not reveal its model
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    #[command(flatten)]
    settings: AgentFlags,
}

/// Compare policies on the same worlds.
#[derive(Args)]
pub struct CompareCommand {
    /// Use the worlds of this running server; without it, one is started and stopped
    #[arg(long)]
    instance: Option<String>,
    /// The policies, separated by commas [default: the ladder]
    #[arg(long, value_delimiter = ',')]
    policies: Vec<String>,
    /// The policy that others are paired against
    #[arg(long, default_value = "shooting_exploit")]
    baseline: String,
    /// World seeds, first..end
    #[arg(long, value_parser = parse_seeds, default_value = "0..8")]
    seeds: Range<u64>,
    /// Scored steps of each world
    #[arg(long, default_value_t = 1500, value_parser = clap::value_parser!(u64).range(1..=10_000_000))]
    steps: u64,
    /// Steps simulated before the first scored one [default: 25000, or the running server's]
    #[arg(long)]
    burn_in: Option<u64>,
    /// Write one line per policy and world to this file
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Draw ladder.png, rewards.png and snapshot.png into this directory
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
    /// The server's program, if it is not beside this one
    #[arg(long, value_name = "PROGRAM", conflicts_with = "instance")]
    server: Option<PathBuf>,
    /// `wildfire` or a model file, for the server that is started
    #[arg(long, default_value = "wildfire", conflicts_with = "instance")]
    model: String,
    /// Grid height in cells, for the server that is started
    #[arg(long, default_value_t = 64, conflicts_with = "instance")]
    height: usize,
    /// Grid width in cells, for the server that is started
    #[arg(long, default_value_t = 64, conflicts_with = "instance")]
    width: usize,
    /// Moves in a path, for the server that is started
    #[arg(long, default_value_t = 64, conflicts_with = "instance")]
    moves: usize,
    #[command(flatten)]
    settings: AgentFlags,
}

/// Burn-in of the benchmark, steps.
const BENCHMARK_BURN_IN: u64 = 25_000;

impl RunCommand {
    /// Runs the mission.
    pub fn run(&self) -> Result<()> {
        let model = self.model.as_deref().map(read_model).transpose()?;
        let mission = Mission {
            instance: Instance::new(&self.instance)?,
            world: self.world,
            policy: self.policy.clone(),
            steps: self.steps,
            takeover: self.takeover,
            model,
            config: self.settings.effective()?,
        };
        let summary = run(&mission, &*stop_on_signals().context("handle signals")?)?;
        let mean_reward = summary.reward / summary.steps.max(1) as f64;
        tracing::info!(steps = summary.steps, mean_reward, "done");
        Ok(())
    }
}

impl CompareCommand {
    /// Runs the comparison and writes what it gave.
    pub fn run(&self) -> Result<()> {
        let config = self.settings.effective()?;
        self.make_places()?;
        let own = match &self.instance {
            Some(_) => None,
            None => Some(OwnServer::start(
                self.server.clone(),
                &self.server_arguments()?,
            )?),
        };
        let instance = match (&self.instance, &own) {
            (Some(name), _) => Instance::new(name)?,
            (None, Some(server)) => server.instance().clone(),
            (None, None) => unreachable!("a server is started where none is named"),
        };
        let mut arena = Arena::open(&instance, self.n_seeds(), self.needs_scouts())?;
        self.check_burn_in(&arena)?;
        let policies = self.policies(arena.model())?;
        let comparison = Comparison {
            policies,
            seeds: self.seeds.clone(),
            steps: self.steps,
            config,
        };
        let results = self.compare(&mut arena, &comparison)?;
        write(&render_table(&results.runs, &self.baseline))?;
        if let Some(path) = &self.csv {
            write_csv(path, &results.runs)?;
        }
        if let Some(directory) = &self.figures {
            self.draw(directory, &mut arena, &comparison, &results)?;
        }
        Ok(())
    }

    fn compare(&self, arena: &mut Arena, comparison: &Comparison) -> Result<Results> {
        let n_steps = comparison.policies.len() as u64 * u64::from(self.n_seeds()) * self.steps;
        let bar = progress_bar(n_steps);
        let results = compare(arena, comparison, &|policy, steps| {
            if bar.message() != policy {
                if bar.is_hidden() {
                    tracing::info!(policy, done = bar.position(), of = n_steps, "comparing");
                }
                bar.set_message(policy.to_owned());
            }
            bar.inc(steps);
        });
        bar.finish_and_clear();
        Ok(results?)
    }

    fn draw(
        &self,
        directory: &Path,
        arena: &mut Arena,
        comparison: &Comparison,
        results: &Results,
    ) -> Result<()> {
        let label = axis_label(arena.model());
        draw_ladder(&directory.join("ladder.png"), &results.runs, &label)?;
        let first = self.seeds.start;
        draw_rewards(
            &directory.join("rewards.png"),
            &results.runs,
            first,
            &label,
            Some(&results.fire_cells),
        )?;
        match &results.moment {
            Some(moment) => draw_moment(&directory.join("snapshot.png"), arena, moment)?,
            None => tracing::warn!("no snapshot: no policy among these has a belief of its own"),
        }
        let settings = toml::to_string(&comparison.config)?;
        let path = directory.join("agent.toml");
        std::fs::write(&path, settings).with_context(|| format!("write {}", path.display()))
    }

    /// Makes the folders of the files to come: better to fail before a long comparison than after.
    fn make_places(&self) -> Result<()> {
        if let Some(path) = &self.csv {
            ensure!(
                !path.is_dir(),
                "--csv: expected a file, got the folder {}",
                path.display()
            );
            let parent = path.parent().filter(|parent| *parent != Path::new(""));
            parent.map_or(Ok(()), make_folder)?;
        }
        self.figures.as_deref().map_or(Ok(()), make_folder)
    }

    fn policies(&self, model: &Model) -> Result<Vec<Policy>> {
        let named = |name: &String| Policy::named(name, model);
        let policies = match self.policies.as_slice() {
            [] => Policy::ladder(model),
            names => names.iter().map(named).collect::<Result<_, _>>()?,
        };
        let twice = policies
            .iter()
            .enumerate()
            .find(|(index, policy)| policies[..*index].contains(policy));
        ensure!(
            twice.is_none(),
            "policies: expected each name once, got {:?} twice",
            twice.map_or("", |(_, policy)| &policy.name)
        );
        named(&self.baseline).context("--baseline")?;
        Ok(policies)
    }

    fn server_arguments(&self) -> Result<Vec<String>> {
        // Names that cannot be right are refused before a server is started for them.
        let model = model_named(&self.model)?;
        self.policies(&model)?;
        model.check_on(Shape::new(self.height, self.width)?)?;
        let batch = self.n_seeds().min(MAX_BATCH);
        let worlds = batch * if self.needs_scouts() { 2 } else { 1 } + 1;
        let burn_in = self.burn_in.unwrap_or(BENCHMARK_BURN_IN);
        let settings = [
            ("--worlds", worlds.to_string()),
            ("--model", self.model.clone()),
            ("--height", self.height.to_string()),
            ("--width", self.width.to_string()),
            ("--moves", self.moves.to_string()),
            ("--seed", self.seeds.start.to_string()),
            ("--burn-in", burn_in.to_string()),
            ("--coverage", "client".into()),
        ];
        let pairs = settings
            .into_iter()
            .flat_map(|(flag, value)| [flag.to_owned(), value]);
        Ok(pairs.chain(["--publish-truth".to_owned()]).collect())
    }

    fn needs_scouts(&self) -> bool {
        self.policies.is_empty()
            || self
                .policies
                .iter()
                .any(|name| name.starts_with("clairvoyant"))
    }

    fn n_seeds(&self) -> u32 {
        (self.seeds.end - self.seeds.start) as u32
    }

    fn check_burn_in(&self, arena: &Arena) -> Result<()> {
        let got = arena.info().burn_in;
        let asked = self.burn_in.unwrap_or(got);
        ensure!(
            asked == got,
            "--burn-in: expected the running server's {got}, got {asked}"
        );
        Ok(())
    }
}

/// Where results go wrong for a reason that callers may want to tell apart, a code of its own.
pub fn exit_code(error: &anyhow::Error) -> ExitCode {
    let served = match error.downcast_ref::<DecisionsError>() {
        Some(DecisionsError::Run(error)) => Some(error),
        _ => None,
    };
    match served.or_else(|| error.downcast_ref::<RunError>()) {
        Some(RunError::Connection(ConnectionError::Refused {
            status: Status::LeaseLost,
            ..
        })) => LEASE_LOST.into(),
        _ => ExitCode::FAILURE,
    }
}

fn draw_moment(path: &Path, arena: &mut Arena, moment: &Moment) -> Result<()> {
    let Some(observation) = arena.full_observation(moment.seed, moment.step)? else {
        tracing::warn!(
            "no snapshot: it needs one world more than the seeds and a server with --coverage client"
        );
        return Ok(());
    };
    let model = arena.model().clone();
    let snapshot = Snapshot {
        model: &model,
        truth: moment.truth.clone(),
        observation,
        frame: moment.frame.clone(),
        path_cells: moment.path_cells.clone(),
        belief: moment.belief.probabilities(),
        step: moment.step,
        seed: moment.seed,
    };
    Ok(draw_snapshot(path, &snapshot)?)
}

fn axis_label(model: &Model) -> String {
    let target = &model.file().states[model.target_state()].name;
    let pays_one = (0..model.n_states())
        .all(|state| model.reward()[state] == f64::from(u8::from(state == model.target_state())));
    match (target.as_str(), pays_one) {
        ("fire", true) => FIRE_CELLS_PER_STEP.into(),
        (name, true) => format!("distinct {name} cells found per step"),
        (_, false) => "reward per step".into(),
    }
}

fn progress_bar(n_steps: u64) -> ProgressBar {
    let style = "{msg:22} [{bar:32}] {percent:>3} %  {per_sec:.0}  {eta_precise} left";
    let style = ProgressStyle::with_template(style).expect("invariant: the template is valid");
    ProgressBar::new(n_steps).with_style(style.progress_chars("=> "))
}

fn parse_seeds(text: &str) -> Result<Range<u64>, String> {
    let parsed = text
        .split_once("..")
        .and_then(|(first, end)| Some(first.parse().ok()?..end.parse().ok()?));
    let seeds: Range<u64> = parsed.ok_or("expected FIRST..END, such as 0..8")?;
    if seeds.start < seeds.end && seeds.end - seeds.start <= MAX_SEEDS {
        return Ok(seeds);
    }
    Err(format!("expected 1 to {MAX_SEEDS} seeds, FIRST below END"))
}

/// A built-in model, or that of a file.
fn model_named(name: &str) -> Result<Model> {
    if name == "wildfire" {
        return Ok(Model::wildfire());
    }
    read_model(Path::new(name))
}

fn read_model(path: &Path) -> Result<Model> {
    let text =
        std::fs::read_to_string(path).with_context(|| format!("model file {}", path.display()))?;
    Model::from_toml(&text).with_context(|| format!("model file {}", path.display()))
}

fn make_folder(path: &Path) -> Result<()> {
    std::fs::create_dir_all(path).with_context(|| format!("create {}", path.display()))
}

fn write(text: &str) -> Result<()> {
    let mut out = std::io::stdout();
    out.write_all(text.as_bytes())
        .and_then(|()| out.write_all(b"\n"))
        .context("write to standard output")
}
