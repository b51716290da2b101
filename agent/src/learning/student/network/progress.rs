//! What Algorithm 1 has learned, and where it stands: as a checkpoint, and from one.

use crate::config::AgentConfig;
use crate::estimation::Follower;
use crate::estimation::belief::Belief;
use crate::estimation::dqn_input::DqnInput;
use crate::learning::checkpoint::{Bytes, Contents, Problem};
use crate::learning::reward::RewardEstimate;
use crate::learning::settings::settings;
use crate::learning::student::Site;
use crate::learning::student::stored::{find, load_dqn, save_dqn, save_tensors};
use crate::planning::BasisKind;
use crate::planning::policy::Policy;
use crate::server::client::Place;
use ::network::{Autoencoder, Device, Dqn, NamedTensor, NetworkError, NetworkShape, Replay};
use protocol::model::MAX_VALUES;
use protocol::{Frame, Probabilities, Shape};

/// Names in checkpoints of where the world is, and of the estimate where paths are planned on it.
const HIDDEN: &str = "state.hidden";
const PREDICTION: &str = "state.prediction";
const ESTIMATE: &str = "state.estimate";

/// What is learned, and where learning stands.
pub struct Progress {
    /// The model.
    pub autoencoder: Autoencoder,
    /// What it knows of the world.
    pub follower: Follower,
    /// The choice of objectives.
    pub dqn: Dqn,
    /// What that sees.
    pub input: DqnInput,
    /// The estimate where paths are planned on it, as a checkpoint left it.
    pub estimate: Option<Belief>,
    /// What paths are planned on.
    pub basis: BasisKind,
    /// The frames that are learned from.
    pub replay: Replay,
    /// Which state pays.
    pub reward: RewardEstimate,
    /// Iterations of Algorithm 1.
    pub iterations: u64,
    /// Where the world is that the hidden vector knows, if any.
    pub place: Option<Place>,
}

/// What Algorithm 1 learned, with its parameters fixed.
#[derive(Debug)]
pub struct LearnedNetwork {
    /// The model; each world follows it with a copy of its own.
    pub autoencoder: Autoencoder,
    /// The choice of objectives.
    pub dqn: Dqn,
    /// What that sees.
    pub input: DqnInput,
    /// What the paths were planned on that it values.
    pub basis: BasisKind,
    /// The state that pays most.
    pub target: usize,
}

impl Progress {
    /// Before the first frame; the autoencoder computes on `device`.
    ///
    /// # Errors
    /// As the device.
    pub fn first(site: &Site, config: &AgentConfig, device: &Device) -> Result<Self, NetworkError> {
        let shape = network_shape(site.shape, site.n_observations, config);
        let (settings, n_states) = (config.autoencoder.settings(), shape.n_states);
        let autoencoder = Autoencoder::new(settings, shape, config.seed, device)?;
        let n_actions = Policy::network_choices(n_states).len();
        let input = config.dqn.input;
        let n_inputs = input.length(settings.hidden, n_states);
        Ok(Self {
            follower: Follower::new(&autoencoder)?,
            dqn: Dqn::new(config.dqn.settings(), n_inputs, n_actions, config.seed),
            input,
            estimate: None,
            basis: config.objective.belief,
            autoencoder,
            replay: Replay::new(settings.replay),
            reward: RewardEstimate::new(n_states),
            iterations: 0,
            place: None,
        })
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
            basis: self.basis,
        }
    }

    /// As a checkpoint, without the settings: the world stands at `place`.
    ///
    /// # Errors
    /// As the network's device.
    pub fn to_contents(
        &self,
        place: Place,
        follower: &Follower,
        estimate: Option<&Belief>,
    ) -> Result<Contents, NetworkError> {
        let mut contents = Contents::default();
        let tensors = self.autoencoder.named_tensors()?;
        save_tensors(tensors, &mut contents);
        save_tensors(state(follower, estimate), &mut contents);
        save_dqn(&self.dqn, &mut contents);
        let frames = self
            .replay
            .frames()
            .flat_map(|frame| frame.as_bytes().to_vec());
        let shape = self.autoencoder.shape().grid;
        let (height, width) = shape.dim();
        let [adam_steps, updates] = self.autoencoder.counters();
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
        Ok(contents)
    }

    /// From a checkpoint, with its own settings; the autoencoder computes on `device`.
    ///
    /// # Errors
    /// [`Problem`] names what is missing or of another form.
    pub fn read(contents: &Contents, device: &Device) -> Result<Self, Problem> {
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
        let mut progress = Self::first(&site, &config, device)?;
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
        squares_are_not_negative(contents)?;
        let counters = [contents.count("adam_steps")?, contents.count("updates")?];
        self.autoencoder.load(find(contents), counters)?;
        load_dqn(&mut self.dqn, contents)?;
        self.load_state(contents)?;
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

    /// What [`state`] gave. Without an estimate, as where others were not wanted, the next path is
    /// planned on the predictor.
    fn load_state(&mut self, contents: &Contents) -> Result<(), Problem> {
        let belief = |name: &str| self.belief_from(contents, name);
        let hidden = contents.tensor(HIDDEN, &[self.follower.hidden().len()])?;
        let follower = Follower::at(hidden.to_vec(), belief(PREDICTION)?);
        let has_estimate = contents.tensors.contains_key(ESTIMATE);
        self.estimate = has_estimate.then(|| belief(ESTIMATE)).transpose()?;
        self.follower = follower;
        Ok(())
    }

    fn belief_from(&self, contents: &Contents, name: &str) -> Result<Belief, Problem> {
        let dim = self.follower.prediction().view().dim();
        let numbers = contents.tensor(name, &[dim.0, dim.1, dim.2])?.to_vec();
        let belief = Probabilities::from_shape_vec(dim, numbers);
        let belief = belief.expect("invariant: the tensor has this shape");
        Belief::from_probabilities(belief).map_err(|error| Problem::Value {
            name: name.into(),
            expected: "a belief".into(),
            got: error.to_string(),
        })
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

/// What a network knows of its world, as tensors.
fn state(follower: &Follower, estimate: Option<&Belief>) -> Vec<NamedTensor> {
    let (hidden, prediction) = (follower.hidden(), follower.prediction());
    let belief = |name: &str, belief: &Belief| {
        let numbers = belief.as_slice().to_vec();
        (name.to_owned(), belief.view().shape().to_vec(), numbers)
    };
    let mut state = vec![
        (HIDDEN.to_owned(), vec![hidden.len()], hidden.to_vec()),
        belief(PREDICTION, prediction),
    ];
    state.extend(estimate.map(|estimate| belief(ESTIMATE, estimate)));
    state
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
    let expected = shape.n_numbers() + shape.n_states * shape.grid.n_cells();
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
