//! Settings as flags, from the table of their declarations: `states_offset` becomes `--states-offset`.

use clap::{Arg, ArgGroup, ArgMatches, Args, Command, Error, FromArgMatches, Id};
use emberwatch_model::settings::{Setting, Settings, WorldSettings};
use serde_json::{Map, Value};
use std::marker::PhantomData;

/// The flags of all settings of `S`. Their group, for `conflicts_with` and `requires`, is `settings`.
#[derive(Debug)]
pub struct Flags<S> {
    given: Map<String, Value>,
    settings: PhantomData<S>,
}

impl<S> Flags<S> {
    /// Returns the values that were given, by the names of their settings. Flags that take several values separated by
    /// commas have a list of them.
    pub fn given(&self) -> &Map<String, Value> {
        &self.given
    }
}

impl<S: Settings> FromArgMatches for Flags<S> {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, Error> {
        let mut flags = Self {
            given: Map::new(),
            settings: PhantomData,
        };
        flags.update_from_arg_matches(matches)?;
        Ok(flags)
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), Error> {
        for Setting { name, .. } in S::settings() {
            let values = matches.get_many::<Value>(name).into_iter().flatten();
            let mut values: Vec<Value> = values.cloned().collect();
            let value = match values.len() {
                0 => continue,
                1 => values.remove(0),
                _ => Value::Array(values),
            };
            self.given.insert(name.into(), value);
        }
        Ok(())
    }
}

impl<S: Settings> Args for Flags<S> {
    fn group_id() -> Option<Id> {
        Some("settings".into())
    }

    fn augment_args(command: Command) -> Command {
        let settings = S::settings();
        let names = settings.iter().map(|setting| setting.name);
        let group = ArgGroup::new("settings").multiple(true).args(names);
        command
            .args(settings.iter().copied().map(flag))
            .group(group)
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

fn flag(setting: Setting) -> Arg {
    let placeholder = match setting.placeholder {
        "" if setting.is_switch() => "BOOL".into(),
        "" => setting.name.to_uppercase(),
        words => words.into(),
    };
    let mut of_worlds = WorldSettings::settings().into_iter();
    let is_of_worlds = of_worlds.any(|it| it.name == setting.name);
    let heading = if is_of_worlds { "Worlds" } else { "Server" };
    let flag = Arg::new(setting.name)
        .long(setting.name.replace('_', "-"))
        .help(setting.explanation())
        .help_heading(heading)
        .value_name(placeholder)
        .allow_negative_numbers(true)
        .value_parser(move |text: &str| setting.parse(text));
    if setting.is_switch() {
        return flag.num_args(0..=1).default_missing_value("true");
    }
    flag
}
