//! Flags that choose the worlds: those of a running server, or worlds that the command simulates.

use super::shared::parse_range;
use crate::benchmark::arena::{Arena, MAX_BATCH};
use crate::client::worlds::Worlds;
use anyhow::{Result, ensure};
use clap::{Arg, ArgMatches, Args, Command, FromArgMatches, Id, value_parser};
use emberwatch_protocol::Model;
use emberwatch_protocol::built_in::listed;
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::control::ServerInfo;
use emberwatch_protocol::model::settings::{Start, WorldSettings};
use emberwatch_protocol::program::Flags;
use emberwatch_protocol::task::{MAX_SEEDS, Task};
use emberwatch_sim::config::{Checked, ConfigError, ServerConfig, model_named};
use serde_json::{Map, Value};
use std::ops::Range;

/// Default burn-in of comparisons and trainings.
pub const BURN_IN: u64 = 25_000;

const BENCHMARK_STEPS: u64 = 1500;

const BENCHMARK_SEEDS: Range<u64> = 0..8;

/// Flags that choose the worlds of a comparison.
#[derive(Debug, Args)]
pub struct WorldFlags {
    /// Use the worlds of this running server, instead of simulating worlds
    #[arg(long, conflicts_with = "settings")]
    instance: Option<String>,
    /// World seeds, FIRST..END [default: 0..8, or the task's test seeds]
    #[arg(long, value_parser = parse_seeds)]
    seeds: Option<Range<u64>>,
    /// Scored steps per world [default: the task's episode length, or 1500, or the shortest episode's length if less]
    #[arg(long, value_parser = value_parser!(u64).range(1..=10_000_000))]
    steps: Option<u64>,
    #[command(flatten)]
    pub simulation: SimulationFlags,
}

/// Settings of simulated worlds.
#[derive(Debug, Clone)]
pub struct SimulationFlags {
    task: Option<String>,
    worlds: Map<String, Value>,
    /// Numbers of robots per world.
    pub robots: Vec<u32>,
}

/// Worlds that are not open yet.
pub enum Source {
    Server(Instance),
    /// Settings of worlds to simulate, and the model with which beliefs predict recorded states, if one was given.
    Settings(Box<Checked>, Option<Box<Model>>),
}

impl Args for SimulationFlags {
    fn group_id() -> Option<Id> {
        Flags::<WorldSettings>::group_id()
    }

    fn augment_args(command: Command) -> Command {
        let task = Arg::new("task").long("task").value_name("NAME|FILE");
        let names = listed(Task::built_in_names());
        let task = task.help(format!(
            "Task, which decides all of these settings: {names}, or a path"
        ));
        let burn_in =
            "Number of steps simulated before k = 0 [default: 25000; `train --preset paper`: 0]";
        Flags::<WorldSettings>::augment_args(command.arg(task))
            .mut_group("settings", |group| group.arg("task"))
            .mut_arg("burn_in", |flag| flag.help(burn_in))
            .mut_arg("robots", |flag| flag.value_delimiter(','))
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

impl FromArgMatches for SimulationFlags {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let robots = matches.get_many::<Value>("robots").into_iter().flatten();
        let number = |robots: &Value| robots.as_u64().unwrap_or_default() as u32;
        Ok(Self {
            task: matches.get_one::<String>("task").cloned(),
            worlds: Flags::<WorldSettings>::from_arg_matches(matches)?
                .given()
                .clone(),
            robots: robots.map(number).collect(),
        })
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

impl SimulationFlags {
    /// Returns checked settings of worlds to simulate. `default`: the settings without flags.
    ///
    /// # Errors
    /// If a setting is invalid, or a task or recorded states already decide it.
    pub fn check(&self, default: &ServerConfig) -> Result<Checked, ConfigError> {
        let task = self
            .task
            .iter()
            .map(|task| ("task".into(), task.as_str().into()));
        let given = self.worlds.clone().into_iter().chain(task).collect();
        default.with(&given)?.check()
    }

    /// Separates the model of beliefs about recorded states from the settings of the worlds.
    fn separate(&self) -> Result<(Self, Option<Model>)> {
        let mut flags = self.clone();
        let states = flags.worlds.get("states").and_then(Value::as_str);
        if states.is_none_or(str::is_empty) {
            return Ok((flags, None));
        }
        let name = flags.worlds.remove("model");
        let model = name.as_ref().and_then(Value::as_str).map(model_named);
        let Some(model) = model.transpose()? else {
            return Ok((flags, None));
        };
        let radius = flags.worlds.get("sensor_radius").and_then(Value::as_u64);
        let model = radius.map_or(Ok(model.clone()), |radius| {
            model.with_radius(radius as usize)
        });
        Ok((flags, Some(model?)))
    }
}

impl WorldFlags {
    /// Checks the settings of the worlds, without opening them. `n_robots`: the number of robots per world, if it was
    /// given.
    ///
    /// # Errors
    /// If the settings are invalid.
    pub fn source(&self, n_robots: Option<u32>) -> Result<Source> {
        if let Some(name) = &self.instance {
            return Ok(Source::Server(Instance::new(name)?));
        }
        let (mut flags, known) = self.simulation.separate()?;
        if let Some(robots) = n_robots {
            flags.worlds.insert("robots".into(), robots.into());
        }
        let mut default = ServerConfig::default();
        default.world.burn_in = BURN_IN;
        if n_robots.is_some_and(|robots| robots > 1) {
            // With the same start and the same belief, all robots would fly the same path forever.
            default.world.start = Start::Random;
        }
        let mut checked = flags.check(&default)?;
        let seeds = self.seeds_of(checked.task.as_ref());
        checked.config.seed = seeds.start;
        let n_worlds = (seeds.end - seeds.start).min(MAX_BATCH.into());
        let checked = checked.with_worlds(n_worlds as u32)?;
        Ok(Source::Settings(Box::new(checked), known.map(Box::new)))
    }

    /// Returns the seeds to compare on.
    pub fn seeds(&self, source: &Source) -> Range<u64> {
        self.seeds_of(source.task())
    }

    fn seeds_of(&self, task: Option<&Task>) -> Range<u64> {
        let of_task = || task.map(|task| task.test_seeds.clone());
        let given = self.seeds.clone().or_else(of_task);
        given.unwrap_or(BENCHMARK_SEEDS)
    }

    /// Returns the number of scored steps. Fails if the shortest episode has fewer steps.
    pub fn steps(&self, task: Option<&Task>, info: &ServerInfo) -> Result<u64> {
        let longest = info.shortest_episode().unwrap_or(u64::MAX);
        let of_task = task.map(|task| task.world.max_steps);
        let default = of_task.unwrap_or(BENCHMARK_STEPS.min(longest));
        let steps = self.steps.unwrap_or(default);
        ensure!(
            steps <= longest,
            "--steps: expected at most {longest}, the length of the shortest episode, got {steps}"
        );
        Ok(steps)
    }
}

impl Source {
    /// Returns the task of worlds to simulate.
    pub fn task(&self) -> Option<&Task> {
        match self {
            Self::Server(_) => None,
            Self::Settings(checked, _) => checked.task.as_ref(),
        }
    }

    /// Returns the model of beliefs about worlds to simulate, if one is known.
    pub fn model(&self) -> Option<&Model> {
        match self {
            Self::Server(_) => None,
            Self::Settings(checked, known) if checked.recorded.is_some() => known.as_deref(),
            Self::Settings(checked, _) => Some(&checked.model),
        }
    }

    /// Opens the worlds for a comparison on `n_seeds` seeds.
    ///
    /// # Errors
    /// If there is no such server, the worlds cannot be simulated, or the model of beliefs does not fit them.
    pub fn open(self, n_seeds: u32) -> Result<Arena> {
        match self {
            Self::Server(instance) => Arena::open(Worlds::attach(&instance, true)?, n_seeds),
            Self::Settings(checked, known) => {
                let mut arena = Arena::open(Worlds::simulate(*checked)?, n_seeds)?;
                known.map_or(Ok(()), |model| arena.know(*model))?;
                Ok(arena)
            }
        }
    }
}

fn parse_seeds(text: &str) -> Result<Range<u64>, String> {
    let seeds: Range<u64> = parse_range(text)?;
    match seeds.end - seeds.start {
        1..=MAX_SEEDS => Ok(seeds),
        _ => Err(format!("expected 1 to {MAX_SEEDS} seeds")),
    }
}
