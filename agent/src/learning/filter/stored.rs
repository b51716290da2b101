//! What learns in a checkpoint: the iterates by name, and where the streams are.

use crate::estimation::parameters::{Dimensions, Parameters};
use crate::learning::checkpoint::{Bytes, Contents, Problem, Tensor};
use crate::learning::filter::adam::Adam;
use crate::learning::filter::trainer::{Iterates, Trainer};

/// Names in checkpoints.
const PLACES: &str = "streams.places";
const BELIEFS: &str = "streams.beliefs";
const LAP: &str = "lap";
const LAPS: &str = "laps";
const UPDATES: &str = "updates";

/// In place of the block of a stream that has none.
const NONE: u64 = u64::MAX;

impl Iterates {
    /// Puts everything into a checkpoint.
    pub fn store(&self, contents: &mut Contents) {
        let shapes = self.parameters.dimensions.shapes();
        let parts = [
            ("", &self.parameters),
            (".first_moment", &self.adam.first),
            (".second_moment", &self.adam.second),
        ];
        for (suffix, part) in parts {
            let named = Parameters::NAMES.iter().zip(&shapes).zip(&part.tensors);
            for ((name, shape), numbers) in named {
                let (shape, numbers) = (shape.clone(), numbers.clone());
                let tensor = Tensor { shape, numbers };
                contents.tensors.insert(format!("{name}{suffix}"), tensor);
            }
        }
        let updates = self.adam.n_steps.to_string();
        contents.texts.insert(UPDATES.into(), updates);
    }

    /// What [`Self::store`] put there.
    ///
    /// # Errors
    /// [`Problem`] names the tensor that is missing or of another shape.
    pub fn restored(dimensions: Dimensions, contents: &Contents) -> Result<Self, Problem> {
        let shapes = dimensions.shapes();
        let part = |suffix: &str| -> Result<Parameters, Problem> {
            let mut part = Parameters::zeros(dimensions);
            for ((name, shape), numbers) in
                Parameters::NAMES.iter().zip(&shapes).zip(&mut part.tensors)
            {
                let tensor = contents.tensor(&format!("{name}{suffix}"), shape)?;
                numbers.copy_from_slice(tensor);
            }
            Ok(part)
        };
        Ok(Self {
            parameters: part("")?,
            adam: Adam {
                first: part(".first_moment")?,
                second: part(".second_moment")?,
                n_steps: contents.count(UPDATES)?,
            },
        })
    }
}

impl Trainer {
    /// Puts the places of the streams, of shape `[S, H, W]`, into a checkpoint.
    pub fn store(&self, shape: [usize; 3], contents: &mut Contents) {
        let places = self.streams.iter();
        let places = places.flat_map(|stream| [stream.block.unwrap_or(NONE), stream.n_done as u64]);
        let places = Bytes::of_counts(places);
        contents.bytes.insert(PLACES.into(), places);
        let beliefs = self.streams.iter().map(|stream| &*stream.belief);
        let [states, height, width] = shape;
        let beliefs = Tensor {
            shape: vec![self.streams.len(), states, height, width],
            numbers: beliefs.collect::<Vec<_>>().concat(),
        };
        contents.tensors.insert(BELIEFS.into(), beliefs);
        let lap = Bytes::of_counts(self.lap.iter().copied());
        contents.bytes.insert(LAP.into(), lap);
        contents.texts.insert(LAPS.into(), self.n_laps.to_string());
    }

    /// Takes what [`Self::store`] put there, with the same settings.
    ///
    /// # Errors
    /// [`Problem`] names what is not of that form; nothing was changed then.
    pub fn restore(&mut self, shape: [usize; 3], contents: &Contents) -> Result<(), Problem> {
        let places = contents.counts(PLACES)?;
        let (places, rest) = places.as_chunks::<2>();
        if places.len() != self.streams.len() || !rest.is_empty() {
            return Err(wrong(
                format!("places of {} streams", self.streams.len()),
                places.len(),
            ));
        }
        let most = self.config.block_windows as u64;
        if let Some([_, n_done]) = places.iter().find(|[_, n_done]| *n_done > most) {
            return Err(wrong(format!("at most {most} windows of a block"), n_done));
        }
        let [states, height, width] = shape;
        let shape = [self.streams.len(), states, height, width];
        let beliefs = contents.tensor(BELIEFS, &shape)?;
        let (lap, n_laps) = (contents.counts(LAP)?, contents.count(LAPS)?);
        let beliefs = beliefs.chunks(states * height * width);
        for ((stream, &[block, n_done]), belief) in self.streams.iter_mut().zip(places).zip(beliefs)
        {
            stream.block = (block != NONE).then_some(block);
            stream.n_done = n_done as usize;
            stream.belief.copy_from_slice(belief);
        }
        (self.lap, self.n_laps) = (lap, n_laps);
        Ok(())
    }
}

fn wrong(expected: String, got: impl ToString) -> Problem {
    Problem::Value {
        name: PLACES.into(),
        expected,
        got: got.to_string(),
    }
}
