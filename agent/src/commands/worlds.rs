//! Flags that choose the worlds: those of a running server, or worlds that the command simulates.

use super::shared::parse_range;
use crate::benchmark::compared_worlds::{ComparedWorlds, MAX_BATCH};
use crate::client::worlds::Worlds;
use anyhow::{Context, Result, ensure};
use clap::{Args, value_parser};
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

/// Flags that choose the worlds of a comparison, which may have several numbers of robots.
#[derive(Debug, Args)]
#[command(mut_arg("robots", |flag| flag.value_delimiter(',')))]
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
    simulation: SimulationFlags,
}

/// Settings of simulated worlds.
#[derive(Debug, Args)]
#[command(mut_arg("burn_in", |flag| flag.help(
    "Number of steps simulated before k = 0 [default: 25000; `train --preset paper`: 0]")))]
pub struct SimulationFlags {
    #[arg(long, value_name = "NAME|FILE", group = "settings", help = format!(
        "Task, which decides all of these settings: {}, or a path", listed(Task::built_in_names())))]
    task: Option<String>,
    #[command(flatten)]
    settings: Flags<WorldSettings>,
}

/// Worlds that are not open yet.
pub enum Source {
    Server(Instance),
    /// Settings of worlds to simulate, and the model with which beliefs predict recorded states, if one was given.
    Settings(Box<Checked>, Option<Box<Model>>),
}

impl SimulationFlags {
    /// Returns checked settings of worlds to simulate. `default`: the settings without flags.
    pub fn check(&self, default: ServerConfig) -> Result<Checked, ConfigError> {
        check(&self.given(), default)
    }

    fn given(&self) -> Map<String, Value> {
        let task = self
            .task
            .iter()
            .map(|task| ("task".into(), task.as_str().into()));
        self.settings
            .given()
            .clone()
            .into_iter()
            .chain(task)
            .collect()
    }
}

impl WorldFlags {
    /// Returns the numbers of robots per world; none if the flag was not given.
    pub fn robots(&self) -> Vec<u32> {
        let numbers = match self.simulation.settings.given().get("robots") {
            None => &[],
            Some(Value::Array(several)) => several.as_slice(),
            Some(one) => std::slice::from_ref(one),
        };
        let numbers = numbers.iter().filter_map(Value::as_u64);
        numbers.map(|number| number as u32).collect()
    }

    /// Checks the settings of the worlds without opening them. `n_robots`: robots per world, if given.
    pub fn source(&self, n_robots: Option<u32>) -> Result<Source> {
        if let Some(name) = &self.instance {
            return Ok(Source::Server(Instance::new(name)?));
        }
        let mut given = self.simulation.given();
        let known = take_known_model(&mut given)?;
        if let Some(robots) = n_robots {
            given.insert("robots".into(), robots.into());
        }
        let mut default = ServerConfig::default();
        default.world.burn_in = BURN_IN;
        let mut checked = check(&given, default)?;
        let seeds = self.seeds_of(checked.task.as_ref());
        checked.config.seed = seeds.start;
        let n_worlds = (seeds.end - seeds.start).min(MAX_BATCH.into());
        let checked = checked.with_worlds(n_worlds as u32)?;
        Ok(Source::Settings(Box::new(checked), known.map(Box::new)))
    }

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

    /// Opens the worlds for a comparison on `n_seeds` seeds.
    pub fn open(self, n_seeds: u32) -> Result<ComparedWorlds> {
        match self {
            Self::Server(instance) => {
                let worlds = ComparedWorlds::open(Worlds::attach(&instance, true)?, n_seeds);
                worlds.with_context(|| format!("instance {:?}", instance.name()))
            }
            Self::Settings(checked, known) => {
                let mut worlds = ComparedWorlds::open(Worlds::simulate(*checked)?, n_seeds)?;
                known.map_or(Ok(()), |model| worlds.know(*model))?;
                Ok(worlds)
            }
        }
    }
}

fn check(given: &Map<String, Value>, mut default: ServerConfig) -> Result<Checked, ConfigError> {
    if given.get("robots").and_then(Value::as_u64) > Some(1) {
        // With the same start and the same belief, all robots would fly the same path forever.
        default.world.start = Start::Random;
    }
    default.with(given)?.check()
}

/// Takes the model of beliefs about recorded states from the settings. Simulated worlds keep their model.
fn take_known_model(given: &mut Map<String, Value>) -> Result<Option<Model>> {
    if given.get("states").is_none_or(|states| states == "") {
        return Ok(None);
    }
    let name = given.remove("model");
    let model = name.as_ref().and_then(Value::as_str).map(model_named);
    let radius = given.get("sensor_radius").and_then(Value::as_u64);
    Ok(match (model.transpose()?, radius) {
        (Some(model), Some(radius)) => Some(model.with_radius(radius as usize)?),
        (model, _) => model,
    })
}

fn parse_seeds(text: &str) -> Result<Range<u64>, String> {
    let seeds: Range<u64> = parse_range(text)?;
    match seeds.end - seeds.start {
        1..=MAX_SEEDS => Ok(seeds),
        _ => Err(format!("expected 1 to {MAX_SEEDS} seeds")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Flags<T: Args> {
        #[command(flatten)]
        worlds: T,
    }

    fn compare(flags: &str) -> WorldFlags {
        Flags::parse_from(flags.split(' ')).worlds
    }

    #[test]
    fn several_numbers_of_robots_are_for_comparisons() {
        assert_eq!(compare("compare --robots 4,1").robots(), [4, 1]);
        let flags = ["train", "--robots", "1,2"];
        let refused = Flags::<SimulationFlags>::try_parse_from(flags).map(drop);
        let refused = refused.expect_err("two numbers").to_string();
        let is_named = refused.contains("'1,2'") && refused.contains("expected 1 to 64");
        assert!(is_named, "{refused}");
    }

    #[test]
    fn robots_of_a_team_start_in_random_cells() {
        let train = Flags::<SimulationFlags>::parse_from(["train", "--robots", "2"]);
        let of_training = train
            .worlds
            .check(ServerConfig::default())
            .expect("valid")
            .config;
        assert_eq!(of_training.world.start, Start::Random);
        let starts = [1, 2].map(|robots| match compare("compare").source(Some(robots)) {
            Ok(Source::Settings(checked, _)) => checked.config.world.start,
            _ => panic!("expected settings"),
        });
        assert_eq!(starts, [Start::Corner, Start::Random]);
    }

    #[test]
    fn without_states_the_model_is_the_worlds() {
        let flags = compare("compare --model wildfire-small --states=");
        let Ok(Source::Settings(checked, known)) = flags.source(None) else {
            panic!("expected settings");
        };
        let expected = model_named("wildfire-small").expect("built in");
        assert_eq!((checked.model, known), (expected, None));
    }
}
