//! The paper's Algorithm 1: a dynamic autoencoder estimates, a DQN chooses what the next path is for,
//! shooting finds the path, and both networks learn from every step.
//!
//! One iteration: `h_{k+1}` and the predictor `u_{k+1}` from the frame (eq. 9), the estimate `p_k` by Bayes'
//! rule (eq. 10), an action from `h` (eq. 17), a path for it (eq. 15), the path's frame and reward; then one
//! step of Adam on each network (eq. 19), with step sizes of their own ([`crate::config::StepSize`]).

use super::{Lesson, NotFinite, Site, Student, StudentError};
use crate::belief::Belief;
use crate::checkpoint::{Bytes, Contents, Problem, Tensor};
use crate::client::{Observation, Place};
use crate::compare::planner_seed;
use crate::config::AgentConfig;
use crate::learned::{LearnedNetwork, likelihood};
use crate::metrics::Tick;
use crate::network::dqn::Track;
use crate::network::{Autoencoder, Dqn, NetworkShape, Replay, Tensors, Transition};
use crate::planner::{Objective, Planner, PlanningProblem};
use crate::policy::Policy;
use crate::reward::{RewardEstimate, met};
use crate::scoring::score;
use protocol::model::MAX_VALUES;
use protocol::path::fly;
use protocol::{Frame, Move, Shape};
use std::time::{Duration, Instant};

/// How checkpoints of this learner call it.
pub const KIND: &str = "autoencoder";

const COLUMNS: [&str; 5] = ["dqn_loss", "dqn_rate", "action", "action_value", "epsilon"];

/// What is learned, and where learning stands.
pub struct Progress {
    /// The model.
    pub autoencoder: Autoencoder,
    /// The choice of objectives.
    pub dqn: Dqn,
    /// The frames that are learned from.
    pub replay: Replay,
    /// Which state pays.
    pub reward: RewardEstimate,
    /// Iterations of Algorithm 1.
    pub iterations: u64,
    /// Where the world is that the hidden vector knows, if any.
    pub place: Option<Place>,
}

/// An autoencoder and a DQN that are learned.
pub struct NetworkStudent {
    site: Site,
    config: AgentConfig,
    progress: Progress,
    objectives: Vec<Objective>,
    planner: Box<dyn Planner + Send>,
    observation: Option<Observation>,
    decision: Option<Decision>,
    track: Track,
    is_frozen: bool,
    times: [(&'static str, Duration); 4],
}

/// The action of a step, what it was chosen on, and the cells that its path visits.
struct Decision {
    visited: Vec<usize>,
    hidden: Vec<f32>,
    action: usize,
    value: f32,
}

impl Progress {
    /// Before the first frame.
    pub fn first(site: &Site, config: &AgentConfig) -> Self {
        let n_states = network_shape(site.shape, site.n_observations, config).n_states;
        let settings = config.autoencoder.settings();
        let (seed, grid) = (config.seed, site.shape);
        let autoencoder = Autoencoder::new(settings, grid, n_states, site.n_observations, seed);
        let n_actions = Policy::network_choices(n_states).len();
        Self {
            dqn: Dqn::new(config.dqn.settings(), settings.hidden, n_actions, seed),
            autoencoder,
            replay: Replay::new(settings.replay),
            reward: RewardEstimate::new(n_states),
            iterations: 0,
            place: None,
        }
    }

    /// The state that pays most, as far as rewards tell by now.
    fn target(&self) -> usize {
        let target = self.reward.target();
        target.unwrap_or(self.reward.rewards.len() - 1)
    }

    /// What is known by then.
    pub fn learned(self) -> LearnedNetwork {
        LearnedNetwork {
            target: self.target(),
            autoencoder: self.autoencoder,
            dqn: self.dqn,
        }
    }

    /// As a checkpoint, without the settings.
    pub fn to_contents(&self) -> Contents {
        let mut contents = Contents::default();
        for (name, shape, numbers) in self.autoencoder.named_numbers() {
            contents.tensors.insert(name, Tensor { shape, numbers });
        }
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

    /// From a checkpoint, with its own settings.
    ///
    /// # Errors
    /// [`Problem`] names what is missing or of another form.
    pub fn read(contents: &Contents) -> Result<Self, Problem> {
        let settings = contents.texts.get("settings");
        let settings = settings.ok_or_else(|| Problem::Missing("settings".into()))?;
        let wrong = |name: &str, expected: &str, got: String| Problem::Value {
            name: name.into(),
            expected: expected.into(),
            got,
        };
        let config: AgentConfig = toml::from_str(settings)
            .map_err(|error| wrong("settings", "those of an agent", error.to_string()))?;
        let config = config
            .check()
            .map_err(|error| wrong("settings", "those of an agent", error.to_string()))?;
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
        let numbers = |name: &str, dims: &[usize]| contents.tensor(name, dims).map(<[f32]>::to_vec);
        squares_are_not_negative(contents)?;
        let counters = [contents.count("adam_steps")?, contents.count("updates")?];
        self.autoencoder.load(numbers, counters)?;
        self.dqn.load(contents)?;
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

impl NetworkStudent {
    /// Goes on from some progress, or begins.
    pub fn new(progress: Progress, site: Site, config: &AgentConfig) -> Self {
        let choices = Policy::network_choices(progress.autoencoder.shape().n_states);
        Self {
            objectives: choices
                .iter()
                .map(|choice| config.objective(choice))
                .collect(),
            planner: config.planner(&choices[0]),
            track: progress.dqn.track(),
            progress,
            site,
            config: config.clone(),
            observation: None,
            decision: None,
            is_frozen: false,
            times: ["planning", "inference", "dqn", "autoencoder"]
                .map(|part| (part, Duration::ZERO)),
        }
    }

    fn observation(&self) -> &Observation {
        let observation = self.observation.as_ref();
        observation.expect("invariant: a world begins before it is acted on")
    }

    /// Reads a frame: `h`, the estimate and the next predictor.
    fn read(&mut self, frame: &Frame) -> Result<Belief, StudentError> {
        let start = Instant::now();
        let estimate = self.progress.autoencoder.step(frame);
        self.times[1].1 += start.elapsed();
        Ok(estimate?)
    }

    /// Adds the transition to the DQN's replay, and what the path met to the estimate of rewards.
    fn remember(&mut self, estimate: &Belief, reward: f64) {
        if let Some(decision) = &self.decision {
            let met = met(estimate, decision.visited.iter().copied());
            self.progress.reward.add(&met, reward);
            let step = Transition {
                input: decision.hidden.clone(),
                action: decision.action,
                reward: reward as f32,
                next: self.progress.autoencoder.hidden().to_vec(),
            };
            if let Some(transition) = self.track.add(step) {
                self.progress.dqn.remember(transition);
            }
        }
    }

    fn update_dqn(&mut self) -> Result<[Option<f64>; 2], NotFinite> {
        let start = Instant::now();
        let rate = self.config.dqn.step_size.at(self.progress.iterations);
        self.progress.dqn.set_learning_rate(rate as f32);
        let loss = self.progress.dqn.update();
        self.times[2].1 += start.elapsed();
        Ok([loss?.map(f64::from), Some(rate)])
    }

    fn update_autoencoder(&mut self) -> Result<[Option<f64>; 2], NotFinite> {
        let start = Instant::now();
        let number = self.progress.autoencoder.n_updates();
        let config = &self.config.autoencoder;
        let window = self
            .progress
            .replay
            .window(config.window, self.config.seed, number);
        let Some(window) = window.filter(|window| window.has_targets()) else {
            return Ok([None; 2]);
        };
        // Both step sizes go by the iteration, as eq. 20 compares them.
        let rate = config.step_size.at(self.progress.iterations);
        self.progress.autoencoder.set_learning_rate(rate as f32);
        let loss = self.progress.autoencoder.update(&window);
        self.times[3].1 += start.elapsed();
        Ok([Some(loss?), Some(rate)])
    }
}

impl Student for NetworkStudent {
    fn kind(&self) -> &'static str {
        KIND
    }

    fn columns(&self) -> &'static [&'static str] {
        &COLUMNS
    }

    fn wants_full_frames(&self) -> bool {
        !self.is_frozen && self.progress.iterations < self.config.autoencoder.full_frames
    }

    fn attach(&mut self, mut observations: Vec<Observation>) -> Result<usize, StudentError> {
        let observation = observations.remove(0);
        let shown = self.progress.replay.frames().last();
        let goes_on =
            self.progress.place == Some(observation.place()) && shown == Some(&observation.frame);
        if goes_on {
            self.observation = Some(observation);
        } else {
            self.begin(self.site.worlds.start, observation)?;
        }
        Ok(usize::from(goes_on))
    }

    fn begin(&mut self, _: u32, observation: Observation) -> Result<(), StudentError> {
        self.progress.place = Some(observation.place());
        self.track = self.progress.dqn.track();
        self.progress.autoencoder.forget();
        self.progress.replay.begin();
        self.read(&observation.frame)?;
        self.progress.replay.push(observation.frame.clone());
        self.observation = Some(observation);
        Ok(())
    }

    fn plan(&mut self) -> Vec<Vec<Move>> {
        let start = Instant::now();
        let hidden = self.progress.autoencoder.hidden().to_vec();
        let dqn = &self.progress.dqn;
        let action = match self.is_frozen {
            true => dqn.best(&hidden),
            false => dqn.act(&hidden, self.progress.iterations),
        };
        let value = dqn.values(&hidden)[action];
        let values = self.objectives[action].values(self.progress.autoencoder.prediction());
        let observation = self.observation();
        let problem = PlanningProblem {
            start: observation.robot(),
            n_moves: self.site.n_moves,
            values: &values,
            seed: planner_seed(&self.config, observation.result.seed),
            step: observation.result.step,
        };
        let plan = self.planner.plan(&problem);
        self.decision = Some(Decision {
            visited: fly(self.site.shape, problem.start, &plan.moves).visited,
            hidden,
            action,
            value,
        });
        self.times[0].1 += start.elapsed();
        vec![plan.moves]
    }

    fn take_in(&mut self, mut observations: Vec<Observation>) -> Result<Tick, StudentError> {
        let observation = observations.remove(0);
        let frame = observation.frame.clone();
        let prediction = self.progress.autoencoder.prediction();
        let score = score(prediction, &likelihood(&self.progress.autoencoder), &frame);
        self.progress.place = Some(observation.place());
        let reward = observation.result.reward;
        self.observation = Some(observation);
        let estimate = self.read(&frame)?;
        self.remember(&estimate, reward);
        self.progress.replay.push(frame);
        self.progress.iterations += 1;
        Ok(Tick {
            world_steps: self.progress.iterations,
            n_worlds: 1,
            reward,
            score,
        })
    }

    fn learn(&mut self) -> Result<Vec<Lesson>, NotFinite> {
        let epsilon = self
            .config
            .dqn
            .settings()
            .epsilon_at(self.progress.iterations - 1);
        let [dqn_loss, dqn_rate] = self.update_dqn()?;
        let [loss, rate] = self.update_autoencoder()?;
        let decision = self.decision.as_ref();
        let more = vec![
            dqn_loss,
            dqn_rate,
            decision.map(|decision| decision.action as f64),
            decision.map(|decision| f64::from(decision.value)),
            Some(f64::from(epsilon)),
        ];
        let number = self.n_updates();
        Ok(vec![Lesson {
            number,
            loss,
            rate,
            more,
        }])
    }

    fn freeze(&mut self) {
        self.is_frozen = true;
    }

    fn world_steps(&self) -> u64 {
        self.progress.iterations
    }

    fn n_updates(&self) -> u64 {
        self.progress.autoencoder.n_updates()
    }

    fn belief(&self) -> Option<(&Belief, usize)> {
        let belief = self.progress.autoencoder.prediction();
        Some((belief, self.progress.target()))
    }

    fn contents(&self) -> Contents {
        self.progress.to_contents()
    }

    fn times(&self) -> Vec<(&'static str, Duration)> {
        self.times.to_vec()
    }
}
