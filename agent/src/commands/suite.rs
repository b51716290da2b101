//! `suite`: policies on the test worlds of all tasks, and one score.

use super::compare::run_comparison;
use super::shared::{make_folder, write};
use anyhow::{Context, Result, ensure};
use clap::Args;
use emberwatch_agent::benchmark::arena::{Arena, MAX_BATCH};
use emberwatch_agent::benchmark::compare::Comparison;
use emberwatch_agent::benchmark::report::added::read_csv;
use emberwatch_agent::benchmark::report::suite::{CEILING, FLOOR, TaskRuns, render_suite};
use emberwatch_agent::benchmark::report::{PolicyRun, write_csv};
use emberwatch_agent::benchmark::team::Team;
use emberwatch_agent::client::launch::OwnServer;
use emberwatch_agent::config::{AgentConfig, AgentFlags};
use emberwatch_agent::learning::learned::Learned;
use emberwatch_agent::learning::train::CHECKPOINT;
use emberwatch_agent::policy::Policy;
use emberwatch_belief::merit::RECENT_STEPS;
use emberwatch_network::Device;
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
    /// A folder for results, a CSV file a task; what it has already is not run again
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
        let tasks = if self.tasks.is_empty() {
            Task::built_in_names()
                .map(Task::named)
                .collect::<Result<Vec<_>, _>>()
        } else {
            self.tasks.iter().map(|name| Task::named(name)).collect()
        };
        let tasks = tasks?;
        if let Some(folder) = &self.checkpoints {
            ensure!(
                folder.is_dir(),
                "--checkpoints: expected a folder, got {}",
                folder.display()
            );
        }
        make_folder(&self.out)?;
        let runs = tasks.iter().map(|task| {
            self.runs(task, &config)
                .with_context(|| format!("task {}", task.name))
        });
        write(&render_suite(&runs.collect::<Result<Vec<_>>>()?))
    }

    /// All runs of a task; those that are missing are made and added to its file, policy by policy.
    fn runs(&self, task: &Task, config: &AgentConfig) -> Result<TaskRuns> {
        let path = self.out.join(format!("{}.csv", task.name));
        let mut runs = if path.exists() {
            read_csv(&path).with_context(|| path.display().to_string())?
        } else {
            Vec::new()
        };
        let learned = self.learned(task)?;
        let seeds = self.seeds(task);
        let names = [FLOOR, CEILING]
            .into_iter()
            .chain(self.policies.iter().map(|name| &**name));
        let missing = names.filter(|name| !is_done(&runs, name, &seeds, task.max_steps));
        let (missing, left): (Vec<&str>, Vec<&str>) =
            missing.partition(|name| can_run(name, task, &learned));
        if !left.is_empty() {
            let (task, policies) = (&task.name, left.join(", "));
            tracing::warn!("task {task}: without {policies}, which need a model or --checkpoints");
        }
        if !missing.is_empty() {
            let (mut arena, _server) = self.open(task, &seeds)?;
            let longest = arena.info().shortest_episode().unwrap_or(u64::MAX);
            ensure!(
                task.max_steps <= longest,
                "max_steps: expected at most {longest}, as the shortest episode has, got {}",
                task.max_steps
            );
            for name in missing {
                let comparison = Comparison {
                    policies: vec![Policy::named(name, arena.model())?],
                    teams: vec![if task.robots > 1 {
                        Team::Shared
                    } else {
                        Team::Alone
                    }],
                    seeds: seeds.clone(),
                    steps: task.max_steps,
                    recent_steps: RECENT_STEPS,
                    config: config.clone(),
                    learned: learned.clone(),
                };
                let results = run_comparison(&mut arena, &comparison)?;
                runs.retain(|run| run.policy != name);
                runs.extend(results.runs);
                write_csv(&path, &runs)?;
            }
        }
        runs.retain(|run| seeds.contains(&run.world_seed));
        Ok(TaskRuns {
            task: task.name.clone(),
            runs,
        })
    }

    fn seeds(&self, task: &Task) -> Range<u64> {
        let all = task.test_seeds.clone();
        all.start
            ..self
                .worlds
                .map_or(all.end, |n| all.end.min(all.start.saturating_add(n)))
    }

    fn learned(&self, task: &Task) -> Result<Learned> {
        let Some(folder) = &self.checkpoints else {
            return Ok(Learned::default());
        };
        let place = folder.join(&task.name).join(CHECKPOINT);
        if !place.exists() {
            tracing::warn!("no {}: no learned policy for this task", place.display());
            return Ok(Learned::default());
        }
        Learned::read([&*place], &Device::Cpu)
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

/// Whether a policy has what it needs on a task.
fn can_run(name: &str, task: &Task, learned: &Learned) -> bool {
    // A name that only the task's own model has is of a policy that needs no more than that model.
    let policy = Policy::named(name, &Model::wildfire()).ok();
    policy.is_none_or(|policy| {
        learned.suits(&policy) && !(task.is_recorded() && policy.estimator.knows_model())
    })
}

/// Whether a policy was run on all these worlds, for so many steps.
fn is_done(runs: &[PolicyRun], policy: &str, seeds: &Range<u64>, steps: u64) -> bool {
    let has = |seed| {
        runs.iter()
            .any(|run| (&*run.policy, run.world_seed, run.steps) == (policy, seed, steps))
    };
    seeds.clone().all(has)
}
