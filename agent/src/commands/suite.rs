//! `suite`: policies on the test worlds of all tasks, and one score.

use super::compare::run_comparison;
use super::shared::{make_folder, model_of, write};
use anyhow::{Context, Result, ensure};
use clap::Args;
use emberwatch_agent::benchmark::arena::{Arena, MAX_BATCH};
use emberwatch_agent::benchmark::compare::Comparison;
use emberwatch_agent::benchmark::report::kept::Kept;
use emberwatch_agent::benchmark::report::suite::{CEILING, FLOOR, TaskRuns, render_suite};
use emberwatch_agent::benchmark::team::Team;
use emberwatch_agent::client::launch::OwnServer;
use emberwatch_agent::config::{AgentConfig, AgentFlags};
use emberwatch_agent::learning::learned::Learned;
use emberwatch_agent::learning::train::CHECKPOINT;
use emberwatch_agent::policy::Policy;
use emberwatch_belief::merit::RECENT_STEPS;
use emberwatch_protocol::Model;
use emberwatch_protocol::task::Task;
use std::ops::Range;
use std::path::PathBuf;

/// Run policies on the test worlds of tasks, and give each one score.
#[derive(Args)]
pub struct SuiteCommand {
    /// The tasks, names or files, separated by commas [default: all that have names]
    #[arg(long, value_delimiter = ',')]
    tasks: Vec<String>,
    /// The policies, separated by commas; `random_walk` and `oracle_ahead`, which are scores 0 and 1, are always run
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "coverage,beam_exploit,learned_beam,learned_policy"
    )]
    policies: Vec<String>,
    /// For learned policies: a folder with what `train --task NAME --out FOLDER/NAME` learned of each task
    #[arg(long, value_name = "FOLDER")]
    checkpoints: Option<PathBuf>,
    /// A folder for results, a CSV file a task; what it has already is not run again, unless its checkpoint
    /// or the settings have changed
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
        let names = self.policies.iter();
        names
            .clone()
            .try_for_each(|name| Policy::check_name(name))?;
        ensure!(
            !self
                .policies
                .iter()
                .any(|name| name.starts_with("clairvoyant")),
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
        let runs = plans.into_iter().map(|plan| {
            let name = plan.task.name.clone();
            self.carry_out(plan, &config)
                .with_context(|| of_task(&name))
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

    /// What there is of a task, and what is missing; all names are checked before anything runs.
    fn plan(&self, task: Task, config: &AgentConfig) -> Result<Plan> {
        let (learned, checkpoint) = self.learned(&task)?;
        let seeds = self.seeds(&task);
        let model = self.model(&task, &seeds)?;
        let kept = Kept::read(&self.out, &task.name)?;
        let names = [FLOOR, CEILING]
            .into_iter()
            .chain(self.policies.iter().map(|name| &**name));
        let policies = names.map(|name| Policy::named(name, &model));
        let mark = |policy: &Policy| {
            let of_checkpoint = checkpoint.filter(|_| policy.needs_checkpoint());
            fingerprint(&task, &model, config, of_checkpoint)
        };
        let policies = policies.collect::<Result<Vec<_>>>()?;
        let is_asked = |name: &str| policies.iter().any(|policy| policy.name == name);
        let mut stale = Vec::new();
        for name in kept.marked().filter(|name| !is_asked(name)) {
            let is_same = kept.has_mark(name, &mark(&Policy::named(name, &model)?)?);
            if !is_same {
                let task = &task.name;
                tracing::warn!(
                    "task {task}: {name} is left out: it was run with other settings or another checkpoint"
                );
                stale.push(name.to_owned());
            }
        }
        let mut missing: Vec<(Policy, String)> = Vec::new();
        for policy in policies {
            if missing.iter().any(|(other, _)| *other == policy) {
                continue;
            }
            let mark = mark(&policy)?;
            if !can_run(&policy, &task, &learned) {
                let (task, policy) = (&task.name, &policy.name);
                tracing::warn!(
                    "task {task}: {policy} is not run: it needs a model or --checkpoints"
                );
            } else if !kept.has(&policy.name, &mark, &seeds, task.max_steps) {
                missing.push((policy, mark));
            }
        }
        Ok(Plan {
            task,
            learned,
            seeds,
            kept,
            missing,
            stale,
        })
    }

    /// All runs of a task; those that are missing are made and added to its file, policy by policy.
    fn carry_out(&self, plan: Plan, config: &AgentConfig) -> Result<TaskRuns> {
        let Plan {
            task,
            learned,
            seeds,
            mut kept,
            missing,
            stale,
        } = plan;
        if !missing.is_empty() {
            let (mut arena, _server) = self.open(&task, &seeds)?;
            let longest = arena.info().shortest_episode().unwrap_or(u64::MAX);
            ensure!(
                task.max_steps <= longest,
                "max_steps: expected at most {longest}, as the shortest episode has, got {}",
                task.max_steps
            );
            let team = if task.robots > 1 {
                Team::Shared
            } else {
                Team::Alone
            };
            for (policy, mark) in missing {
                let name = policy.name.clone();
                let comparison = Comparison {
                    policies: vec![policy],
                    teams: vec![team],
                    seeds: seeds.clone(),
                    steps: task.max_steps,
                    recent_steps: RECENT_STEPS,
                    config: config.clone(),
                    learned: learned.clone(),
                };
                let results = run_comparison(&mut arena, &comparison)?;
                kept.replace(name, mark, results.runs)?;
            }
        }
        kept.runs
            .retain(|run| seeds.contains(&run.world_seed) && !stale.contains(&run.policy));
        Ok(TaskRuns {
            task: task.name,
            runs: kept.runs,
        })
    }

    fn seeds(&self, task: &Task) -> Range<u64> {
        let all = task.test_seeds.clone();
        all.start
            ..self
                .worlds
                .map_or(all.end, |n| all.end.min(all.start.saturating_add(n)))
    }

    /// What was learned of a task, and the checksum of its file.
    fn learned(&self, task: &Task) -> Result<(Learned, Option<u32>)> {
        let Some(folder) = &self.checkpoints else {
            return Ok((Learned::default(), None));
        };
        let place = folder.join(&task.name).join(CHECKPOINT);
        if !place.exists() {
            tracing::warn!("no {}: no learned policy for this task", place.display());
            return Ok((Learned::default(), None));
        }
        let of_file = || format!("checkpoint {}", place.display());
        let bytes = std::fs::read(&place).with_context(of_file)?;
        let learned = Learned::from_bytes(&bytes).with_context(of_file)?;
        Ok((learned, Some(crc32fast::hash(&bytes))))
    }

    /// What states are called; of recorded worlds their server tells.
    fn model(&self, task: &Task, seeds: &Range<u64>) -> Result<Model> {
        if !task.is_recorded() {
            return model_of(task);
        }
        let (arena, _server) = self.open(task, seeds)?;
        Ok(arena.model().clone())
    }

    /// A server with a task's worlds, which stops when it is dropped.
    fn open(&self, task: &Task, seeds: &Range<u64>) -> Result<(Arena, OwnServer)> {
        let n_seeds = (seeds.end - seeds.start) as u32;
        let worlds = n_seeds.min(MAX_BATCH).to_string();
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
        Ok((Arena::open(server.instance(), n_seeds, false)?, server))
    }
}

/// What is to be done on a task.
struct Plan {
    task: Task,
    learned: Learned,
    seeds: Range<u64>,
    kept: Kept,
    /// Policies to run, each with its fingerprint.
    missing: Vec<(Policy, String)>,
    /// Policies that were run before, with other settings or another checkpoint.
    stale: Vec<String>,
}

/// Whether a policy has what it needs on a task.
fn can_run(policy: &Policy, task: &Task, learned: &Learned) -> bool {
    learned.suits(policy) && !(task.is_recorded() && policy.estimator.knows_model())
}

/// A checksum of all that the runs of a policy depend on, beside its name, seeds and steps.
fn fingerprint(
    task: &Task,
    model: &Model,
    config: &AgentConfig,
    checkpoint: Option<u32>,
) -> Result<String> {
    // The name of a built-in task and the path of its file are one.
    let task = Task {
        source: String::new(),
        ..task.clone()
    };
    let (model, config) = (toml::to_string(model.file())?, toml::to_string(config)?);
    let version = env!("CARGO_PKG_VERSION");
    // Built-in states are no file.
    let states = std::fs::read(&task.states).map_or(0, |bytes| crc32fast::hash(&bytes));
    let text = format!("{version}\n{task:?}\n{states}\n{model}\n{config}\n{checkpoint:?}");
    Ok(format!("{:08x}", crc32fast::hash(text.as_bytes())))
}
