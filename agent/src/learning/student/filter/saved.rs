//! Where a learner's robots are, in a checkpoint.

use crate::estimation::belief::Belief;
use crate::learning::checkpoint::{Bytes, Contents, Problem, Tensor};
use crate::rollout::Robot;
use crate::rollout::agent::Agent;
use crate::server::client::{Observation, Place};
use ndarray::Array3;
use protocol::Shape;
use std::collections::BTreeMap;
use std::ops::Range;

/// Names in checkpoints.
const PLACES: &str = "worlds.places";
const FRAMES: &str = "worlds.frames";
const BELIEFS: &str = "worlds.beliefs";
const ESTIMATES: &str = "worlds.estimates";

/// Numbers of a place.
const N_PLACE: usize = size_of::<Place>() / size_of::<u64>();

/// Where a checkpoint left a world: what it showed, the belief about what comes next, and the estimate
/// behind it, where paths are planned on that.
#[derive(Debug, Clone, PartialEq)]
pub struct SavedWorld {
    place: Place,
    frame: Vec<u8>,
    belief: Belief,
    estimate: Option<Belief>,
}

impl SavedWorld {
    /// Whether a world shows what it showed then. That may be another server's: seeds, step, flight
    /// and noise of sensors would all have to be the same.
    pub fn is_of(&self, observation: &Observation) -> bool {
        self.place == observation.place() && self.frame == observation.frame.as_bytes()
    }

    /// Whether any of these worlds shows what it showed then.
    pub fn any_is_of(
        all: &BTreeMap<u32, Self>,
        worlds: Range<u32>,
        observations: &[Observation],
    ) -> bool {
        worlds.zip(observations).any(|(world, observation)| {
            let saved = all.get(&world);
            saved.is_some_and(|saved| saved.is_of(observation))
        })
    }

    /// Gives an agent the belief, and the estimate if its paths are planned on that.
    pub fn restore(&self, agent: &mut Agent) {
        agent.take_over(self.belief.clone());
        if let Some(estimate) = &self.estimate {
            agent.basis_mut().see(estimate);
        }
    }

    /// Puts where robots are into a checkpoint.
    pub fn store<'a>(
        robots: impl Iterator<Item = (u32, &'a Robot)>,
        shape: Shape,
        contents: &mut Contents,
    ) {
        let (height, width) = shape.dim();
        let (mut places, mut frames) = (Vec::new(), Vec::new());
        let (mut beliefs, mut estimates) = (Vec::new(), Vec::new());
        let (mut n_worlds, mut n_states) = (0, 0);
        for (world, robot) in robots {
            let (agent, observation) = (&robot.agent, robot.observation());
            places.push(u64::from(world));
            places.extend(observation.place());
            frames.extend_from_slice(observation.frame.as_bytes());
            beliefs.extend_from_slice(agent.belief().as_slice());
            estimates.extend(agent.estimate().map(Belief::as_slice));
            n_states = agent.belief().n_states();
            n_worlds += 1;
        }
        let tensor = |numbers| Tensor {
            shape: vec![n_worlds, n_states, height, width],
            numbers,
        };
        if estimates.len() == n_worlds {
            let estimates = tensor(estimates.concat());
            contents.tensors.insert(ESTIMATES.into(), estimates);
        }
        let frames = Bytes {
            shape: vec![n_worlds, height, width],
            bytes: frames,
        };
        let places = Bytes::of_counts(places);
        contents.bytes.insert(PLACES.into(), places);
        contents.bytes.insert(FRAMES.into(), frames);
        contents.tensors.insert(BELIEFS.into(), tensor(beliefs));
    }

    /// What [`Self::store`] put there, by world; none of another grid.
    ///
    /// # Errors
    /// [`Problem`] names what is missing or of another shape.
    pub fn restored(
        n_states: usize,
        shape: Shape,
        contents: &Contents,
    ) -> Result<BTreeMap<u32, Self>, Problem> {
        let (height, width) = shape.dim();
        let places = contents.counts(PLACES)?;
        let (places, _) = places.as_chunks::<{ N_PLACE + 1 }>();
        let frames = contents.bytes.get(FRAMES);
        if frames.is_some_and(|frames| frames.shape.get(1..) != Some(&[height, width])) {
            return Ok(BTreeMap::new());
        }
        let frames = contents.bytes(FRAMES, &[places.len(), height, width])?;
        let dim = [places.len(), n_states, height, width];
        let beliefs = contents.tensor(BELIEFS, &dim)?;
        let estimates = match contents.tensors.contains_key(ESTIMATES) {
            true => Some(contents.tensor(ESTIMATES, &dim)?),
            false => None,
        };
        let n_cells = height * width;
        let belief = |name: &str, numbers: &[f32], index: usize| {
            let numbers = numbers[index * n_states * n_cells..][..n_states * n_cells].to_vec();
            let numbers = Array3::from_shape_vec((n_states, height, width), numbers);
            let numbers = numbers.expect("invariant: S x H x W numbers");
            let belief = Belief::from_probabilities(numbers);
            belief.map_err(|error| wrong(name, "beliefs", error))
        };
        let each = places.iter().zip(frames.chunks_exact(n_cells));
        let saved = |(index, (numbers, frame)): (usize, (&[u64; N_PLACE + 1], &[u8]))| {
            // Before the place, the world.
            let &[world, ref place @ ..] = numbers;
            let world = u32::try_from(world).map_err(|_| wrong(PLACES, "worlds", world))?;
            let estimate = estimates.map(|estimates| belief(ESTIMATES, estimates, index));
            let saved = Self {
                place: *place,
                frame: frame.to_vec(),
                belief: belief(BELIEFS, beliefs, index)?,
                estimate: estimate.transpose()?,
            };
            Ok((world, saved))
        };
        each.enumerate().map(saved).collect()
    }
}

fn wrong(name: &str, expected: &str, got: impl ToString) -> Problem {
    Problem::Value {
        name: name.into(),
        expected: expected.into(),
        got: got.to_string(),
    }
}
