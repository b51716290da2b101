//! Flags that choose the worlds: on a running server, or on a private server that the command starts.

use super::shared::{WaitFlag, model_named, model_of, parse_range, with_sensor};
use crate::benchmark::arena::{Arena, MAX_BATCH};
use crate::client::launch::OwnServer;
use anyhow::{Result, ensure};
use clap::{Args, value_parser};
use emberwatch_protocol::built_in::{listed, state_names};
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::control::ServerInfo;
use emberwatch_protocol::model::MAX_RADIUS;
use emberwatch_protocol::task::{MAX_SEEDS, Task};
use emberwatch_protocol::{Model, Shape};
use std::ops::Range;
use std::path::PathBuf;

/// The default model of simulated worlds.
const DEFAULT_MODEL: &str = "wildfire";

const BENCHMARK_BURN_IN: u64 = 25_000;

const BENCHMARK_STEPS: u64 = 1500;

const BENCHMARK_SEEDS: Range<u64> = 0..8;

/// Flags that choose the worlds of a comparison.
#[derive(Debug, Args)]
pub struct WorldFlags {
    /// Use the worlds of this running server; without it, the command starts a server and stops it at the end
    #[arg(long)]
    instance: Option<String>,
    #[command(flatten)]
    wait: WaitFlag,
    /// World seeds, FIRST..END [default: 0..8, or the task's test seeds]
    #[arg(long, value_parser = parse_seeds)]
    seeds: Option<Range<u64>>,
    /// Scored steps per world [default: the task's episode length, or 1500, or the shortest episode's length if less]
    #[arg(long, value_parser = value_parser!(u64).range(1..=10_000_000))]
    steps: Option<u64>,
    /// Steps simulated before the first scored one [default: 25000, or the running server's]
    #[arg(long, conflicts_with_all = ["states", "task"])]
    burn_in: Option<u64>,
    /// Path of emberwatch-server [default: in the folder of this program, or on PATH]
    #[arg(long, value_name = "PROGRAM", conflicts_with = "instance")]
    server: Option<PathBuf>,
    #[command(flatten)]
    grid: GridFlags,
}

/// Flags for the worlds of a started server.
#[derive(Debug, Args)]
pub struct GridFlags {
    #[arg(long, value_name = "NAME|FILE", value_parser = Task::named,
        conflicts_with_all = ["instance", "model", "height", "width", "moves", "states"],
        help = format!("Task of the started server: {}, or a task file",
            listed(Task::built_in_names())))]
    pub task: Option<Task>,
    #[arg(long, value_name = "NAME|FILE", conflicts_with = "instance",
        help = format!("Model of the started server: {}, or a model file; with --states: the model of beliefs \
            [default: {DEFAULT_MODEL}; with --states: none]", listed(Model::built_in_names())))]
    model: Option<String>,
    #[arg(long, value_parser = value_parser!(u8).range(..=MAX_RADIUS as i64), conflicts_with_all = ["instance", "task"],
        help = format!("Rows and columns that robots see beyond each cell of their path, 0 to {MAX_RADIUS}, on the \
            started server [default: the model's]"))]
    sensor_radius: Option<u8>,
    /// Grid height of the started server, in cells
    #[arg(long, default_value_t = 64, conflicts_with = "instance")]
    height: usize,
    /// Grid width of the started server, in cells
    #[arg(long, default_value_t = 64, conflicts_with = "instance")]
    width: usize,
    /// Moves per path on the started server
    #[arg(long, default_value_t = 64, conflicts_with = "instance")]
    moves: usize,
    #[arg(long, value_name = "NAME|FILE|FOLDER", conflicts_with_all = ["instance", "height", "width"],
        help = format!("Recorded states for the started server, instead of simulated states: {}, or a .npz or .npy \
            file or folder", listed(state_names())))]
    states: Option<String>,
    /// Let the world's seed also choose a symmetry of the grid: a rotation or reflection of the recorded states
    #[arg(long, requires = "states")]
    states_symmetries: bool,
    /// Start each episode at a recorded step from 0 to STEPS, drawn by the world's seed
    #[arg(long, value_name = "STEPS", requires = "states", default_value_t = 0)]
    states_offset: u64,
}

/// An arena, and the server if one was started for it. Dropping this value stops that server.
pub struct Worlds {
    pub arena: Arena,
    _own: Option<OwnServer>,
}

impl WorldFlags {
    /// Attaches to the running server, or starts one after `check` has accepted the model.
    ///
    /// `n_robots`: robots per world; `None`: one robot on a started server, any number on a running server.
    pub fn open(
        &self,
        n_robots: Option<u32>,
        check: impl Fn(&Model) -> Result<()>,
    ) -> Result<Worlds> {
        let (instance, own, model) = match &self.instance {
            Some(name) => {
                let instance = Instance::new(name)?;
                self.wait.for_server(&instance, || false)?;
                (instance, None, None)
            }
            None => {
                let model = self.grid.check()?;
                model.as_ref().map_or(Ok(()), check)?;
                let mut arguments = self.server_arguments();
                if self.grid.task.is_none() {
                    arguments.extend(robot_arguments(n_robots.unwrap_or(1)));
                }
                let server = OwnServer::start(self.server.clone(), &arguments)?;
                (server.instance().clone(), Some(server), model)
            }
        };
        let mut arena = Arena::open(&instance, self.n_seeds())?;
        if let Some(model) = model.filter(|_| self.grid.states.is_some()) {
            arena.know(model)?;
        }
        let got = arena.info().burn_in;
        let asked = self.burn_in.unwrap_or(got);
        ensure!(
            asked == got,
            "--burn-in: expected the running server's {got}, got {asked}"
        );
        let got = arena.info().n_robots;
        let asked = n_robots.unwrap_or(got);
        ensure!(
            asked == got,
            "--robots: expected the running server's {got}, got {asked}"
        );
        Ok(Worlds { arena, _own: own })
    }

    /// Returns the number of scored steps. Fails if the shortest episode has fewer steps.
    pub fn steps(&self, info: &ServerInfo) -> Result<u64> {
        let longest = info.shortest_episode().unwrap_or(u64::MAX);
        let of_task = self.task().map(|task| task.world.max_steps);
        let default = of_task.unwrap_or(BENCHMARK_STEPS.min(longest));
        let steps = self.steps.unwrap_or(default);
        ensure!(
            steps <= longest,
            "--steps: expected at most {longest}, the length of the shortest episode, got {steps}"
        );
        Ok(steps)
    }

    pub fn task(&self) -> Option<&Task> {
        self.grid.task.as_ref()
    }

    pub fn seeds(&self) -> Range<u64> {
        let of_task = || self.task().map(|task| task.test_seeds.clone());
        let given = self.seeds.clone().or_else(of_task);
        given.unwrap_or(BENCHMARK_SEEDS)
    }

    fn n_seeds(&self) -> u32 {
        let seeds = self.seeds();
        (seeds.end - seeds.start) as u32
    }

    fn server_arguments(&self) -> Vec<String> {
        let worlds = self.n_seeds().min(MAX_BATCH);
        let burn_in = self.burn_in.unwrap_or(BENCHMARK_BURN_IN);
        let mut arguments = self.grid.arguments(worlds, self.seeds().start, burn_in);
        arguments.push("--publish-truth".into());
        arguments
    }
}

/// Returns the server's flags for `n_robots` robots per world. Several robots start at random cells: with the same
/// start and the same belief, all would fly the same path forever.
fn robot_arguments(n_robots: u32) -> Vec<String> {
    let robots = ["--robots".to_owned(), n_robots.to_string()];
    let start = ["--start", "random"].iter().filter(|_| n_robots > 1);
    robots
        .into_iter()
        .chain(start.map(|text| (*text).into()))
        .collect()
}

impl GridFlags {
    /// Checks that the model fits the grid, and returns it. For recorded states, returns the model with which beliefs
    /// predict, if one was given.
    pub fn check(&self) -> Result<Option<Model>> {
        let (model, height, width) = match &self.task {
            Some(task) if task.world.is_recorded() => return Ok(None),
            Some(task) => (model_of(task)?, task.world.height, task.world.width),
            None if self.states.is_some() => return self.model_of_states(),
            None => {
                let model = with_sensor(model_named(self.model())?, self.radius())?;
                (model, self.height, self.width)
            }
        };
        model.check_on(Shape::new(height, width)?)?;
        Ok(Some(model))
    }

    /// Returns the model with which beliefs predict recorded states, if one was given, with the server's sensor.
    pub fn model_of_states(&self) -> Result<Option<Model>> {
        let model = self.model.as_deref().filter(|_| self.states.is_some());
        let model = model.map(|model| with_sensor(model_named(model)?, self.radius()));
        model.transpose()
    }

    fn model(&self) -> &str {
        self.model.as_deref().unwrap_or(DEFAULT_MODEL)
    }

    fn radius(&self) -> Option<usize> {
        self.sensor_radius.map(usize::from)
    }

    /// Returns the flags of a server with this number of worlds, first seed and burn-in.
    pub fn arguments(&self, worlds: u32, seed: u64, burn_in: u64) -> Vec<String> {
        let settings = [
            ("--worlds", worlds.to_string()),
            ("--seed", seed.to_string()),
        ];
        let of_worlds = match (&self.task, &self.states) {
            (Some(task), _) => vec![("--task", task.source.clone())],
            (None, Some(states)) => vec![
                ("--moves", self.moves.to_string()),
                ("--states", states.clone()),
                ("--states-symmetries", self.states_symmetries.to_string()),
                ("--states-offset", self.states_offset.to_string()),
            ],
            (None, None) => vec![
                ("--moves", self.moves.to_string()),
                ("--model", self.model().into()),
                ("--height", self.height.to_string()),
                ("--width", self.width.to_string()),
                ("--burn-in", burn_in.to_string()),
            ],
        };
        let radius = self
            .sensor_radius
            .map(|it| ("--sensor-radius", it.to_string()));
        let pairs = settings.into_iter().chain(of_worlds).chain(radius);
        pairs
            .flat_map(|(flag, value)| [flag.to_owned(), value])
            .collect()
    }
}

fn parse_seeds(text: &str) -> Result<Range<u64>, String> {
    let seeds: Range<u64> = parse_range(text)?;
    match seeds.end - seeds.start {
        1..=MAX_SEEDS => Ok(seeds),
        _ => Err(format!("expected 1 to {MAX_SEEDS} seeds")),
    }
}
