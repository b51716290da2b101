//! The channel `agent`: the beliefs that agents publish for displays. [`AgentBelief`] is a decoded sample.

use crate::message::{AgentHeader, VERSION};
use crate::sample::Sample;
use emberwatch_model::grid::{Probabilities, Shape};
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Maximum number of states of a published belief.
pub const MAX_STATES: u32 = 256;

/// Maximum size of an [`Intent`] in JSON, in bytes.
pub const MAX_INTENT_BYTES: usize = 65_536;

/// The policy, estimator and objective behind an agent's last path.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Intent {
    pub policy: String,
    pub belief_from: String,
    pub objective: String,
    pub states: Vec<String>,
    pub plan_millis: f64,
}

/// A checked sample of the channel `agent`.
#[derive(Debug, Clone, PartialEq)]
pub struct AgentBelief {
    pub header: AgentHeader,
    /// The posterior belief about the state at that step, shape `[S, H, W]`, each value in 0..=1.
    pub belief: Probabilities,
    pub intent: Intent,
}

#[derive(Debug, Error, PartialEq, Eq)]
#[error("sample of an agent: {problem}")]
pub struct BeliefError {
    problem: String,
}

impl TryFrom<&Sample<AgentHeader>> for AgentBelief {
    type Error = BeliefError;

    fn try_from(sample: &Sample<AgentHeader>) -> Result<Self, BeliefError> {
        let garbled = |problem: String| BeliefError { problem };
        let header = sample.header;
        if header.version != VERSION {
            let got = header.version;
            return Err(garbled(format!("version: expected {VERSION}, got {got}")));
        }
        let shape = Shape::new(header.height as usize, header.width as usize)
            .map_err(|error| garbled(error.to_string()))?;
        if !(1..=MAX_STATES).contains(&header.n_states) {
            let got = header.n_states;
            return Err(garbled(format!(
                "states: expected 1 to {MAX_STATES}, got {got}"
            )));
        }
        let n_numbers = header.n_states as usize * shape.n_cells();
        let (numbers, text) = sample
            .payload
            .split_at_checked(n_numbers * size_of::<f32>())
            .ok_or_else(|| {
                let got = sample.payload.len();
                garbled(format!(
                    "belief: expected {n_numbers} numbers, got {got} bytes"
                ))
            })?;
        if text.len() > MAX_INTENT_BYTES {
            let got = text.len();
            return Err(garbled(format!(
                "intent: expected at most {MAX_INTENT_BYTES} bytes, got {got}"
            )));
        }
        let numbers: Vec<f32> = numbers
            .chunks_exact(size_of::<f32>())
            .map(bytemuck::pod_read_unaligned)
            .collect();
        if let Some(got) = numbers.iter().find(|p| !(0.0..=1.0).contains(*p)) {
            return Err(garbled(format!(
                "belief: expected probabilities, got {got}"
            )));
        }
        let (height, width) = shape.dim();
        Ok(Self {
            header,
            belief: Probabilities::from_shape_vec(
                (header.n_states as usize, height, width),
                numbers,
            )
            .expect("invariant: counted above"),
            intent: serde_json::from_slice(text)
                .map_err(|error| garbled(format!("intent: {error}")))?,
        })
    }
}
