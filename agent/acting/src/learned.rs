//! Learned values, loaded from checkpoints: at most one value of each type.

use emberwatch_model::Model;
use serde::{Deserialize, Serialize};
use std::any::Any;
use std::fmt;
use std::sync::Arc;

/// Values from checkpoints, for the beliefs and goals that use them. Clones share the values.
#[derive(Clone, Default)]
pub struct Learned {
    values: Vec<Arc<dyn Any + Send + Sync>>,
    /// The worlds in which each checkpoint was learned.
    pub worlds: Vec<WorldNames>,
}

/// What worlds are called. Tells whether a checkpoint is used where it was learned.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct WorldNames {
    /// Name of the model. `None` if the server hides it.
    pub model: Option<String>,
    /// Names of the observations. Empty if unknown.
    pub observations: Vec<String>,
}

impl WorldNames {
    /// Returns the names of a model's worlds.
    pub fn of(model: &Model) -> Self {
        Self {
            model: Some(model.name().into()),
            observations: model.observation_names(),
        }
    }

    fn differ(&self, other: &Self) -> bool {
        let models = self.model.as_ref().zip(other.model.as_ref());
        let is_known = !self.observations.is_empty() && !other.observations.is_empty();
        models.is_some_and(|(own, other)| own != other)
            || is_known && self.observations != other.observations
    }
}

impl fmt::Display for WorldNames {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let model = self.model.as_deref().unwrap_or("a hidden model");
        let observations = self.observations.join(", ");
        write!(formatter, "{model} (observations {observations})")
    }
}

impl Learned {
    /// Returns the value of type `T`, if a checkpoint contained one.
    pub fn get<T: Any>(&self) -> Option<&T> {
        let mut values = self.values.iter();
        values.find_map(|value| value.downcast_ref())
    }

    /// Returns a warning if a checkpoint was learned in worlds of another name than these.
    pub fn warning_in(&self, worlds: &WorldNames) -> Option<String> {
        let other = self.worlds.iter().find(|own| own.differ(worlds))?;
        Some(format!(
            "checkpoint: expected one learned in worlds of {worlds}, got one learned in worlds of {other}"
        ))
    }

    /// Stores a value, and drops any earlier value of the same type. Returns whether the dropped value was different.
    pub fn put<T: Any + Send + Sync + PartialEq>(&mut self, value: T) -> bool {
        let is_other = self.get::<T>().is_some_and(|before| *before != value);
        self.values.retain(|before| !before.is::<T>());
        self.values.push(Arc::new(value));
        is_other
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn worlds_of_another_model_or_with_other_observations_are_named_in_a_warning() {
        let names = |model: &str| WorldNames::of(&Model::built_in(model).expect("built in"));
        let hidden = |model| WorldNames {
            model: None,
            ..names(model)
        };
        let mut learned = Learned::default();
        learned.worlds.push(names("wildfire"));
        let warned = |worlds: &WorldNames| learned.warning_in(worlds);
        for same in [names("wildfire"), hidden("wildfire"), WorldNames::default()] {
            assert_eq!(warned(&same), None, "{same}");
        }
        let text = warned(&names("wildfire-latent")).expect("another model");
        assert_eq!(
            text,
            "checkpoint: expected one learned in worlds of wildfire-latent (observations normal, latent, fire), \
             got one learned in worlds of wildfire (observations normal, latent, fire)"
        );
        assert!(warned(&hidden("road-ice")).is_some(), "other observations");
        assert_eq!(warned(&hidden("wildfire-latent")), None, "a hidden model");
    }

    #[test]
    fn each_type_has_one_value() {
        let mut learned = Learned::default();
        assert_eq!(learned.get::<u8>(), None);
        assert!(!learned.put(3_u8) && !learned.put("text"));
        assert!(!learned.put(3_u8), "the same");
        assert!(learned.put(4_u8), "another");
        assert_eq!(learned.get::<u8>(), Some(&4));
        assert_eq!(learned.get::<&str>(), Some(&"text"));
    }
}
