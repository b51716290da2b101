//! What Algorithm 1 has learned, and where it stands: as a checkpoint, and from one.

use crate::belief::Belief;
use crate::checkpoint::{Bytes, Contents, Problem, Tensor};
use crate::client::Place;
use crate::config::AgentConfig;
use crate::learned::{LearnedNetwork, settings};
use crate::network::{Autoencoder, Dqn, DqnInput, NetworkShape, Replay, Tensors};
use crate::planner::PlanBasis;
use crate::policy::Policy;
use crate::reward::RewardEstimate;
use crate::student::Site;
use protocol::model::MAX_VALUES;
use protocol::{Frame, Probabilities, Shape};

/// Names in checkpoints of what paths are planned on and actions go by, where these are wanted.
const ESTIMATE: &str = "state.estimate";
const BEFORE: &str = "state.before";

/// What is learned, and where learning stands.
pub struct Progress {
    /// The model.
    pub autoencoder: Autoencoder,
    /// The choice of objectives.
    pub dqn: Dqn,
    /// What that sees.
    pub input: DqnInput,
    /// What paths are planned on.
    pub basis: PlanBasis,
    /// The frames that are learned from.
    pub replay: Replay,
    /// Which state pays.
    pub reward: RewardEstimate,
    /// Iterations of Algorithm 1.
    pub iterations: u64,
    /// Where the world is that the hidden vector knows, if any.
    pub place: Option<Place>,
}

impl Progress {
    /// Before the first frame.
    pub fn first(site: &Site, config: &AgentConfig) -> Self {
        let n_states = network_shape(site.shape, site.n_observations, config).n_states;
        let settings = config.autoencoder.settings();
        let (seed, grid) = (config.seed, site.shape);
        let autoencoder = Autoencoder::new(settings, grid, n_states, site.n_observations, seed);
        let n_actions = Policy::network_choices(n_states).len();
        let input = config.dqn.input;
        let n_inputs = input.length(settings.hidden, n_states);
        Self {
            dqn: Dqn::new(config.dqn.settings(), n_inputs, n_actions, seed),
            input,
            basis: PlanBasis::new(config.objective.belief),
            autoencoder,
            replay: Replay::new(settings.replay),
            reward: RewardEstimate::new(n_states),
            iterations: 0,
            place: None,
        }
    }

    /// The state that pays most, as far as rewards tell by now.
    pub(super) fn target(&self) -> usize {
        let target = self.reward.target();
        target.unwrap_or(self.reward.rewards.len() - 1)
    }

    /// What is known by then.
    pub fn learned(self) -> LearnedNetwork {
        LearnedNetwork {
            target: self.target(),
            autoencoder: self.autoencoder,
            dqn: self.dqn,
            input: self.input,
            basis: self.basis.kind(),
        }
    }

    /// As a checkpoint, without the settings.
    pub fn to_contents(&self) -> Contents {
        let mut contents = Contents::default();
        for (name, shape, numbers) in self.autoencoder.named_numbers() {
            contents.tensors.insert(name, Tensor { shape, numbers });
        }
        self.save_stand(&mut contents);
        self.dqn.save(&mut contents);
        let frames = self
            .replay
            .frames()
            .flat_map(|frame| frame.as_bytes().to_vec());
        let shape = self.autoencoder.shape().grid;
        let (height, width) = shape.dim();
        let [adam_steps, updates] = self.autoencoder.counters();
        let place = self.place.iter().flatten().copied();
        for (name, bytes) in [
            (
                "replay.frames",
                Bytes::of_rows(shape.n_cells(), frames.collect()),
            ),
            ("replay.tracks", Bytes::of_counts(self.replay.tracks())),
            (
                "reward.products",
                Bytes::of_floats(self.reward.products.iter().copied()),
            ),
            (
                "reward.rewards",
                Bytes::of_floats(self.reward.rewards.iter().copied()),
            ),
            ("place", Bytes::of_counts(place)),
        ] {
            contents.bytes.insert(name.into(), bytes);
        }
        for (name, count) in [
            ("height", height as u64),
            ("width", width as u64),
            (
                "observations",
                self.autoencoder.shape().n_observations as u64,
            ),
            ("adam_steps", adam_steps),
            ("updates", updates),
            ("iterations", self.iterations),
        ] {
            contents.texts.insert(name.into(), count.to_string());
        }
        contents
    }

    /// What is behind the state: the estimate and the hidden vector before it.
    fn save_stand(&self, contents: &mut Contents) {
        let mut add = |name: &str, shape: &[usize], numbers: &[f32]| {
            let (shape, numbers) = (shape.to_vec(), numbers.to_vec());
            contents
                .tensors
                .insert(name.into(), Tensor { shape, numbers });
        };
        if let Some(estimate) = self.basis.estimate() {
            add(ESTIMATE, estimate.view().shape(), estimate.as_slice());
        }
        if self.input == DqnInput::BeforeFrame {
            let before = self.autoencoder.hidden_before();
            add(BEFORE, &[before.len()], before);
        }
    }

    /// From a checkpoint, with its own settings.
    ///
    /// # Errors
    /// [`Problem`] names what is missing or of another form.
    pub fn read(contents: &Contents) -> Result<Self, Problem> {
        let config = settings(contents)?;
        let wrong = |name: &str, expected: &str, got: String| Problem::Value {
            name: name.into(),
            expected: expected.into(),
            got,
        };
        let count = |name: &str| contents.count(name).map(|count| count as usize);
        let shape = Shape::new(count("height")?, count("width")?);
        let observations = count("observations")?;
        if !(1..=MAX_VALUES).contains(&observations) {
            let expected = format!("1 to {MAX_VALUES}");
            return Err(wrong("observations", &expected, observations.to_string()));
        }
        let shape = shape.map_err(|error| wrong("height", "a grid", error.to_string()))?;
        check_size(contents, &network_shape(shape, observations, &config))?;
        let site = Site {
            shape,
            n_observations: observations,
            n_moves: 0,
            worlds: 0..1,
        };
        let mut progress = Self::first(&site, &config);
        progress.load(contents)?;
        Ok(progress)
    }

    /// Takes over a checkpoint of the same sizes.
    ///
    /// # Errors
    /// [`Problem`] names what is missing or of another form; some of it may have been taken over then.
    pub fn load(&mut self, contents: &Contents) -> Result<(), Problem> {
        let input = settings(contents)?.dqn.input;
        if input != self.input {
            return Err(Problem::Value {
                name: "dqn.input".into(),
                expected: self.input.label().into(),
                got: input.label().into(),
            });
        }
        let numbers = |name: &str, dims: &[usize]| contents.tensor(name, dims).map(<[f32]>::to_vec);
        squares_are_not_negative(contents)?;
        let counters = [contents.count("adam_steps")?, contents.count("updates")?];
        self.autoencoder.load(numbers, counters)?;
        self.dqn.load(contents)?;
        self.load_stand(contents)?;
        let n_states = self.reward.rewards.len();
        self.reward.products = contents.floats("reward.products", n_states * n_states)?;
        self.reward.rewards = contents.floats("reward.rewards", n_states)?;
        self.load_replay(contents)?;
        self.iterations = contents.count("iterations")?;
        let place = contents.counts("place")?;
        self.place = match place[..] {
            [] => None,
            _ => Some(place.try_into().map_err(|got: Vec<u64>| Problem::Value {
                name: "place".into(),
                expected: "five numbers".into(),
                got: got.len().to_string(),
            })?),
        };
        Ok(())
    }

    /// What [`Self::save_stand`] put there. Without an estimate, as where others were not wanted, the next
    /// path is planned on the predictor.
    fn load_stand(&mut self, contents: &Contents) -> Result<(), Problem> {
        if contents.tensors.contains_key(ESTIMATE) {
            let dim = self.autoencoder.prediction().view().dim();
            let numbers = contents.tensor(ESTIMATE, &[dim.0, dim.1, dim.2])?.to_vec();
            let estimate = Probabilities::from_shape_vec(dim, numbers);
            let estimate = estimate.expect("invariant: the tensor has this shape");
            let estimate = Belief::from_probabilities(estimate);
            self.basis.see(&estimate.map_err(|error| Problem::Value {
                name: ESTIMATE.into(),
                expected: "a belief".into(),
                got: error.to_string(),
            })?);
        }
        if self.input == DqnInput::BeforeFrame {
            let before = contents.tensor(BEFORE, &[self.autoencoder.hidden().len()])?;
            self.autoencoder.set_hidden_before(before.to_vec());
        }
        Ok(())
    }

    fn load_replay(&mut self, contents: &Contents) -> Result<(), Problem> {
        let shape = self.autoencoder.shape();
        let rows = contents.rows("replay.frames", shape.grid.n_cells())?;
        let mut tracks = contents.counts("replay.tracks")?.into_iter().peekable();
        for (index, row) in rows.chunks_exact(shape.grid.n_cells()).enumerate() {
            if tracks.next_if_eq(&(index as u64)).is_some() {
                self.replay.begin();
            }
            let frame = Frame::from_bytes(shape.grid, shape.n_observations, row);
            self.replay.push(frame.map_err(|error| Problem::Value {
                name: "replay.frames".into(),
                expected: "frames of these worlds".into(),
                got: error.to_string(),
            })?);
        }
        Ok(())
    }
}

/// The network that settings ask for.
fn network_shape(grid: Shape, n_observations: usize, config: &AgentConfig) -> NetworkShape {
    let settings = config.autoencoder.settings();
    NetworkShape {
        grid,
        n_states: match config.autoencoder.states {
            0 => n_observations,
            states => states,
        },
        n_observations,
        encoding: settings.encoding,
        hidden: settings.hidden,
    }
}

/// Refuses sizes whose numbers are not in the file: a few words could ask for all memory otherwise.
fn check_size(contents: &Contents, shape: &NetworkShape) -> Result<(), Problem> {
    let expected = Tensors::n_parameters(shape) + shape.n_states * shape.grid.n_cells();
    let tensors = contents.tensors.values();
    let got: usize = tensors.map(|tensor| tensor.numbers.len()).sum();
    if got >= expected {
        return Ok(());
    }
    Err(Problem::Value {
        name: "tensors".into(),
        expected: format!(
            "the {expected} numbers or more of a network on a {} grid",
            shape.grid
        ),
        got: got.to_string(),
    })
}

/// Means of squares, whose roots are taken.
fn squares_are_not_negative(contents: &Contents) -> Result<(), Problem> {
    let is_square = |name: &str| name.contains("adam.second.") || name.ends_with("running_var");
    let squares = contents.tensors.iter().filter(|(name, _)| is_square(name));
    for (name, tensor) in squares {
        if let Some(got) = tensor.numbers.iter().find(|number| **number < 0.0) {
            return Err(Problem::Value {
                name: name.clone(),
                expected: "numbers from 0 on".into(),
                got: got.to_string(),
            });
        }
    }
    Ok(())
}
