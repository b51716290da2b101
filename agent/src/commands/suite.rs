//! `suite`: runs policies on the test worlds of tasks, and gives each policy one score.

use super::compare::run_comparison;
use super::shared::{asks_for_help, make_folder, write};
use super::trainings::{self, Lesson, Trainings};
use crate::benchmark::arena::{Arena, MAX_BATCH};
use crate::benchmark::compare::Comparison;
use crate::benchmark::report::common_worlds::CommonWorlds;
use crate::benchmark::report::suite::{CEILING, FLOOR, TaskRuns, render_suite};
use crate::benchmark::report::{PolicyRun, RunsFile};
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
use emberwatch_protocol::built_in::listed;
use emberwatch_protocol::task::Task;
use std::collections::BTreeSet;
use std::ops::Range;
use std::path::PathBuf;
use std::time::Duration;

/// How long to wait while another process writes results.
const PATIENCE: Duration = Duration::from_secs(60);

/// Run policies on the test worlds of tasks, with one score per policy.
#[derive(Args)]
pub struct SuiteCommand {
    #[arg(long, value_delimiter = ',', help = format!(
        "Tasks, separated by commas, as names or task files [default: {}]", listed(Task::built_in_names())))]
    tasks: Vec<String>,
    /// Policies, separated by commas (`help` lists them); random_walk (score 0) and oracle_ahead (score 1) always run
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "coverage,beam_exploit,learned_beam,learned_policy"
    )]
    policies: Vec<String>,
    /// Folder of checkpoints for learned policies, written by --train or by `train --task NAME --out FOLDER/NAME`
    #[arg(long, value_name = "FOLDER")]
    checkpoints: Option<PathBuf>,
    /// First train what the policies need and --checkpoints lacks; resumes interrupted trainings
    #[arg(long, requires = "checkpoints")]
    train: bool,
    /// World steps of each training, summed over its worlds [default: from the settings]
    #[arg(long, value_name = "STEPS", requires = "train", value_parser = clap::value_parser!(u64).range(1..))]
    train_steps: Option<u64>,
    /// Folder for results, with one CSV file per task; its rows are kept unless the checkpoint, the settings or the
    /// task's worlds have changed
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
        let folder = self.checkpoints.as_deref();
        if let Some(folder) = folder.filter(|_| !self.train) {
            ensure!(
                folder.is_dir(),
                "--checkpoints: expected a folder, got {}",
                folder.display()
            );
        }
        let of_task = |name: &str| format!("task {name}");
        let plans = self.tasks()?.into_iter().map(|task| {
            let name = task.name.clone();
            self.plan(task, &config).with_context(|| of_task(&name))
        });
        let plans = plans.collect::<Result<Vec<_>>>()?;
        make_folder(&self.out)?;
        plans.iter().try_for_each(|plan| plan.read().map(|_| ()))?;
        let trainings = folder.filter(|_| self.train).map(|folder| {
            make_folder(folder)?;
            Trainings::new(folder, &config, self.train_steps, self.server.clone())
        });
        let trainings = trainings.transpose()?;
        let runs = plans.iter().map(|plan| {
            let runs = self.carry_out(plan, trainings.as_ref());
            runs.with_context(|| of_task(&plan.task.name))
        });
        write(&render_suite(&runs.collect::<Result<Vec<_>>>()?))
    }

    fn tasks(&self) -> Result<Vec<Task>> {
        let names: Vec<&str> = if self.tasks.is_empty() {
            Task::built_in_names().collect()
        } else {
            self.tasks.iter().map(|name| &**name).collect()
        };
        let tasks = names.into_iter().map(Task::named);
        Ok(tasks.collect::<Result<_, _>>()?)
    }

    /// Returns the plan for a task. Checks names and worlds, so that errors come before any run.
    fn plan(&self, task: Task, config: &AgentConfig) -> Result<Plan> {
        let seeds = self.seeds(&task);
        let (arena, _server) = self.open(&task, &seeds, 1)?;
        let info = arena.info();
        let longest = info.shortest_episode().unwrap_or(u64::MAX);
        ensure!(
            task.max_steps <= longest,
            "max_steps: expected at most {longest}, the length of the shortest episode, got {}",
            task.max_steps
        );
        let fingerprint = info.worlds_fingerprint.clone();
        let fingerprint = fingerprint.context(
            "server: expected worlds_fingerprint, got none: use the server of this release",
        )?;
        let worlds = CommonWorlds {
            fingerprint: Some(fingerprint),
            seeds: seeds.clone().collect(),
            steps: task.max_steps,
            moves: Some(info.n_moves),
            robots: Some(info.n_robots),
            recent_steps: None,
        };
        let team = if task.robots > 1 {
            Team::Joint
        } else {
            Team::Alone
        };
        Ok(Plan {
            policies: self.policies(arena.model())?,
            comparison: Comparison {
                policies: Vec::new(),
                teams: vec![team],
                seeds,
                steps: task.max_steps,
                recent_steps: RECENT_STEPS,
                config: config.clone(),
                learned: Learned::default(),
                first_state_known: false,
            },
            checkpoints: self.checkpoints.clone(),
            form: WorldForm::of(arena.model(), arena.shape()),
            file: self.out.join(format!("{}.csv", task.name)),
            model: arena.model().clone(),
            task,
            worlds,
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

    /// Trains what the policies of a task need, then runs each policy whose runs are missing or outdated. Returns all
    /// valid runs. Warns about policies that cannot run, and leaves them out.
    fn carry_out(&self, plan: &Plan, trainings: Option<&Trainings<'_>>) -> Result<TaskRuns> {
        let mut ready = Vec::new();
        for policy in &plan.policies {
            let (task, name) = (&plan.task.name, &policy.name);
            match plan.prepare(policy, trainings) {
                Ok(lesson) => ready.push((policy, lesson)),
                Err(reason) if is_outage(&reason) => return Err(reason),
                Err(reason) => {
                    check_stop(trainings)?;
                    tracing::warn!("task {task}: {name} is not run: {reason:#}");
                }
            }
        }
        let kept = plan.read()?;
        ready.retain(|(policy, _)| !plan.keeps(policy, &kept));
        if !ready.is_empty() {
            let seeds = &plan.comparison.seeds;
            let (mut arena, _server) =
                self.open(&plan.task, seeds, (seeds.end - seeds.start) as u32)?;
            for (policy, lesson) in ready {
                let comparison = Comparison {
                    policies: vec![policy.clone()],
                    learned: lesson.learned,
                    ..plan.comparison.clone()
                };
                let mut runs = run_comparison(&mut arena, &comparison)?.runs;
                let seconds = lesson.seconds;
                runs.iter_mut()
                    .for_each(|run| run.training_seconds = seconds);
                plan.replace(runs)?;
                check_stop(trainings)?;
            }
        }
        Ok(TaskRuns {
            task: plan.task.name.clone(),
            runs: plan.valid_runs()?,
        })
    }

    fn seeds(&self, task: &Task) -> Range<u64> {
        let all = task.test_seeds.clone();
        all.start
            ..self
                .worlds
                .map_or(all.end, |n| all.end.min(all.start.saturating_add(n)))
    }

    /// Starts a server with a task's worlds, and opens them. Dropping the server stops it.
    fn open(&self, task: &Task, seeds: &Range<u64>, n_worlds: u32) -> Result<(Arena, OwnServer)> {
        let worlds = n_worlds.min(MAX_BATCH).to_string();
        let seed = seeds.start.to_string();
        let flags = [
            "--task",
            &task.source,
            "--worlds",
            &worlds,
            "--seed",
            &seed,
            "--coverage",
            "client",
            "--publish-truth",
        ];
        let server = OwnServer::start(self.server.clone(), &flags.map(String::from))?;
        Ok((Arena::open(server.instance(), n_worlds)?, server))
    }
}

/// Returns an error if a signal has asked the suite to stop.
fn check_stop(trainings: Option<&Trainings<'_>>) -> Result<()> {
    ensure!(
        !trainings.is_some_and(Trainings::is_stopped),
        "stopped by a signal: run the same command to continue"
    );
    Ok(())
}

/// The policies, worlds and files of one task of a suite.
struct Plan {
    task: Task,
    policies: Vec<Policy>,
    checkpoints: Option<PathBuf>,
    form: WorldForm,
    file: PathBuf,
    worlds: CommonWorlds,
    model: Model,
    /// Settings of the comparison, without policies and checkpoints.
    comparison: Comparison,
}

impl Plan {
    fn lock(&self) -> Result<RunsFile> {
        RunsFile::lock(&self.file, PATIENCE)
    }

    fn read(&self) -> Result<Vec<PolicyRun>> {
        self.lock()?.read()
    }

    /// Reads a policy's checkpoints. With `trainings`, first performs the missing trainings.
    fn prepare(&self, policy: &Policy, trainings: Option<&Trainings<'_>>) -> Result<Lesson> {
        ensure!(
            !(self.task.is_recorded() && policy.belief.knows_model),
            "it needs a known model, and recorded worlds have none"
        );
        let found = self.lesson(policy);
        match trainings {
            Some(trainings) if !found.as_ref().is_ok_and(|lesson| lesson.is_final) => {
                trainings.complete(&self.task, policy)?;
                self.lesson(policy)
            }
            _ => found.inspect(|lesson| self.warn_of_unfinished(policy, lesson)),
        }
    }

    fn warn_of_unfinished(&self, policy: &Policy, lesson: &Lesson) {
        if let Some(steps) = lesson.unfinished(&self.comparison.config) {
            let (task, name) = (&self.task.name, &policy.name);
            tracing::warn!("task {task}: {name} acts on an unfinished training: {steps}");
        }
    }

    fn lesson(&self, policy: &Policy) -> Result<Lesson> {
        trainings::find(self.checkpoints.as_deref(), &self.task, policy, &self.form)
    }

    /// Returns whether a policy's rows are still valid, and logs the result.
    fn keeps(&self, policy: &Policy, kept: &[PolicyRun]) -> bool {
        let (task, name) = (&self.task.name, &policy.name);
        let n_rows = kept.iter().filter(|run| run.policy == *name).count();
        match self.check(name, kept) {
            Ok(()) => tracing::info!("task {task}: {n_rows} rows of {name} kept"),
            Err(reason) if n_rows > 0 => {
                tracing::warn!("task {task}: {n_rows} rows of {name} are run again: {reason:#}");
                return false;
            }
            Err(_) => return false,
        }
        true
    }

    /// Reads all valid runs. Warns about policies with invalid runs, and leaves them out.
    fn valid_runs(&self) -> Result<Vec<PolicyRun>> {
        let mut runs = self.read()?;
        let policies: BTreeSet<String> = runs.iter().map(|run| run.policy.clone()).collect();
        for policy in policies {
            if let Err(reason) = self.check(&policy, &runs) {
                let task = &self.task.name;
                tracing::warn!("task {task}: {policy} is left out: {reason:#}");
                runs.retain(|run| run.policy != policy);
            }
        }
        runs.retain(|run| self.comparison.seeds.contains(&run.world_seed));
        Ok(runs)
    }

    /// Checks that a policy's runs are from the task's worlds. For a built-in policy, also checks that its settings and
    /// checkpoint have not changed.
    fn check(&self, policy: &str, runs: &[PolicyRun]) -> Result<()> {
        let seeds = &self.comparison.seeds;
        let is_own = |run: &&PolicyRun| run.policy == policy && seeds.contains(&run.world_seed);
        let runs: Vec<&PolicyRun> = runs.iter().filter(is_own).collect();
        self.worlds.check(policy, &runs)?;
        let Ok(policy) = Policy::named(policy, &self.model) else {
            return Ok(());
        };
        let comparison = Comparison {
            learned: self.lesson(&policy).unwrap_or_default().learned,
            ..self.comparison.clone()
        };
        let fingerprint = comparison.policy_fingerprint(&policy, &self.model);
        ensure!(
            runs.iter().all(|run| run.policy_fingerprint == fingerprint),
            "it was run with other settings or another checkpoint"
        );
        let team = self.comparison.teams[0].label();
        ensure!(
            runs.iter().all(|run| run.team == team),
            "its robots were a team of another kind: expected {team}"
        );
        Ok(())
    }

    /// Replaces one policy's rows in the file. Keeps rows that other processes have written in the meantime.
    fn replace(&self, runs: Vec<PolicyRun>) -> Result<()> {
        let file = self.lock()?;
        let mut all = file.read()?;
        all.retain(|run| run.policy != runs[0].policy);
        all.extend(runs);
        file.replace(&all)
    }
}
