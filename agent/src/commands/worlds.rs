//! Flags that choose the worlds: those of a running server, or worlds that the command simulates.

use super::shared::parse_range;
use crate::benchmark::arena::{Arena, MAX_BATCH};
use crate::client::worlds::Worlds;
use anyhow::{Result, ensure};
use clap::{Args, value_parser};
use emberwatch_protocol::Model;
use emberwatch_protocol::built_in::{listed, state_names};
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::control::ServerInfo;
use emberwatch_protocol::model::MAX_RADIUS;
use emberwatch_protocol::task::{MAX_SEEDS, Start, Task};
use emberwatch_sim::config::{Checked, ConfigError, ServerConfig, model_named};
use serde::Serialize;
use serde_json::Value;
use std::ops::Range;

/// Default burn-in of comparisons and trainings.
pub const BURN_IN: u64 = 25_000;

const BENCHMARK_STEPS: u64 = 1500;

const BENCHMARK_SEEDS: Range<u64> = 0..8;

/// Flags that choose the worlds of a comparison.
#[derive(Debug, Args)]
pub struct WorldFlags {
    /// Use the worlds of this running server, instead of simulating worlds
    #[arg(long, conflicts_with = "SimulationFlags")]
    instance: Option<String>,
    /// World seeds, FIRST..END [default: 0..8, or the task's test seeds]
    #[arg(long, value_parser = parse_seeds)]
    seeds: Option<Range<u64>>,
    /// Scored steps per world [default: the task's episode length, or 1500, or the shortest episode's length if less]
    #[arg(long, value_parser = value_parser!(u64).range(1..=10_000_000))]
    steps: Option<u64>,
    #[command(flatten)]
    simulation: SimulationFlags,
}

/// Settings of simulated worlds.
#[derive(Debug, Clone, Default, Args, Serialize)]
pub struct SimulationFlags {
    #[arg(long, value_name = "NAME|FILE", help = format!("Task: {}, or a task file", listed(Task::built_in_names())))]
    task: Option<String>,
    #[arg(long, value_name = "NAME|FILE",
        help = format!("Model: {}, or a model file; with --states: the model of beliefs [default: wildfire; with \
            --states: none]", listed(Model::built_in_names())))]
    model: Option<String>,
    #[arg(long, value_parser = value_parser!(u8).range(..=MAX_RADIUS as i64),
        help = format!("Rows and columns that robots see beyond each cell of their path, 0 to {MAX_RADIUS} [default: \
            the model's]"))]
    sensor_radius: Option<u8>,
    /// Grid height in cells [default: 64]
    #[arg(long)]
    height: Option<usize>,
    /// Grid width in cells [default: 64]
    #[arg(long)]
    width: Option<usize>,
    /// Number of moves in a path [default: 64]
    #[arg(long)]
    moves: Option<usize>,
    /// Steps simulated before the first one [default: 25000; `train --preset paper`: 0]
    #[arg(long)]
    burn_in: Option<u64>,
    #[arg(long, value_name = "NAME|FILE|FOLDER",
        help = format!("Recorded states, instead of simulated states: {}, or a .npz or .npy file or folder",
            listed(state_names())))]
    states: Option<String>,
    /// Let the world's seed also choose a symmetry of the grid: a rotation or reflection of the recorded states
    #[arg(long, num_args = 0..=1, default_missing_value = "true", value_name = "BOOL")]
    states_symmetries: Option<bool>,
    /// Start each episode at a recorded step from 0 to STEPS, drawn by the world's seed [default: 0]
    #[arg(long, value_name = "STEPS")]
    states_offset: Option<u64>,
}

/// Worlds that are not open yet.
pub enum Source {
    Server(Instance),
    /// Settings of worlds to simulate, and the model with which beliefs predict recorded states, if one was given.
    Settings(Box<Checked>, Option<Box<Model>>),
}

impl SimulationFlags {
    /// Returns checked settings of worlds to simulate. `default`: the settings without flags.
    ///
    /// # Errors
    /// If a setting is invalid, or a task or recorded states already determine it.
    pub fn check(&self, default: &ServerConfig) -> Result<Checked, ConfigError> {
        let mut given = match serde_json::to_value(self) {
            Ok(Value::Object(given)) => given,
            _ => unreachable!("invariant: flags serialise"),
        };
        given.retain(|_, value| !value.is_null());
        default.with(&given)?.check()
    }

    /// Separates the model of beliefs about recorded states from the settings of the worlds.
    fn separate(&self) -> Result<(Self, Option<Model>)> {
        let (mut worlds, mut known) = (self.clone(), None);
        if self.states.is_some()
            && let Some(name) = worlds.model.take()
        {
            let model = model_named(&name)?;
            known = Some(match self.sensor_radius {
                Some(radius) => model.with_radius(radius.into())?,
                None => model,
            });
        }
        Ok((worlds, known))
    }
}

impl WorldFlags {
    /// Checks the settings of the worlds, without opening them. `n_robots`: robots per world; `None` for one robot, or
    /// any number on a running server.
    ///
    /// # Errors
    /// If the settings are invalid.
    pub fn source(&self, n_robots: Option<u32>) -> Result<Source> {
        if let Some(name) = &self.instance {
            return Ok(Source::Server(Instance::new(name)?));
        }
        let robots = n_robots.unwrap_or(1);
        let default = ServerConfig {
            robots,
            // With the same start and the same belief, all robots would fly the same path forever.
            start: if robots > 1 {
                Start::Random
            } else {
                Start::Corner
            },
            burn_in: BURN_IN,
            ..ServerConfig::default()
        };
        let (flags, known) = self.simulation.separate()?;
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
        let of_task = task.map(|task| task.max_steps);
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
