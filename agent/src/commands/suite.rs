//! `suite`: runs policies on the test worlds of tasks, and gives each policy one score.
//!
//! The rows of a policy on a task are in the file `FOLDER/TASK/POLICY.csv`.

use super::compare::run_comparison;
use super::shared::{make_folder, write};
use super::trainings::{Trained, Trainings};
use crate::acting::team::Team;
use crate::benchmark::compare::Comparison;
use crate::benchmark::compared_worlds::{ComparedWorlds, MAX_BATCH};
use crate::benchmark::report::common_worlds::{World, check_worlds};
use crate::benchmark::report::runs_file::{csv_files, file_of, read_tasks, write_runs};
use crate::benchmark::report::suite::{CEILING, FLOOR, render_suite};
use crate::benchmark::report::{PolicyRun, groups};
use crate::client::worlds::Worlds;
use crate::flags::AgentFlags;
use anyhow::{Context, Result, ensure};
use clap::Args;
use emberwatch_acting::beliefs::WorldForm;
use emberwatch_acting::config::AgentConfig;
use emberwatch_acting::learned::Learned;
use emberwatch_acting::policy::Policy;
use emberwatch_protocol::task::Task;
use emberwatch_sim::config::{Checked, ServerConfig};
use emberwatch_sim::snapshot::Settings;
use std::path::PathBuf;

/// Run policies on the test worlds of tasks, with one score per policy.
#[derive(Args)]
pub struct SuiteCommand {
    /// Tasks, separated by commas, as names or task files
    #[arg(long, value_delimiter = ',', default_values = Task::built_in_names())]
    tasks: Vec<String>,
    /// Policies, separated by commas, listed below; random_walk (score 0) and oracle_ahead (score 1) always run
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "coverage,beam,learned_beam,learned_policy"
    )]
    policies: Vec<String>,
    /// Folder of checkpoints for learned policies, written by --train or by `train --task TASK --out FOLDER/TASK/LEARNER`
    #[arg(long, value_name = "FOLDER")]
    checkpoints: Option<PathBuf>,
    /// First train what the policies need and --checkpoints lacks
    #[arg(long, requires = "checkpoints")]
    train: bool,
    /// World steps of each training, summed over its worlds [default: from the settings]
    #[arg(long, value_name = "STEPS", requires = "train", value_parser = clap::value_parser!(u64).range(1..))]
    train_steps: Option<u64>,
    /// Folder for results, with one CSV file per task and policy; files of other policies on the same worlds are scored,
    /// too
    #[arg(long, value_name = "FOLDER", default_value = "suite")]
    out: PathBuf,
    /// Number of worlds per task, from the first test seed on [default: all]
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    worlds: Option<u64>,
    #[command(flatten)]
    settings: AgentFlags,
}

impl SuiteCommand {
    pub fn run(&self) -> Result<()> {
        let config = self.settings.effective()?;
        if let Some(folder) = &self.checkpoints {
            if self.train {
                make_folder(folder)?;
            }
            ensure!(
                folder.is_dir(),
                "--checkpoints: expected a folder, got {}",
                folder.display()
            );
        }
        // Errors in policies and worlds come before any run.
        let (mut plans, mut runs) = (Vec::new(), Vec::new());
        for task in &self.tasks {
            let settings = ServerConfig {
                task: task.clone(),
                ..ServerConfig::default()
            };
            let plan = self.plan(settings.check()?, &config);
            plans.push(plan.with_context(|| format!("task {task}"))?);
        }
        for plan in &plans {
            let own = self.carry_out(plan);
            runs.extend(own.with_context(|| format!("task {}", plan.task().name))?);
        }
        write(&render_suite(&runs))
    }

    fn plan(&self, settings: Checked, config: &AgentConfig) -> Result<Plan> {
        let task = settings.task.as_ref().expect("invariant: it has a task");
        let mut seeds = task.test_seeds.clone();
        if let Some(n) = self.worlds {
            seeds.end = seeds.end.min(seeds.start.saturating_add(n));
        }
        if let Some(states) = &settings.recorded {
            let (longest, got) = (states.recorded.n_steps(), task.world.max_steps);
            ensure!(
                got <= longest,
                "max_steps: expected at most {longest}, the length of the shortest episode, got {got}"
            );
        }
        let mut policies: Vec<Policy> = Vec::new();
        let names = self.policies.iter().map(|name| &**name);
        for name in [FLOOR, CEILING].into_iter().chain(names) {
            let policy = Policy::named(name, &settings.model)?;
            if !policies.contains(&policy) {
                policies.push(policy);
            }
        }
        let several = task.world.robots > 1;
        let comparison = Comparison {
            policies,
            teams: vec![if several { Team::Joint } else { Team::Alone }],
            seeds,
            steps: task.world.max_steps,
            config: config.clone(),
            learned: Learned::default(),
        };
        let folder = self.out.join(&task.name);
        make_folder(&folder)?;
        let own: Vec<PathBuf> = comparison
            .policies
            .iter()
            .map(|policy| folder.join(file_of(&policy.name)))
            .collect();
        let mut others = csv_files(&folder)?;
        others.retain(|file| !own.contains(file));
        Ok(Plan {
            worlds: comparison.worlds(&Settings::of(&settings).worlds_fingerprint()),
            comparison,
            form: WorldForm::of(&settings.model, settings.shape),
            others: read_tasks(others)?,
            settings,
            folder,
        })
    }

    /// Warns about policies that cannot run or were measured on other worlds, and leaves them out.
    fn carry_out(&self, plan: &Plan) -> Result<Vec<PolicyRun>> {
        let task = &plan.task().name;
        let mut ready = Vec::new();
        for policy in &plan.comparison.policies {
            match self.prepare(plan, policy) {
                Ok(trained) => ready.push((policy, trained)),
                Err(reason) => {
                    tracing::warn!("task {task}: {} is not run: {reason:#}", policy.name);
                }
            }
        }
        let mut runs = plan.comparable();
        // Opened after all trainings, because a lease that is not used for long ends.
        let mut worlds = plan.open()?;
        for (policy, trained) in ready {
            let comparison = Comparison {
                policies: vec![policy.clone()],
                learned: trained.learned,
                ..plan.comparison.clone()
            };
            let mut new = run_comparison(&mut worlds, &comparison)?;
            for run in &mut new {
                run.task.clone_from(task);
                run.training_seconds = trained.seconds;
            }
            write_runs(&plan.folder.join(file_of(&policy.name)), &new)?;
            runs.extend(new);
        }
        Ok(runs)
    }

    fn prepare(&self, plan: &Plan, policy: &Policy) -> Result<Trained> {
        ensure!(
            !(plan.task().world.is_recorded() && policy.belief.knows_model),
            "it needs a known model, and recorded worlds have none"
        );
        ensure!(
            self.checkpoints.is_some() || !policy.needs_checkpoint(),
            "it needs a checkpoint: add --checkpoints FOLDER"
        );
        let folder = self.checkpoints.clone().unwrap_or_default();
        let trainings = Trainings {
            folder: folder.join(&plan.task().name),
            settings: &plan.settings,
            policy,
            config: &plan.comparison.config,
            steps: self.train_steps,
        };
        trainings.complete(self.train, &plan.form)
    }
}

struct Plan {
    settings: Checked,
    worlds: Vec<World>,
    comparison: Comparison,
    form: WorldForm,
    folder: PathBuf,
    others: Vec<PolicyRun>,
}

impl Plan {
    fn task(&self) -> &Task {
        let task = self.settings.task.as_ref();
        task.expect("invariant: a suite's settings have a task")
    }

    fn open(&self) -> Result<ComparedWorlds> {
        let n_worlds = self.worlds.len() as u32;
        let mut settings = self.settings.clone();
        settings.config.seed = self.comparison.seeds.start;
        let settings = settings.with_worlds(n_worlds.min(MAX_BATCH))?;
        ComparedWorlds::open(Worlds::simulate(settings)?, n_worlds)
    }

    fn comparable(&self) -> Vec<PolicyRun> {
        let (task, seeds) = (&self.task().name, &self.comparison.seeds);
        let mut comparable = Vec::new();
        for group in groups(&self.others) {
            let policy = group.policy;
            let runs = group.runs.into_iter();
            let runs: Vec<&PolicyRun> = runs.filter(|it| seeds.contains(&it.world_seed)).collect();
            match check_worlds(policy, runs.iter().copied(), &self.worlds) {
                Ok(()) => comparable.extend(runs.into_iter().cloned()),
                Err(reason) => tracing::warn!("task {task}: {policy} is left out: {reason:#}"),
            }
        }
        comparable
    }
}
