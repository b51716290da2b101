//! `compare`: runs policies on the same worlds, and reports their results.

use super::shared::{check_csv, make_folder, open_device, write};
use super::worlds::{Source, WorldFlags};
use crate::acting::team::Team;
use crate::benchmark::compare::{Comparison, compare};
use crate::benchmark::compared_worlds::ComparedWorlds;
use crate::benchmark::report::common_worlds::check_worlds;
use crate::benchmark::report::runs_file::{read_runs, write_runs};
use crate::benchmark::report::{
    PolicyRun, draw_ladder, draw_rewards, draw_teams, figures::FIRE_CELLS_PER_STEP, groups,
    render_table,
};
use crate::flags::AgentFlags;
use anyhow::{Context, Result, ensure};
use clap::Args;
use emberwatch_acting::config::AgentConfig;
use emberwatch_acting::learned::Learned;
use emberwatch_acting::policy::{self, Policy};
use emberwatch_learning::file::replace_file;
use emberwatch_learning::learners;
use emberwatch_network::DEVICES;
use emberwatch_protocol::Model;
use emberwatch_protocol::control::ServerInfo;
use emberwatch_protocol::task::Task;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

const PROGRESS_INTERVAL: Duration = Duration::from_secs(10);

const TEAM_POLICY: &str = "beam";

/// Compare policies on the same worlds.
#[derive(Args)]
pub struct CompareCommand {
    /// Policies, separated by commas, as names or as BELIEF/PLANNER/GOAL, listed below [default: a ladder of policies
    /// from random to oracle; with teams: beam]
    #[arg(long, value_delimiter = ',')]
    policies: Vec<String>,
    /// Checkpoint of `train`, which adds learned policies to the ladder; may be given once per learner
    #[arg(long, value_name = "FILE")]
    checkpoint: Vec<PathBuf>,
    /// Policy to compare the other policies with, paired by world [default: shooting; with teams: the first
    /// policy; on recorded worlds without --model: coverage]
    #[arg(long)]
    baseline: Option<String>,
    /// Write a CSV file with one row per policy and world
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Draw ladder.svg, rewards.svg and teams.svg into this directory
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
    /// Add the rows of a CSV file measured elsewhere on the same worlds, such as by `emberwatch.benchmark` in Python;
    /// may be given several times
    #[arg(long, value_name = "FILE")]
    add: Vec<PathBuf>,
    /// How the robots of a world act together: kinds of team, separated by commas
    #[arg(long, value_delimiter = ',', default_value = "alone")]
    team: Vec<Team>,
    /// Device for networks: cpu, cuda or metal
    #[arg(long, value_name = "DEVICE", default_value = "cpu", value_parser = DEVICES)]
    device: String,
    #[command(flatten, next_help_heading = "Worlds")]
    worlds: WorldFlags,
    #[command(flatten)]
    settings: AgentFlags,
}

impl CompareCommand {
    pub fn run(&self) -> Result<()> {
        let config = self.settings.effective()?;
        self.make_places()?;
        let checkpoints = self.checkpoint.iter().map(PathBuf::as_path);
        let learned = learners::read(checkpoints, &open_device(&self.device)?)?;
        let robots = self.worlds.robots();
        let numbers: Vec<Option<u32>> = match robots.as_slice() {
            [] => vec![None],
            robots => robots.iter().copied().map(Some).collect(),
        };
        let added = self.read_added()?;
        // Errors in settings come before any run.
        let sources = numbers.into_iter().map(|number| self.worlds.source(number));
        let sources = sources.collect::<Result<Vec<Source>>>()?;
        let has_teams = self.has_teams(sources[0].task());
        let mut report = Report::default();
        for source in sources {
            let (seeds, task) = (self.worlds.seeds(&source), source.task().cloned());
            let worlds = &mut source.open((seeds.end - seeds.start) as u32)?;
            let mut policies = self.policies(&worlds.model, &learned, has_teams)?;
            if worlds.lacks_model() && self.policies.is_empty() && !has_teams {
                policies.retain(|policy| !policy.belief.knows_model);
            }
            report.baseline = self.baseline(worlds, &policies, has_teams)?;
            let comparison = Comparison {
                policies,
                teams: self.team.clone(),
                seeds,
                steps: self.worlds.steps(task.as_ref(), worlds.info())?,
                config: config.clone(),
                learned: learned.clone(),
            };
            self.check_added(&added, &comparison, worlds.info())?;
            report.axis_label = axis_label(&worlds.model);
            report.runs.extend(run_comparison(worlds, &comparison)?);
        }
        self.write_results(&report, added, &config)
    }

    fn write_results(
        &self,
        report: &Report,
        added: Vec<PolicyRun>,
        config: &AgentConfig,
    ) -> Result<()> {
        let all = [&*report.runs, &*added].concat();
        if let Some(csv) = &self.csv {
            write_runs(csv, &all)?;
        }
        write(&render_table(&all, &report.baseline))?;
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

    /// Skips rows whose number of robots is another entry of `--robots`.
    fn check_added(
        &self,
        added: &[PolicyRun],
        comparison: &Comparison,
        info: &ServerInfo,
    ) -> Result<()> {
        let (robots, all) = (info.n_robots, self.worlds.robots());
        let is_here = |run: &&PolicyRun| run.robots == robots || !all.contains(&run.robots);
        let added: Vec<PolicyRun> = added.iter().filter(is_here).cloned().collect();
        let fingerprint = info.worlds_fingerprint.as_deref().unwrap_or_default();
        let worlds = comparison.worlds(fingerprint);
        for group in groups(&added) {
            let policy = group.policy;
            let mut own = comparison.policies.iter();
            ensure!(
                own.all(|own| own.name != policy),
                "--add: policy {policy:?}: expected a name that no compared policy has"
            );
            check_worlds(policy, group.runs.iter().copied(), &worlds).context("--add")?;
        }
        Ok(())
    }

    fn make_places(&self) -> Result<()> {
        self.figures.as_deref().map_or(Ok(()), make_folder)?;
        self.csv.as_deref().map_or(Ok(()), check_csv)
    }

    fn policies(&self, model: &Model, learned: &Learned, has_teams: bool) -> Result<Vec<Policy>> {
        let named = |name: &String| Policy::named(name, model);
        let policies = match self.policies.as_slice() {
            [] if has_teams => vec![Policy::named(TEAM_POLICY, model)?],
            [] => policy::ladder(model, learned),
            names => names.iter().map(named).collect::<Result<_>>()?,
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
        policies
            .iter()
            .try_for_each(|policy| policy.check(learned))?;
        Ok(policies)
    }

    fn has_teams(&self, task: Option<&Task>) -> bool {
        let of_task = task.map(|task| task.world.robots);
        let mut robots = self.worlds.robots().into_iter().chain(of_task);
        robots.any(|robots| robots > 1) || self.team != [Team::Alone]
    }

    fn baseline(
        &self,
        worlds: &ComparedWorlds,
        policies: &[Policy],
        has_teams: bool,
    ) -> Result<String> {
        if let Some(name) = &self.baseline {
            let policy = Policy::named(name, &worlds.model);
            return Ok(policy.context("--baseline")?.name);
        }
        Ok(match policies.first() {
            Some(first) if has_teams => first.name.clone(),
            _ if worlds.lacks_model() => "coverage".into(),
            _ => "shooting".into(),
        })
    }
}

#[derive(Default)]
struct Report {
    runs: Vec<PolicyRun>,
    axis_label: String,
    baseline: String,
}

fn draw(directory: &Path, report: &Report, all: &[PolicyRun], config: &AgentConfig) -> Result<()> {
    let label = &*report.axis_label;
    draw_ladder(&directory.join("ladder.svg"), all, label)?;
    let rewards = directory.join("rewards.svg");
    draw_rewards(&rewards, &report.runs, label)?;
    draw_teams(&directory.join("teams.svg"), all, label)?;
    let settings = toml::to_string(config)?;
    let path = directory.join("agent.toml");
    replace_file(&path, settings.as_bytes())
}

pub(super) fn run_comparison(
    worlds: &mut ComparedWorlds,
    comparison: &Comparison,
) -> Result<Vec<PolicyRun>> {
    let n_seeds = comparison.seeds.end - comparison.seeds.start;
    let n_contestants = comparison.entries().len() as u64;
    let n_steps = n_contestants * n_seeds * comparison.steps;
    let (mut done, mut logged, mut last_policy) = (0, Instant::now(), String::new());
    compare(worlds, comparison, &mut |policy, steps| {
        if last_policy != policy || logged.elapsed() > PROGRESS_INTERVAL {
            tracing::info!(policy, done, of = n_steps, "comparing");
            (logged, last_policy) = (Instant::now(), policy.to_owned());
        }
        done += steps;
    })
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
