//! `suite`: policies on the test worlds of all tasks, and one score.

use super::compare::run_comparison;
use super::shared::{asks_for_help, make_folder, write};
use crate::benchmark::arena::{Arena, MAX_BATCH};
use crate::benchmark::compare::Comparison;
use crate::benchmark::report::common_worlds::CommonWorlds;
use crate::benchmark::report::suite::{CEILING, FLOOR, TaskRuns, render_suite};
use crate::benchmark::report::{PolicyRun, RunsFile};
use crate::benchmark::team::Team;
use crate::client::launch::OwnServer;
use crate::flags::AgentFlags;
use crate::training::CHECKPOINT;
use anyhow::{Context, Result, ensure};
use clap::Args;
use emberwatch_belief::merit::RECENT_STEPS;
use emberwatch_learning::beliefs::Input;
use emberwatch_learning::config::AgentConfig;
use emberwatch_learning::learned::Learned;
use emberwatch_learning::learners;
use emberwatch_learning::policy::{self, Policy};
use emberwatch_network::Device;
use emberwatch_protocol::Model;
use emberwatch_protocol::built_in::listed;
use emberwatch_protocol::task::Task;
use std::collections::BTreeSet;
use std::ops::Range;
use std::path::PathBuf;
use std::time::Duration;

/// How long to wait for another process that writes results.
const PATIENCE: Duration = Duration::from_secs(60);

/// Run policies on the test worlds of tasks, and give each one score.
#[derive(Args)]
pub struct SuiteCommand {
    #[arg(long, value_delimiter = ',', help = format!(
        "Names or files of tasks, separated by commas [default: {}]", listed(Task::built_in_names())))]
    tasks: Vec<String>,
    /// The policies, separated by commas; `help` lists their parts; `random_walk` and `oracle_ahead`, which are scores 0 and
    /// 1, are always run
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "coverage,beam_exploit,learned_beam,learned_policy"
    )]
    policies: Vec<String>,
    /// For learned policies: a folder with what `train --task NAME --out FOLDER/NAME` learned of each task
    #[arg(long, value_name = "FOLDER")]
    checkpoints: Option<PathBuf>,
    /// A folder for results, a CSV file a task; rows that it has are kept, unless the checkpoint, the settings or
    /// the task's worlds have changed
    #[arg(long, value_name = "FOLDER", default_value = "suite")]
    out: PathBuf,
    /// Worlds of each task, the first of its test seeds [default: all]
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    worlds: Option<u64>,
    /// The server's program, if it is not beside this one
    #[arg(long, value_name = "PROGRAM")]
    server: Option<PathBuf>,
    #[command(flatten)]
    settings: AgentFlags,
}

impl SuiteCommand {
    /// Runs what is missing, and tells all scores.
    pub fn run(&self) -> Result<()> {
        if asks_for_help(&self.policies) {
            return write(&policy::help());
        }
        let mut names = self.policies.iter();
        names.try_for_each(|name| policy::check_name(name))?;
        let mut beliefs = self
            .policies
            .iter()
            .filter_map(|name| policy::belief_of(name));
        ensure!(
            beliefs.all(|belief| belief.input != Input::NextStates),
            "--policies: expected none that is told the next states, as these act only in `compare`"
        );
        let config = self.settings.effective()?;
        if let Some(folder) = &self.checkpoints {
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
        let runs = plans.iter().map(|plan| {
            let runs = self.carry_out(plan);
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

    /// What is to be done on a task; all names and files are checked before anything runs.
    fn plan(&self, task: Task, config: &AgentConfig) -> Result<Plan> {
        let learned = self.learned(&task)?;
        let seeds = self.seeds(&task);
        let (arena, _server) = self.open(&task, &seeds, 1)?;
        let info = arena.info();
        let longest = info.shortest_episode().unwrap_or(u64::MAX);
        ensure!(
            task.max_steps <= longest,
            "max_steps: expected at most {longest}, as the shortest episode has, got {}",
            task.max_steps
        );
        let fingerprint = info.worlds_fingerprint.clone();
        let fingerprint = fingerprint
            .context("expected a server that identifies its worlds: use the one of this release")?;
        let worlds = CommonWorlds {
            fingerprint: Some(fingerprint),
            seeds: seeds.clone().collect(),
            steps: task.max_steps,
            moves: Some(info.n_moves),
            robots: Some(info.n_robots),
            recent_steps: None,
        };
        let team = if task.robots > 1 {
            Team::Shared
        } else {
            Team::Alone
        };
        let policies = self.policies(&task, arena.model(), &learned)?;
        Ok(Plan {
            comparison: Comparison {
                policies,
                teams: vec![team],
                seeds,
                steps: task.max_steps,
                recent_steps: RECENT_STEPS,
                config: config.clone(),
                learned,
            },
            file: self.out.join(format!("{}.csv", task.name)),
            model: arena.model().clone(),
            task,
            worlds,
        })
    }

    /// The policies that can run on a task; warns of the others.
    fn policies(&self, task: &Task, model: &Model, learned: &Learned) -> Result<Vec<Policy>> {
        let names = [FLOOR, CEILING].into_iter();
        let mut policies: Vec<Policy> = Vec::new();
        for name in names.chain(self.policies.iter().map(|name| &**name)) {
            let policy = Policy::named(name, model)?;
            let can_run =
                policy.check(learned).is_ok() && !(task.is_recorded() && policy.belief.knows_model);
            if !can_run {
                let task = &task.name;
                tracing::warn!("task {task}: {name} is not run: it needs a model or --checkpoints");
            } else if !policies.contains(&policy) {
                policies.push(policy);
            }
        }
        Ok(policies)
    }

    /// Runs the policies whose runs are missing or outdated, one by one; returns all runs that count.
    fn carry_out(&self, plan: &Plan) -> Result<TaskRuns> {
        let (task, comparison) = (&plan.task.name, &plan.comparison);
        let kept = plan.read()?;
        let mut missing = Vec::new();
        for policy in &comparison.policies {
            let name = &policy.name;
            let n_rows = kept.iter().filter(|run| run.policy == *name).count();
            match plan.check(name, &kept) {
                Ok(()) => tracing::info!("task {task}: {n_rows} rows of {name} kept"),
                Err(reason) => {
                    if n_rows > 0 {
                        tracing::warn!(
                            "task {task}: {n_rows} rows of {name} are run again: {reason:#}"
                        );
                    }
                    missing.push(policy.clone());
                }
            }
        }
        if !missing.is_empty() {
            let n_worlds = comparison.seeds.end - comparison.seeds.start;
            let (mut arena, _server) = self.open(&plan.task, &comparison.seeds, n_worlds as u32)?;
            for policy in missing {
                let comparison = Comparison {
                    policies: vec![policy],
                    ..comparison.clone()
                };
                let runs = run_comparison(&mut arena, &comparison)?.runs;
                plan.replace(runs)?;
            }
        }
        Ok(TaskRuns {
            task: task.clone(),
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

    /// What was learned of a task.
    fn learned(&self, task: &Task) -> Result<Learned> {
        let Some(folder) = &self.checkpoints else {
            return Ok(Learned::default());
        };
        let place = folder.join(&task.name).join(CHECKPOINT);
        if !place.exists() {
            tracing::warn!("no {}: no learned policy for this task", place.display());
            return Ok(Learned::default());
        }
        learners::read([&*place], &Device::Cpu)
    }

    /// A server with a task's worlds, which stops when it is dropped.
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
        Ok((Arena::open(server.instance(), n_worlds, false)?, server))
    }
}

/// What is to be done on a task.
struct Plan {
    task: Task,
    file: PathBuf,
    worlds: CommonWorlds,
    model: Model,
    comparison: Comparison,
}

impl Plan {
    fn lock(&self) -> Result<RunsFile> {
        RunsFile::lock(&self.file, PATIENCE)
    }

    fn read(&self) -> Result<Vec<PolicyRun>> {
        self.lock()?.read()
    }

    /// Reads all runs that count; warns of the policies whose runs do not.
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

    /// Checks that a policy's runs are of the task's worlds, and those of a built-in policy of what it is now.
    fn check(&self, policy: &str, runs: &[PolicyRun]) -> Result<()> {
        let seeds = &self.comparison.seeds;
        let is_own = |run: &&PolicyRun| run.policy == policy && seeds.contains(&run.world_seed);
        let runs: Vec<&PolicyRun> = runs.iter().filter(is_own).collect();
        self.worlds.check(policy, &runs)?;
        let Ok(policy) = Policy::named(policy, &self.model) else {
            return Ok(());
        };
        let fingerprint = self.comparison.policy_fingerprint(&policy, &self.model);
        ensure!(
            runs.iter().all(|run| run.policy_fingerprint == fingerprint),
            "it was run with other settings or another checkpoint"
        );
        Ok(())
    }

    /// Replaces the rows of the policy that was run; rows that others have written meanwhile stay.
    fn replace(&self, runs: Vec<PolicyRun>) -> Result<()> {
        let file = self.lock()?;
        let mut all = file.read()?;
        all.retain(|run| run.policy != runs[0].policy);
        all.extend(runs);
        file.replace(&all)
    }
}
