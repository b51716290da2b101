//! `suite`: runs policies on the test worlds of tasks, and gives each policy one score.
//!
//! The rows of a policy on a task are in the file `FOLDER/TASK/POLICY.csv`.

use super::compare::run_comparison;
use super::shared::{asks_for_help, make_folder, write};
use super::trainings::{Trained, Trainings};
use crate::benchmark::arena::{Arena, MAX_BATCH};
use crate::benchmark::compare::Comparison;
use crate::benchmark::report::PolicyRun;
use crate::benchmark::report::common_worlds::{World, check_worlds};
use crate::benchmark::report::runs_file::{csv_files, file_of, read_tasks, write_runs};
use crate::benchmark::report::suite::{CEILING, FLOOR, render_suite};
use crate::benchmark::team::Team;
use crate::client::worlds::Worlds;
use crate::flags::AgentFlags;
use anyhow::{Context, Result, ensure};
use clap::Args;
use emberwatch_belief::merit::RECENT_STEPS;
use emberwatch_learning::beliefs::WorldForm;
use emberwatch_learning::config::AgentConfig;
use emberwatch_learning::learned::Learned;
use emberwatch_learning::policy::{self, Policy};
use emberwatch_protocol::task::Task;
use emberwatch_sim::config::{Checked, ServerConfig};
use sha2::{Digest, Sha256};
use std::collections::BTreeSet;
use std::fs::File;
use std::io::copy;
use std::ops::Range;
use std::path::PathBuf;

/// Run policies on the test worlds of tasks, with one score per policy.
#[derive(Args)]
pub struct SuiteCommand {
    /// Tasks, separated by commas, as names or task files
    #[arg(long, value_delimiter = ',', default_values = Task::built_in_names())]
    tasks: Vec<String>,
    /// Policies, separated by commas (`help` lists them); random_walk (score 0) and oracle_ahead (score 1) always run
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
    /// Folder for results, with one CSV file per task and policy; a file is kept unless the program, the checkpoint, the
    /// settings or the task's worlds have changed
    #[arg(long, value_name = "FOLDER", default_value = "suite")]
    out: PathBuf,
    /// Number of worlds per task, from the first test seed on [default: all]
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    worlds: Option<u64>,
    #[command(flatten)]
    settings: AgentFlags,
}

impl SuiteCommand {
    /// Performs all missing trainings and runs, and writes the scores of all policies.
    pub fn run(&self) -> Result<()> {
        if asks_for_help(&self.policies) {
            return write(&policy::help());
        }
        let mut names = self.policies.iter();
        names.try_for_each(|name| policy::check_name(name))?;
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
        let build = build()?;
        for task in &self.tasks {
            let settings = ServerConfig {
                task: task.clone(),
                ..ServerConfig::default()
            };
            let plan = self.plan(settings.check()?, &config, &build);
            plans.push(plan.with_context(|| format!("task {task}"))?);
        }
        for plan in &plans {
            let own = self.carry_out(plan);
            runs.extend(own.with_context(|| format!("task {}", plan.task().name))?);
        }
        write(&render_suite(&runs))
    }

    /// Returns the plan for a task, and reads the rows in its folder. `build` is the digest of the program.
    fn plan(&self, settings: Checked, config: &AgentConfig, build: &str) -> Result<Plan> {
        let task = settings.task.as_ref().expect("invariant: it has a task");
        let mut seeds = task.test_seeds.clone();
        if let Some(n) = self.worlds {
            seeds.end = seeds.end.min(seeds.start.saturating_add(n));
        }
        let arena = open(settings.clone(), &seeds, 1)?;
        let longest = arena.info().shortest_episode().unwrap_or(u64::MAX);
        ensure!(
            task.world.max_steps <= longest,
            "max_steps: expected at most {longest}, the length of the shortest episode, got {}",
            task.world.max_steps
        );
        let mut policies: Vec<Policy> = Vec::new();
        let names = self.policies.iter().map(|name| &**name);
        for name in [FLOOR, CEILING].into_iter().chain(names) {
            let policy = Policy::named(name, &arena.model)?;
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
            recent_steps: RECENT_STEPS,
            config: config.clone(),
            learned: Learned::default(),
            first_state_known: false,
        };
        let folder = self.out.join(&task.name);
        make_folder(&folder)?;
        let mut found = Vec::new();
        for file in csv_files(&folder)? {
            let runs = read_tasks([file.clone()])?;
            found.extend(runs.into_iter().map(|run| (file.clone(), run)));
        }
        Ok(Plan {
            worlds: comparison.worlds(arena.info()),
            comparison,
            form: WorldForm::of(&arena.model, arena.shape()),
            build: build.into(),
            settings,
            folder,
            found,
        })
    }

    /// Trains what the policies of a task need, then runs each policy whose rows are missing or outdated. Returns all
    /// rows, including those of other programs. Warns about policies that cannot run or were measured on other worlds,
    /// and leaves them out.
    fn carry_out(&self, plan: &Plan) -> Result<Vec<PolicyRun>> {
        let (task, mut runs, mut missing) = (&plan.task().name, Vec::new(), Vec::new());
        for policy in plan.others() {
            let is_others =
                |run: &&PolicyRun| run.policy == policy && run.policy_fingerprint.is_empty();
            let rows = plan.found.iter().map(|(_, run)| run);
            match plan.checked(policy, rows.filter(is_others)) {
                Ok(rows) => runs.extend(rows),
                Err(reason) => tracing::warn!("task {task}: {policy} is left out: {reason:#}"),
            }
        }
        for policy in &plan.comparison.policies {
            let name = &policy.name;
            let trained = match self.prepare(plan, policy) {
                Ok(trained) => trained,
                Err(reason) => {
                    tracing::warn!("task {task}: {name} is not run: {reason:#}");
                    continue;
                }
            };
            let fingerprint = plan.fingerprint(&trained.learned);
            match plan.kept(policy, &fingerprint) {
                Ok(rows) => {
                    tracing::info!("task {task}: {} rows of {name} kept", rows.len());
                    runs.extend(rows);
                }
                Err(reason) => {
                    tracing::info!("task {task}: {name} is run: {reason:#}");
                    missing.push((policy, trained, fingerprint));
                }
            }
        }
        if missing.is_empty() {
            return Ok(runs);
        }
        let n_worlds = plan.worlds.len() as u32;
        let mut arena = open(plan.settings.clone(), &plan.comparison.seeds, n_worlds)?;
        for (policy, trained, fingerprint) in missing {
            let comparison = Comparison {
                policies: vec![policy.clone()],
                learned: trained.learned,
                ..plan.comparison.clone()
            };
            let mut new = run_comparison(&mut arena, &comparison)?.runs;
            for run in &mut new {
                run.task.clone_from(task);
                run.training_seconds = trained.seconds;
                run.policy_fingerprint.clone_from(&fingerprint);
            }
            write_runs(&plan.file_of(policy), &new)?;
            runs.extend(new);
        }
        Ok(runs)
    }

    /// Reads a policy's checkpoints. With `--train`, first runs the missing trainings.
    fn prepare(&self, plan: &Plan, policy: &Policy) -> Result<Trained> {
        ensure!(
            !(plan.task().world.is_recorded() && policy.belief.knows_model),
            "it needs a known model, and recorded worlds have none"
        );
        let is_own =
            |run: &PolicyRun| run.policy == policy.name && !run.policy_fingerprint.is_empty();
        ensure!(
            plan.in_file_of(policy).all(is_own),
            "{} has rows of another policy or program: move the file",
            plan.file_of(policy).display()
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

/// Simulates worlds of a task, and acquires them.
fn open(mut settings: Checked, seeds: &Range<u64>, n_worlds: u32) -> Result<Arena> {
    settings.config.seed = seeds.start;
    let settings = settings.with_worlds(n_worlds.min(MAX_BATCH))?;
    Arena::open(Worlds::simulate(settings)?, n_worlds)
}

/// Returns a digest of the running program. A program that is built anew from changed files has another digest, even
/// if its file has been replaced since the start.
fn build() -> Result<String> {
    let (path, mut hash) = ("/proc/self/exe", Sha256::new());
    let read = File::open(path).and_then(|mut file| copy(&mut file, &mut hash));
    read.with_context(|| format!("read {path}"))?;
    Ok(format!("{:x}", hash.finalize()))
}

/// The policies and worlds of one task of a suite, and the rows that its folder had at the start.
struct Plan {
    /// Settings of the task's worlds.
    settings: Checked,
    worlds: Vec<World>,
    /// The comparison of all policies, without checkpoints.
    comparison: Comparison,
    form: WorldForm,
    /// Digest of the program.
    build: String,
    folder: PathBuf,
    /// The rows of all files, each with its file.
    found: Vec<(PathBuf, PolicyRun)>,
}

impl Plan {
    fn task(&self) -> &Task {
        let task = self.settings.task.as_ref();
        task.expect("invariant: a suite's settings have a task")
    }

    /// Returns 16 hexadecimal digits that identify all that a policy's actions depend on, except its name and worlds.
    fn fingerprint(&self, learned: &Learned) -> String {
        let Comparison { teams, config, .. } = &self.comparison;
        let config = toml::to_string(config).expect("invariant: settings serialise");
        let (build, learned) = (&self.build, &learned.digests);
        let text = format!("{build}\n{config}\n{teams:?}\n{learned:?}");
        format!("{:x}", Sha256::digest(text))[..16].into()
    }

    /// Returns the policies of other programs, whose rows have no fingerprint.
    fn others(&self) -> BTreeSet<&str> {
        let own: Vec<&str> = self
            .comparison
            .policies
            .iter()
            .map(|it| &*it.name)
            .collect();
        let rows = self.found.iter().map(|(_, run)| run);
        let others = rows.filter(|run| run.policy_fingerprint.is_empty());
        let others = others.map(|run| &*run.policy);
        others.filter(|name| !own.contains(name)).collect()
    }

    fn file_of(&self, policy: &Policy) -> PathBuf {
        self.folder.join(file_of(&policy.name))
    }

    /// Returns the rows in a policy's file.
    fn in_file_of(&self, policy: &Policy) -> impl Iterator<Item = &PolicyRun> {
        let file = self.file_of(policy);
        let found = self.found.iter().filter(move |(path, _)| *path == file);
        found.map(|(_, run)| run)
    }

    /// Returns the rows in a policy's file, if they are from this task's worlds and have this fingerprint.
    fn kept(&self, policy: &Policy, fingerprint: &str) -> Result<Vec<PolicyRun>> {
        let rows = self.checked(&policy.name, self.in_file_of(policy))?;
        ensure!(
            rows.iter().all(|run| run.policy_fingerprint == fingerprint),
            "its rows are from another build, checkpoint or settings"
        );
        Ok(rows)
    }

    /// Returns the rows of a policy on this suite's seeds, if there is one for each of the task's worlds.
    fn checked<'a>(
        &self,
        policy: &str,
        rows: impl Iterator<Item = &'a PolicyRun>,
    ) -> Result<Vec<PolicyRun>> {
        let seeds = &self.comparison.seeds;
        let rows = rows.filter(|run| seeds.contains(&run.world_seed));
        let rows: Vec<PolicyRun> = rows.cloned().collect();
        check_worlds(policy, &rows, &self.worlds)?;
        Ok(rows)
    }
}
