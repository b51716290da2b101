//! The description of a recorded world in TOML: a model file without the transition.

use super::cell_map::CellMap;
use super::file::{KernelEntry, ModelError, ModelFile, ObservationEntry, SensorEntry, StateEntry};
use super::parameters::Model;
use serde::{Deserialize, Serialize};

/// The names, observations and rewards of a recorded world's states.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Description {
    pub name: String,
    /// Duration of one step, as text for display.
    pub step: String,
    /// No-fly map with 1 for each cell closed to robots, as in a [`ModelFile`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub no_fly: Option<CellMap>,
    /// The sensor, as in a [`ModelFile`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensor: Option<SensorEntry>,
    /// The states, in the order of their values.
    pub states: Vec<DescribedState>,
    /// The observations, in the order of their values.
    pub observations: Vec<ObservationEntry>,
}

/// One state of a description. Keys and ranges are as in a [`StateEntry`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DescribedState {
    pub name: String,
    /// Colour in pictures, `#rrggbb`.
    pub color: String,
    #[serde(default)]
    pub reward: f64,
    /// `P(y | this state)`, one entry per observation (eq. 1).
    pub observed_as: Vec<f64>,
}

impl Description {
    /// Builds a model with these states, observations and rewards. In this model, no cell ever changes its state.
    ///
    /// # Errors
    /// If an entry is wrong. The error names the entry, the expected value and the given value.
    pub fn unchanging(&self) -> Result<Model, ModelError> {
        let share = 1.0 / self.states.len().max(1) as f64;
        let state = |state: &DescribedState| StateEntry {
            name: state.name.clone(),
            color: state.color.clone(),
            initial: share,
            reward: state.reward,
            bias: 0.0,
            observed_as: state.observed_as.clone(),
        };
        let stays = |state: &DescribedState| KernelEntry {
            from: state.name.clone(),
            to: state.name.clone(),
            scale: 1.0,
            weights: vec![vec![1.0]],
        };
        Model::new(ModelFile {
            name: self.name.clone(),
            kernel_size: Some([1, 1]),
            edge: None,
            maps: None,
            no_fly: self.no_fly.clone(),
            sensor: self.sensor.clone(),
            states: self.states.iter().map(state).collect(),
            observations: self.observations.clone(),
            kernel: self.states.iter().map(stays).collect(),
            transitions: Vec::new(),
        })
    }

    /// Parses a description and builds its unchanging model.
    ///
    /// # Errors
    /// If the text is not a valid description, or an entry is wrong.
    pub fn model_of(text: &str) -> Result<Model, ModelError> {
        toml::from_str::<Self>(text)?.unchanging()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Ratio;
    use ndarray::Array4;

    const TEXT: &str = r##"
        name = "two"
        step = "10 min"
        states = [
            { name = "a", color = "#000000", observed_as = [1.0] },
            { name = "b", color = "#ffffff", observed_as = [1.0], reward = 2.0 },
        ]
        observations = [{ name = "x", color = "#123abc" }]
    "##;

    #[test]
    fn a_description_makes_a_model_whose_cells_never_change() {
        let model = Description::model_of(TEXT).expect("valid");
        let unchanging = Array4::from_shape_vec((2, 2, 1, 1), vec![1.0, 0.0, 0.0, 1.0]);
        assert_eq!(model.ratio().map(Ratio::kernel), unchanging.as_ref().ok());
        assert_eq!(model.reward().to_vec(), [0.0, 2.0]);
        assert_eq!((model.name(), model.target_state()), ("two", 1));
    }

    #[test]
    fn keys_of_a_transition_are_refused() {
        for (from, to, words) in [
            ("step = \"10 min\"", "", "missing field `step`"),
            ("reward", "bias", "unknown field `bias`"),
            ("reward", "initial", "unknown field `initial`"),
            ("step", "kernel_size", "unknown field `kernel_size`"),
        ] {
            let error = Description::model_of(&TEXT.replace(from, to)).expect_err(words);
            assert!(error.to_string().contains(words), "{error}");
        }
    }
}
