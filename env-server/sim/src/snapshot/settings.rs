//! The settings on which a server's worlds depend. A snapshot can be restored on a server for which these are equal.

use super::error::SnapshotError;
use crate::config::Checked;
use crate::world::Rules;
use bincode::{Decode, Encode};
use emberwatch_model::hazards::Hazards;
use emberwatch_model::maps::Maps;
use emberwatch_model::settings::{Setting, Settings as _, WorldSettings};
use emberwatch_model::text::shortened;
use emberwatch_model::{ModelError, ModelFile};
use sha2::{Digest, Sha256};
use std::fmt::Debug;

/// Key of the setting that contains the task's name. It is the last setting, and exists only if a task determines the
/// worlds' settings.
const TASK: &str = "task";

/// Version of the simulation. It is increased whenever a change to the code makes the same settings and seed give
/// another trajectory or other rewards.
const WORLDS: u32 = 1;

#[derive(Debug, Clone, PartialEq, Eq, Encode, Decode)]
pub struct Settings {
    /// The model file as TOML, without its maps.
    pub model: String,
    pub others: Vec<(String, String)>,
}

#[derive(Debug, Clone)]
pub struct WorldSpec {
    pub settings: Settings,
    pub rules: Rules,
}

impl WorldSpec {
    pub fn of(checked: &Checked) -> Result<Self, ModelError> {
        let Checked {
            config,
            model,
            shape,
            recorded,
            ..
        } = checked;
        let mut rules = Rules::new(
            model,
            *shape,
            config.world.burn_in,
            config.world.max_steps,
            config.world.start,
        )?;
        (rules.history, rules.n_moves) = (config.history as usize, config.world.moves);
        rules.n_robots = config.world.robots as usize;
        if let Some(states) = recorded {
            rules = rules.with_recorded(states.recorded.clone());
        }
        let settings = Settings::of(checked);
        Ok(Self { settings, rules })
    }
}

impl Settings {
    pub fn of(checked: &Checked) -> Self {
        let config = &checked.config;
        let file = ModelFile {
            maps: None,
            ..checked.model.file().clone()
        };
        let (values, recorded) = (config.values(), checked.recorded.as_ref());
        let sequences = recorded.map_or_else(String::new, |states| {
            let n_sequences = states.recorded.n_sequences();
            format!("{n_sequences} sequences of CRC-32 {:08x}", states.checksum)
        });
        let lowercase = |value: &dyn Debug| format!("{value:?}").to_lowercase();
        let of_world = WorldSettings::settings().into_iter();
        let of_world = of_world.filter(|it| recorded.is_some() || !it.for_states);
        let of_world = of_world.flat_map(|Setting { name, .. }| match name {
            "model" | "sensor_radius" => vec![], // The model's text contains both.
            "states" => vec![(name, sequences.clone())],
            "start" => vec![
                ("coverage", lowercase(&config.coverage)),
                (name, lowercase(&config.world.start)),
            ],
            _ => vec![(name, values[name].to_string())],
        });
        let maps = checked.model.hazards().map(Hazards::maps);
        let maps = maps.filter(|maps| !maps.is_empty());
        let maps = maps.map(|maps| ("maps", digest(maps)));
        let task = checked.task.iter().map(|task| (TASK, task.name.clone()));
        let others = of_world.chain(maps).chain(task);
        Self {
            model: toml::to_string(&file).expect("invariant: a model was read from TOML"),
            others: others.map(|(name, value)| (name.into(), value)).collect(),
        }
    }

    /// Returns 16 hexadecimal digits that identify the worlds. Results are comparable only if these digits are equal.
    ///
    /// The hash covers the model or the recorded states, grid, moves, robots, start, burn-in and whether robots see
    /// every cell. It omits the task's name, and `max_steps`, because each result states its own number of steps.
    pub fn worlds_fingerprint(&self) -> String {
        let mut hash = Sha256::new();
        hash.update(format!("worlds {WORLDS}\n{}\n", self.model));
        for (name, value) in &self.others {
            // `client` counts as `path`, because robots then see the cells of their path unless the client asks for
            // more.
            let value = if value == "client" { "path" } else { value };
            if name != TASK && name != "max_steps" {
                hash.update(format!("{name} = {value}\n"));
            }
        }
        hexadecimal(&hash.finalize()[..8])
    }

    pub fn check(&self, server: &Self) -> Result<(), SnapshotError> {
        let other = |setting: &str, expected: &str, got: &str| {
            let problem = format!("{setting}: expected {expected}, as on this server, got {got}");
            SnapshotError::Unfit(problem)
        };
        if self.model != server.model {
            let pairs = server.model.lines().zip(self.model.lines());
            let line = pairs.into_iter().find(|(expected, got)| expected != got);
            let n_lines = |text: &str| format!("{} lines", text.lines().count());
            let quoted = |line| format!("{:?}", shortened(line));
            let (expected, got) = line.map_or_else(
                || (n_lines(&server.model), n_lines(&self.model)),
                |(expected, got)| (quoted(expected), quoted(got)),
            );
            return Err(other("model", &expected, &got));
        }
        // The task's name is not compared, because the same settings may come from a task or from flags.
        let others = server.others.iter().filter(|(name, _)| name != TASK);
        for (index, (setting, expected)) in others.enumerate() {
            let got = self
                .others
                .get(index)
                .filter(|(name, _)| name == setting)
                .map_or("nothing", |(_, value)| value);
            if got != expected {
                return Err(other(setting, expected, got));
            }
        }
        Ok(())
    }
}

/// Returns the SHA-256 of the names, shapes and values of maps in hexadecimal digits.
fn digest(maps: &Maps) -> String {
    let mut hash = Sha256::new();
    for (name, map) in maps {
        hash.update(format!("{name:?} {:?}\n", map.shape()));
        for factor in map {
            hash.update(factor.to_le_bytes());
        }
    }
    hexadecimal(&hash.finalize())
}

fn hexadecimal(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
