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
use crate::benchmark::report::runs_file::{csv_files, file_of, read_runs, write_runs};
use crate::benchmark::report::suite::{CEILING, FLOOR, TaskRuns, render_suite};
use crate::benchmark::team::Team;
use crate::client::errors::is_outage;
use crate::client::launch::OwnServer;
use crate::flags::AgentFlags;
use anyhow::{Context, Result, ensure};
use clap::Args;
use emberwatch_belief::merit::RECENT_STEPS;
use emberwatch_learning::beliefs::WorldForm;
use emberwatch_learning::config::AgentConfig;
use emberwatch_learning::learned::Learned;
use emberwatch_learning::policy::{self, Policy};
use emberwatch_protocol::Model;
use emberwatch_protocol::task::Task;
use sha2::{Digest, Sha256};
use std::collections::BTreeSet;
use std::ops::Range;
use std::path::PathBuf;

/// Run policies on the test worlds of tasks, with one score per policy.
#[derive(Args)]
pub struct SuiteCommand {
    /// Tasks, separated by commas, as names or task files
    #[arg(long, value_delimiter = ',', value_parser = Task::named, default_values = Task::built_in_names())]
    tasks: Vec<Task>,
    /// Policies, separated by commas (`help` lists them); random_walk (score 0) and oracle_ahead (score 1) always run
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "coverage,beam_exploit,learned_beam,learned_policy"
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
    /// Folder for results, with one CSV file per task and policy; a file is kept unless the programs, the checkpoint, the
    /// settings or the task's worlds have changed
    #[arg(long, value_name = "FOLDER", default_value = "suite")]
    out: PathBuf,
    /// Number of worlds per task, from the first test seed on [default: all]
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    worlds: Option<u64>,
    /// Path of emberwatch-server [default: in the folder of this program, or on PATH]
    #[arg(long, value_name = "PROGRAM")]
    server: Option<PathBuf>,
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
        match &self.checkpoints {
            Some(folder) if self.train => make_folder(folder)?,
            Some(folder) => ensure!(
                folder.is_dir(),
                "--checkpoints: expected a folder, got {}",
                folder.display()
            ),
            None => {}
        }
        // Errors in policies and worlds come before any run.
        let (mut plans, mut build) = (Vec::new(), String::new());
        for task in &self.tasks {
            let plan = self.plan(task, &config, &mut build);
            plans.push(plan.with_context(|| format!("task {}", task.name))?);
        }
        let mut results = Vec::new();
        for plan in plans {
            let task = plan.task.name.clone();
            let runs = self.carry_out(&plan);
            let runs = runs.with_context(|| format!("task {task}"))?;
            results.push(TaskRuns { task, runs });
        }
        write(&render_suite(&results))
    }

    /// Returns the plan for a task, and reads the rows in its folder. The first plan sets `build`.
    fn plan<'a>(
        &self,
        task: &'a Task,
        config: &AgentConfig,
        build: &mut String,
    ) -> Result<Plan<'a>> {
        let all = task.test_seeds.clone();
        let end = |n| all.end.min(all.start.saturating_add(n));
        let seeds = all.start..self.worlds.map_or(all.end, end);
        let (arena, server) = self.open(task, &seeds, 1)?;
        if build.is_empty() {
            *build = server.build()?;
        }
        let longest = arena.info().shortest_episode().unwrap_or(u64::MAX);
        ensure!(
            task.max_steps <= longest,
            "max_steps: expected at most {longest}, the length of the shortest episode, got {}",
            task.max_steps
        );
        let policies = self.policies(arena.model())?;
        let folder = self.out.join(&task.name);
        make_folder(&folder)?;
        let mut found = Vec::new();
        for file in csv_files(&folder)? {
            let runs = read_runs(&file)?;
            found.push((file, runs));
        }
        let several = task.robots > 1;
        let comparison = Comparison {
            policies: Vec::new(),
            teams: vec![if several { Team::Joint } else { Team::Alone }],
            seeds,
            steps: task.max_steps,
            recent_steps: RECENT_STEPS,
            config: config.clone(),
            learned: Learned::default(),
            first_state_known: false,
        };
        Ok(Plan {
            worlds: comparison.worlds(arena.info()),
            comparison,
            form: WorldForm::of(arena.model(), arena.shape()),
            build: build.clone(),
            task,
            policies,
            folder,
            found,
        })
    }

    /// Returns all policies of the command, each once.
    fn policies(&self, model: &Model) -> Result<Vec<Policy>> {
        let names = [FLOOR, CEILING].into_iter();
        let mut policies: Vec<Policy> = Vec::new();
        for name in names.chain(self.policies.iter().map(|name| &**name)) {
            let policy = Policy::named(name, model)?;
            if !policies.contains(&policy) {
                policies.push(policy);
            }
        }
        Ok(policies)
    }

    /// Trains what the policies of a task need, then runs each policy whose rows are missing or outdated. Returns all
    /// rows. Warns about policies that cannot run, and leaves them out.
    fn carry_out(&self, plan: &Plan<'_>) -> Result<Vec<PolicyRun>> {
        let (task, mut runs, mut missing) = (&plan.task.name, plan.of_others(), Vec::new());
        for policy in &plan.policies {
            let name = &policy.name;
            let trained = match self.prepare(plan, policy) {
                Ok(trained) => trained,
                Err(reason) if is_outage(&reason) => return Err(reason),
                Err(reason) => {
                    tracing::warn!("task {task}: {name} is not run: {reason:#}");
                    continue;
                }
            };
            let fingerprint = plan.fingerprint(policy, &trained.learned);
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
        let (mut arena, server) = self.open(plan.task, &plan.comparison.seeds, n_worlds)?;
        let is_same = plan.comparison.worlds(arena.info()) == plan.worlds;
        ensure!(
            is_same && server.build()? == plan.build,
            "the programs or the task's files have changed since the command began: run it again"
        );
        for (policy, trained, fingerprint) in missing {
            let comparison = Comparison {
                policies: vec![policy.clone()],
                learned: trained.learned,
                ..plan.comparison.clone()
            };
            let mut new = run_comparison(&mut arena, &comparison)?.runs;
            for run in &mut new {
                run.training_seconds = trained.seconds;
                run.policy_fingerprint.clone_from(&fingerprint);
            }
            write_runs(&plan.file_of(policy), &new)?;
            runs.extend(new);
        }
        Ok(runs)
    }

    /// Reads a policy's checkpoints. With `--train`, first runs the missing trainings.
    fn prepare(&self, plan: &Plan<'_>, policy: &Policy) -> Result<Trained> {
        ensure!(
            !(plan.task.is_recorded() && policy.belief.knows_model),
            "it needs a known model, and recorded worlds have none"
        );
        let is_own =
            |run: &PolicyRun| run.policy == policy.name && !run.policy_fingerprint.is_empty();
        ensure!(
            plan.rows_in_file_of(policy).iter().all(is_own),
            "{} has rows of another policy or program: move the file",
            plan.file_of(policy).display()
        );
        if !policy.needs_checkpoint() {
            return Ok(Trained {
                learned: Learned::default(),
                seconds: Some(0.0),
            });
        }
        let folder = self.checkpoints.as_ref();
        let folder = folder.context("it needs a checkpoint: add --checkpoints FOLDER")?;
        let trainings = Trainings {
            folder: folder.join(&plan.task.name),
            task: plan.task,
            policy,
        };
        if self.train {
            trainings.complete(&plan.comparison.config, self.train_steps, &self.server)?;
        }
        trainings.read(&plan.form)
    }

    /// Starts a server with a task's worlds, and opens them. Dropping the server stops it.
    fn open(&self, task: &Task, seeds: &Range<u64>, n_worlds: u32) -> Result<(Arena, OwnServer)> {
        let worlds = n_worlds.min(MAX_BATCH).to_string();
        let seed = seeds.start.to_string();
        let task = ["--task", &task.source, "--worlds", &worlds];
        let flags = [&task[..], &["--seed", &seed, "--publish-truth"]].concat();
        let flags: Vec<String> = flags.into_iter().map(String::from).collect();
        let server = OwnServer::start(self.server.clone(), &flags)?;
        Ok((Arena::open(server.instance(), n_worlds)?, server))
    }
}

/// The policies and worlds of one task of a suite, and the rows that its folder had at the start.
struct Plan<'a> {
    task: &'a Task,
    policies: Vec<Policy>,
    worlds: Vec<World>,
    /// The comparison, without policies and checkpoints.
    comparison: Comparison,
    form: WorldForm,
    /// Digest of the programs.
    build: String,
    folder: PathBuf,
    /// The files of the folder, with their rows.
    found: Vec<(PathBuf, Vec<PolicyRun>)>,
}

impl Plan<'_> {
    /// Returns 16 hexadecimal digits that identify all that a policy's actions depend on, except its name and worlds.
    fn fingerprint(&self, policy: &Policy, learned: &Learned) -> String {
        let learned = policy.needs_checkpoint().then_some(&learned.digests);
        let Comparison { teams, config, .. } = &self.comparison;
        let config = toml::to_string(config).expect("invariant: settings serialise");
        let text = format!("{}\n{config}\n{teams:?}\n{learned:?}", self.build);
        let hash = Sha256::digest(text);
        hash[..8].iter().map(|byte| format!("{byte:02x}")).collect()
    }

    /// Returns the path of a policy's rows.
    fn file_of(&self, policy: &Policy) -> PathBuf {
        self.folder.join(file_of(&policy.name))
    }

    fn rows_in_file_of(&self, policy: &Policy) -> &[PolicyRun] {
        let file = self.file_of(policy);
        let found = self.found.iter().find(|(path, _)| *path == file);
        found.map_or(&[], |(_, runs)| runs)
    }

    /// Returns the rows in a policy's file, if they are from this task's worlds and have this fingerprint.
    fn kept(&self, policy: &Policy, fingerprint: &str) -> Result<Vec<PolicyRun>> {
        let rows = self.checked(&policy.name, self.rows_in_file_of(policy))?;
        ensure!(
            rows.iter().all(|run| run.policy_fingerprint == fingerprint),
            "its rows are from another build, checkpoint or settings"
        );
        Ok(rows)
    }

    /// Returns the rows of a policy on this suite's seeds, if there is one for each of the task's worlds.
    fn checked(&self, policy: &str, rows: &[PolicyRun]) -> Result<Vec<PolicyRun>> {
        let seeds = &self.comparison.seeds;
        let is_here = |run: &&PolicyRun| run.policy == policy && seeds.contains(&run.world_seed);
        let rows: Vec<&PolicyRun> = rows.iter().filter(is_here).collect();
        check_worlds(policy, &rows, &self.worlds)?;
        Ok(rows.into_iter().cloned().collect())
    }

    /// Returns the rows of other programs' policies, which have no fingerprint. Warns about policies that were measured
    /// on other worlds, and leaves them out.
    fn of_others(&self) -> Vec<PolicyRun> {
        let rows = self.found.iter().flat_map(|(_, runs)| runs);
        let rows = rows.filter(|run| {
            let is_own = |policy: &Policy| policy.name == run.policy;
            run.policy_fingerprint.is_empty() && !self.policies.iter().any(is_own)
        });
        let rows: Vec<PolicyRun> = rows.cloned().collect();
        let others: BTreeSet<&str> = rows.iter().map(|run| &*run.policy).collect();
        let mut runs = Vec::new();
        for policy in others {
            match self.checked(policy, &rows) {
                Ok(rows) => runs.extend(rows),
                Err(reason) => {
                    let task = &self.task.name;
                    tracing::warn!("task {task}: {policy} is left out: {reason:#}");
                }
            }
        }
        runs
    }
}
