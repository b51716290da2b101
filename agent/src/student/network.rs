//! The paper's Algorithm 1: a dynamic autoencoder estimates, a DQN chooses what the next path is for,
//! shooting finds the path, and both networks learn from every step.
//!
//! One iteration: `h_{k+1}` and the predictor `u_{k+1}` from the frame (eq. 9), the estimate `p_k` by Bayes'
//! rule (eq. 10), an action from `h` (eq. 17), a path for it (eq. 15), the path's frame and reward; then one
//! step of Adam on each network (eq. 20), with step sizes of their own ([`crate::config::StepSize`]).

use super::{Lesson, NotFinite, Site, Student};
use crate::belief::Belief;
use crate::checkpoint::{Bytes, Contents, Problem, Tensor};
use crate::client::Observation;
use crate::compare::planner_seed;
use crate::config::AgentConfig;
use crate::estimator::ZeroEvidence;
use crate::learned::{LearnedNetwork, likelihood};
use crate::metrics::Tick;
use crate::network::{Autoencoder, Dqn, Replay, Transition};
use crate::planner::{Objective, Planner, PlanningProblem};
use crate::policy::Policy;
use crate::reward::{RewardEstimate, met};
use crate::scoring::score;
use protocol::frame::Coverage;
use protocol::model::MAX_VALUES;
use protocol::{Frame, Move, Shape};
use std::time::{Duration, Instant};

/// How checkpoints of this learner call it.
pub const KIND: &str = "autoencoder";

const COLUMNS: [&str; 5] = ["dqn_loss", "dqn_rate", "action", "action_value", "epsilon"];

/// Where a world stands: which of its steps its last frame shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Standing {
    /// Seed of the world.
    pub seed: u64,
    /// Episodes before this one.
    pub episode: u64,
    /// Step k.
    pub step: u64,
}

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
    /// The world that the hidden vector knows, if any.
    pub standing: Option<Standing>,
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
    times: [(&'static str, Duration); 4],
}

/// The action of a step, and what it was chosen on.
struct Decision {
    hidden: Vec<f32>,
    action: usize,
    value: f32,
}

impl Progress {
    /// Before the first frame.
    pub fn first(site: Site, config: &AgentConfig) -> Self {
        let n_states = match config.autoencoder.states {
            0 => site.n_observations,
            states => states,
        };
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
            standing: None,
        }
    }

    /// What is known by then.
    pub fn learned(self) -> LearnedNetwork {
        LearnedNetwork {
            target: self
                .reward
                .target()
                .unwrap_or(self.reward.rewards.len() - 1),
            autoencoder: self.autoencoder,
            dqn: self.dqn,
        }
    }

    /// As a checkpoint, without the settings.
    pub fn to_contents(&self) -> Contents {
        let mut contents = Contents::default();
        let named = self.autoencoder.named_numbers().into_iter();
        for (name, shape, numbers) in named.chain(self.dqn.named_tensors()) {
            contents.tensors.insert(name, Tensor { shape, numbers });
        }
        let frames = self
            .replay
            .frames()
            .flat_map(|frame| frame.as_bytes().to_vec());
        let shape = self.autoencoder.shape().grid;
        let (height, width) = shape.dim();
        let [adam_steps, updates] = self.autoencoder.counters();
        let standing = self
            .standing
            .map_or(vec![], |s| vec![s.seed, s.episode, s.step]);
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
            ("standing", Bytes::of_counts(standing)),
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
            ("dqn_updates", self.dqn.n_updates()),
            ("dqn_transitions", self.dqn.n_transitions() as u64),
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
        let site = Site {
            shape: shape.map_err(|error| wrong("height", "a grid", error.to_string()))?,
            n_observations: observations,
            n_moves: 0,
            n_worlds: 1,
        };
        let mut progress = Self::first(site, &config);
        progress.load(contents)?;
        Ok(progress)
    }

    /// Takes over a checkpoint of the same sizes.
    ///
    /// # Errors
    /// [`Problem`] names what is missing or of another form; some of it may have been taken over then.
    pub fn load(&mut self, contents: &Contents) -> Result<(), Problem> {
        let numbers = |name: &str, dims: &[usize]| contents.tensor(name, dims).map(<[f32]>::to_vec);
        let counters = [contents.count("adam_steps")?, contents.count("updates")?];
        self.autoencoder.load(numbers, counters)?;
        let n_transitions = contents.count("dqn_transitions")? as usize;
        let n_updates = contents.count("dqn_updates")?;
        self.dqn.load(numbers, n_updates, n_transitions)?;
        let n_states = self.reward.rewards.len();
        self.reward.products = contents.floats("reward.products", n_states * n_states)?;
        self.reward.rewards = contents.floats("reward.rewards", n_states)?;
        self.load_replay(contents)?;
        self.iterations = contents.count("iterations")?;
        self.standing = match contents.counts("standing")?[..] {
            [seed, episode, step] => Some(Standing {
                seed,
                episode,
                step,
            }),
            _ => None,
        };
        Ok(())
    }

    fn load_replay(&mut self, contents: &Contents) -> Result<(), Problem> {
        let shape = self.autoencoder.shape();
        let rows = contents.rows("replay.frames", shape.grid.n_cells())?;
        let tracks = contents.counts("replay.tracks")?;
        for (index, row) in rows.chunks_exact(shape.grid.n_cells()).enumerate() {
            if tracks.contains(&(index as u64)) {
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
            progress,
            site,
            config: config.clone(),
            observation: None,
            decision: None,
            times: ["planning", "inference", "dqn", "autoencoder"]
                .map(|part| (part, Duration::ZERO)),
        }
    }

    fn observation(&self) -> &Observation {
        let observation = self.observation.as_ref();
        observation.expect("invariant: a world begins before it is acted on")
    }

    /// Reads a frame: `h`, the estimate and the next predictor.
    fn read(&mut self, frame: &Frame) -> Result<Belief, ZeroEvidence> {
        let start = Instant::now();
        let estimate = self.progress.autoencoder.step(frame);
        self.times[1].1 += start.elapsed();
        estimate
    }

    /// Adds the transition to the DQN's replay, and what the path met to the estimate of rewards.
    fn remember(&mut self, estimate: &Belief, is_full: bool) {
        let Observation { result, frame } = self.observation();
        let reward = result.reward;
        // A full frame does not tell which cells the path visited.
        if !is_full {
            let met = met(estimate, frame);
            self.progress.reward.add(&met, reward);
        }
        if let Some(decision) = &self.decision {
            self.progress.dqn.remember(Transition {
                input: decision.hidden.clone(),
                action: decision.action,
                reward: reward as f32,
                next: self.progress.autoencoder.hidden().to_vec(),
            });
        }
    }

    fn update_dqn(&mut self) -> Result<[Option<f64>; 2], NotFinite> {
        let start = Instant::now();
        let rate = self.config.dqn.step_size.at(self.progress.iterations);
        self.progress.dqn.set_learning_rate(rate as f32);
        let loss = self.progress.dqn.update();
        self.times[2].1 += start.elapsed();
        Ok([loss.map(f64::from), Some(rate)])
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
        let rate = config.step_size.at(number);
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
        self.progress.iterations < self.config.autoencoder.full_frames
    }

    fn begin(&mut self, _: usize, observation: Observation) -> Result<(), ZeroEvidence> {
        let standing = Standing::of(&observation);
        let goes_on = self.progress.standing == Some(standing);
        self.progress.standing = Some(standing);
        self.decision = None;
        if !goes_on {
            self.progress.autoencoder.forget();
            self.progress.replay.begin();
            self.read(&observation.frame)?;
            self.progress.replay.push(observation.frame.clone());
        }
        self.observation = Some(observation);
        Ok(())
    }

    fn plan(&mut self) -> Vec<Vec<Move>> {
        let start = Instant::now();
        let hidden = self.progress.autoencoder.hidden().to_vec();
        let dqn = &self.progress.dqn;
        let action = dqn.act(&hidden, self.progress.iterations);
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
            hidden,
            action,
            value,
        });
        self.times[0].1 += start.elapsed();
        vec![plan.moves]
    }

    fn take_in(&mut self, mut observations: Vec<Observation>) -> Result<Tick, ZeroEvidence> {
        let observation = observations.remove(0);
        let frame = observation.frame.clone();
        let is_full = observation.result.coverage == Coverage::Full as u32;
        let prediction = self.progress.autoencoder.prediction();
        let score = score(prediction, &likelihood(&self.progress.autoencoder), &frame);
        self.progress.standing = Some(Standing::of(&observation));
        let reward = observation.result.reward;
        self.observation = Some(observation);
        let estimate = self.read(&frame)?;
        self.remember(&estimate, is_full);
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

    fn n_updates(&self) -> u64 {
        self.progress.autoencoder.n_updates()
    }

    fn contents(&self) -> Contents {
        self.progress.to_contents()
    }

    fn times(&self) -> Vec<(&'static str, Duration)> {
        self.times.to_vec()
    }
}

impl Standing {
    /// Of a world that shows this.
    pub fn of(observation: &Observation) -> Self {
        let result = &observation.result;
        Self {
            seed: result.seed,
            episode: result.episode,
            step: result.step,
        }
    }
}
