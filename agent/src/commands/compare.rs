//! `compare`: the benchmark.

use super::shared::{asks_for_help, lock_csv, make_folder, write};
use super::worlds::WorldFlags;
use crate::benchmark::arena::Arena;
use crate::benchmark::compare::{Comparison, Results, compare};
use crate::benchmark::report::common_worlds::{CommonWorlds, check_added, check_fire};
use crate::benchmark::report::runs_file::read_runs;
use crate::benchmark::report::{
    PolicyRun, RunsFile, draw_ladder, draw_rewards, draw_snapshot, draw_teams,
    figures::FIRE_CELLS_PER_STEP, render_table, write_events,
};
use crate::benchmark::team::Team;
use crate::client::launch::OwnDashboard;
use crate::flags::AgentFlags;
use anyhow::{Context, Result, ensure};
use clap::Args;
use emberwatch_belief::merit::RECENT_STEPS;
use emberwatch_learning::beliefs::{Input, NONE};
use emberwatch_learning::config::AgentConfig;
use emberwatch_learning::file::{Readers, replace_file};
use emberwatch_learning::learned::Learned;
use emberwatch_learning::learners;
use emberwatch_learning::policy::{self, Goal, LearnedDecisions, Policy};
use emberwatch_network::DeviceKind;
use emberwatch_protocol::Model;
use emberwatch_protocol::channels::MAX_ROBOTS;
use emberwatch_protocol::control::ServerInfo;
use indicatif::{ProgressBar, ProgressStyle};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

/// Stands for the policies of [`policy::options_table`].
const OPTIONS: &str = "options";

/// The policy of teams, unless others are named.
const OF_TEAMS: &str = "beam_exploit";

/// Compare policies on the same worlds.
#[derive(Args)]
pub struct CompareCommand {
    /// The policies, separated by commas: names, or BELIEF/PLANNER/GOAL; `help` lists all parts; `options`: each option on
    /// the belief of the decisions that were learned, the rule and the learned choice [default: the ladder; of teams:
    /// beam_exploit]
    #[arg(long, value_delimiter = ',')]
    policies: Vec<String>,
    /// The policy that others are paired against [default: shooting_exploit; of options: that which exploits; of
    /// teams: the first policy; of recorded worlds without --model: coverage]
    #[arg(long)]
    baseline: Option<String>,
    /// Robots of each world, separated by commas, each on worlds of its own [default: 1, or the running server's]
    #[arg(long, conflicts_with = "task", value_delimiter = ',', value_parser = clap::value_parser!(u32).range(1..=MAX_ROBOTS as i64))]
    robots: Vec<u32>,
    /// How the robots of a world act together, separated by commas
    #[arg(long, value_delimiter = ',', default_value = "alone")]
    team: Vec<Team>,
    /// What `train` learned: adds to the ladder what acts on it; may be given once for each learner
    #[arg(long, value_name = "FILE")]
    checkpoint: Vec<PathBuf>,
    /// Where networks compute: cpu, cuda or metal
    #[arg(long, value_name = "DEVICE", default_value_t)]
    device: DeviceKind,
    /// Write one line per policy and world to this file
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Rows that others measured on the same worlds, such as `emberwatch.benchmark` in Python; may be
    /// given for each
    #[arg(long, value_name = "FILE")]
    add: Vec<PathBuf>,
    /// Draw ladder.svg, rewards.svg, teams.svg and snapshot.svg into this directory
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
    /// Show it in a browser while it runs, at this address
    #[arg(long, value_name = "ADDRESS:PORT", num_args = 0..=1, default_missing_value = "127.0.0.1:8600")]
    watch: Option<SocketAddr>,
    /// Write rewards step by step for TensorBoard into this directory, a run of each policy
    #[arg(long, value_name = "DIR")]
    tensorboard: Option<PathBuf>,
    /// Begin beliefs of a known model with each world's hidden state, instead of --prior
    #[arg(long, conflicts_with = "prior")]
    first_state_known: bool,
    /// Steps for which a cell counts as seen after a visit, in the figures of merit
    #[arg(long, value_name = "STEPS", default_value_t = RECENT_STEPS, value_parser = clap::value_parser!(u32).range(1..))]
    recent_steps: u32,
    #[command(flatten)]
    worlds: WorldFlags,
    #[command(flatten)]
    settings: AgentFlags,
}

impl CompareCommand {
    /// Runs the comparison and writes what it gave.
    pub fn run(&self) -> Result<()> {
        if asks_for_help(&self.policies) {
            return write(&policy::help());
        }
        self.check_names()?;
        let config = self.settings.effective()?;
        let csv = self.make_places()?;
        let checkpoints = self.checkpoint.iter().map(PathBuf::as_path);
        let learned = learners::read(checkpoints, &self.device.open()?)?;
        let numbers: Vec<Option<u32>> = match self.robots.as_slice() {
            [] => vec![None],
            robots => robots.iter().copied().map(Some).collect(),
        };
        let added = self.read_added()?;
        let mut report = Report::default();
        for n_robots in numbers {
            let mut worlds = self.worlds.open(self.needs_scouts(), n_robots, |model| {
                self.policies(model, &learned).map(|_| ())
            })?;
            let arena = &mut worlds.arena;
            let dashboard = self
                .watch
                .map(|address| OwnDashboard::start(arena.instance(), address))
                .transpose()?;
            if let Some(dashboard) = &dashboard {
                tracing::info!("watch at {}", dashboard.url());
            }
            let comparison = Comparison {
                policies: self.policies_on(arena, &learned)?,
                teams: self.team.clone(),
                seeds: self.worlds.seeds(),
                steps: self.worlds.steps(arena.info())?,
                recent_steps: self.recent_steps,
                config: config.clone(),
                learned: learned.clone(),
                first_state_known: self.first_state_known,
            };
            self.check_added(&added, &comparison, arena.info())?;
            let results = run_comparison(arena, &comparison)?;
            if let Some(directory) = &self.figures {
                draw_step(directory, arena, &results)?;
            }
            let policies = &comparison.policies;
            report.baseline = self.baseline(arena.model(), arena.lacks_model(), policies)?;
            report.add(axis_label(arena.model()), results);
        }
        self.tell(&report, added, &config, csv)
    }

    fn tell(
        &self,
        report: &Report,
        added: Vec<PolicyRun>,
        config: &AgentConfig,
        csv: Option<RunsFile>,
    ) -> Result<()> {
        let fits = check_fire(&added, &report.runs);
        // What was measured is kept in any case.
        let added = if fits.is_ok() { added } else { Vec::new() };
        let all = [&*report.runs, &*added].concat();
        write(&render_table(&all, &report.baseline))?;
        if let Some(csv) = csv {
            csv.replace(&all)?;
        }
        fits?;
        if let Some(directory) = &self.tensorboard {
            write_events(directory, &report.runs)?;
        }
        match &self.figures {
            Some(directory) => draw(directory, report, &all, config),
            None => Ok(()),
        }
    }

    fn read_added(&self) -> Result<Vec<PolicyRun>> {
        let mut added = Vec::new();
        for path in &self.add {
            let runs = read_runs(path).context("--add")?;
            ensure!(
                !runs.is_empty(),
                "--add: {}: expected rows, got none",
                path.display()
            );
            added.extend(runs);
        }
        added.iter_mut().for_each(|run| run.is_added = true);
        Ok(added)
    }

    /// Checks the rows of `--add` before a comparison runs; rows of another number of robots belong to another one.
    fn check_added(
        &self,
        added: &[PolicyRun],
        comparison: &Comparison,
        info: &ServerInfo,
    ) -> Result<()> {
        let robots = info.n_robots;
        let is_here = |run: &&PolicyRun| run.robots == robots || !self.robots.contains(&run.robots);
        let added: Vec<PolicyRun> = added.iter().filter(is_here).cloned().collect();
        let policies = comparison.policies.iter();
        let policies: Vec<&str> = policies.map(|policy| &*policy.name).collect();
        let worlds = CommonWorlds {
            fingerprint: info.worlds_fingerprint.clone(),
            seeds: comparison.seeds.clone().collect(),
            steps: comparison.steps,
            moves: Some(info.n_moves),
            robots: Some(robots),
            recent_steps: Some(comparison.recent_steps),
        };
        check_added(&added, &policies, &worlds).context("--add")
    }

    /// Locks the CSV file and makes the folders of the files to come.
    fn make_places(&self) -> Result<Option<RunsFile>> {
        let folders = [self.figures.as_deref(), self.tensorboard.as_deref()];
        folders.into_iter().flatten().try_for_each(make_folder)?;
        lock_csv(self.csv.as_deref())
    }

    /// The policies on an arena's worlds; of the ladder those that need no model, if there is none.
    fn policies_on(&self, arena: &Arena, learned: &Learned) -> Result<Vec<Policy>> {
        let mut policies = self.policies(arena.model(), learned)?;
        if arena.lacks_model() && self.policies.is_empty() && !self.has_teams() {
            policies.retain(|policy| !policy.belief.knows_model);
        }
        Ok(policies)
    }

    /// Refuses what no server can fly before one is waited for.
    fn check_names(&self) -> Result<()> {
        let mut policies = self.policies.iter().filter(|name| *name != OPTIONS);
        policies.try_for_each(|name| policy::check_name(name))?;
        let mut baseline = self.baseline.iter();
        let checked = baseline.try_for_each(|name| policy::check_name(name));
        checked.context("--baseline")
    }

    fn policies(&self, model: &Model, learned: &Learned) -> Result<Vec<Policy>> {
        let named = |name: &String| Policy::named(name, model);
        let with_options = |name: &String| {
            if name == OPTIONS {
                options(model, learned)
            } else {
                Ok(vec![named(name)?])
            }
        };
        let policies = match self.policies.as_slice() {
            [] if self.has_teams() => vec![named(&OF_TEAMS.to_owned())?],
            [] => ladder(model, learned),
            names => {
                let policies = names.iter().map(with_options);
                policies.collect::<Result<Vec<_>>>()?.concat()
            }
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
        self.baseline(model, false, &policies)?;
        policies
            .iter()
            .try_for_each(|policy| policy.check(learned))?;
        Ok(policies)
    }

    /// Whether there is more to compare than policies of a robot alone in its world.
    fn has_teams(&self) -> bool {
        let of_task = self.worlds.task().map(|task| task.robots);
        let mut robots = self.robots.iter().copied().chain(of_task);
        robots.any(|robots| robots > 1) || self.team != [Team::Alone]
    }

    /// The name of the one that was asked for; else of one of the policies, if these are of teams or of options.
    fn baseline(&self, model: &Model, lacks_model: bool, policies: &[Policy]) -> Result<String> {
        if let Some(name) = &self.baseline {
            return Ok(Policy::named(name, model).context("--baseline")?.name);
        }
        let mut policies = policies.iter();
        let found = if self.policies.iter().any(|name| name == OPTIONS) {
            policies.find(|policy| matches!(policy.goal, Goal::Option(_)))
        } else {
            policies.next().filter(|_| self.has_teams())
        };
        let usual = if lacks_model {
            "coverage"
        } else {
            "shooting_exploit"
        };
        Ok(found.map_or(usual, |policy| &policy.name).to_owned())
    }

    fn needs_scouts(&self) -> bool {
        let is_clairvoyant = |name: &String| {
            let belief = policy::belief_of(name);
            belief.is_some_and(|belief| belief.input == Input::NextStates)
        };
        match self.policies.as_slice() {
            [] => !self.has_teams(),
            names => names.iter().any(is_clairvoyant),
        }
    }
}

/// What came out, for all numbers of robots.
#[derive(Default)]
struct Report {
    runs: Vec<PolicyRun>,
    /// The same for all numbers of robots.
    fire_cells: Vec<f32>,
    axis_label: String,
    baseline: String,
}

impl Report {
    fn add(&mut self, axis_label: String, results: Results) {
        self.runs.extend(results.runs);
        self.fire_cells = results.fire_cells;
        self.axis_label = axis_label;
    }
}

fn draw(directory: &Path, report: &Report, all: &[PolicyRun], config: &AgentConfig) -> Result<()> {
    let label = &*report.axis_label;
    draw_ladder(&directory.join("ladder.svg"), all, label)?;
    let fire_cells = Some(&*report.fire_cells);
    draw_rewards(
        &directory.join("rewards.svg"),
        &report.runs,
        label,
        fire_cells,
    )?;
    draw_teams(&directory.join("teams.svg"), all, label)?;
    let settings = toml::to_string(config)?;
    let path = directory.join("agent.toml");
    replace_file(&path, settings.as_bytes(), Readers::Any)
}

/// Each option, the rule and the learned choice, on the belief of the decisions that were learned.
fn options(model: &Model, learned: &Learned) -> Result<Vec<Policy>> {
    let decisions = learned.get::<LearnedDecisions>();
    let decisions =
        decisions.context("--policies options: expected --checkpoint FILE of decisions")?;
    Ok(policy::options_table(decisions.belief, model))
}

/// The ladder, with the policies on what was learned beside those on the known model, the autoencoder's below them.
fn ladder(model: &Model, learned: &Learned) -> Vec<Policy> {
    let of_learned = policy::of_learned(learned, model).into_iter();
    let (network, others): (Vec<_>, Vec<_>) =
        of_learned.partition(|policy| policy.belief.decides());
    let mut ladder = policy::ladder(model);
    let mut insert = |after: &dyn Fn(&Policy) -> bool, policies: Vec<Policy>| {
        let at = ladder.iter().rposition(after).map_or(0, |last| last + 1);
        ladder.splice(at..at, policies);
    };
    insert(&|policy| policy.belief.knows_model, others);
    insert(&|policy| *policy.belief == NONE, network);
    ladder
}

/// Runs a comparison with a bar that shows how far it is.
pub(super) fn run_comparison(arena: &mut Arena, comparison: &Comparison) -> Result<Results> {
    let n_seeds = comparison.seeds.end - comparison.seeds.start;
    let n_steps = comparison.n_contestants() as u64 * n_seeds * comparison.steps;
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
    results
}

/// Draws a step of one robot's world; of several robots none is drawn.
fn draw_step(directory: &Path, arena: &mut Arena, results: &Results) -> Result<()> {
    if arena.n_robots() > 1 {
        return Ok(());
    }
    let Some(snapshot) = &results.snapshot else {
        tracing::warn!("no snapshot: it needs published hidden states");
        return Ok(());
    };
    let Some(observation) = arena.full_observation(snapshot.seed, snapshot.step)? else {
        tracing::warn!(
            "no snapshot: it needs one world more than the seeds and a server with --coverage client"
        );
        return Ok(());
    };
    let path = directory.join("snapshot.svg");
    draw_snapshot(&path, arena.model(), snapshot, &observation)
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
