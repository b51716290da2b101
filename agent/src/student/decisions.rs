//! Learns which action of [`ActionSet::beam`] to take (paper section III.E): beam search plans on the
//! known-model filter's belief, and a DQN that sees a summary of it chooses what each path is for.

use super::{Impression, Lesson, NotFinite, Site, Student, StudentError};
use crate::action::{Action, ActionSet};
use crate::belief::Belief;
use crate::checkpoint::{Contents, Problem};
use crate::client::Observation;
use crate::compare::planner_seed;
use crate::config::{AgentConfig, DecisionsConfig};
use crate::estimator::{BayesFilter, ZeroEvidence};
use crate::metrics::Tick;
use crate::planner::{BeamSearch, PlanBasis};
use crate::policy::EstimatorKind;
use crate::scoring::score;
use crate::student::stored::{load_dqn, save_dqn};
use crate::summary::{spread_summary, summary_length};
use ::network::{Dqn, Track, Transition};
use protocol::{Cell, Model, Move};
use rayon::prelude::*;
use std::time::{Duration, Instant};

/// How checkpoints of this learner call it.
pub const KIND: &str = "decisions";

/// Between the names of actions in a checkpoint.
const SEPARATOR: &str = " ";

/// A DQN over the actions of a model.
#[derive(Debug)]
pub struct Decisions {
    /// Values of actions.
    pub dqn: Dqn,
    /// The actions, in the order of the values.
    pub actions: ActionSet,
    /// World steps that were learned from.
    pub world_steps: u64,
    n_states: usize,
}

/// A DQN that learns on several worlds.
pub struct DecisionsStudent {
    site: Site,
    config: AgentConfig,
    decisions: Decisions,
    filter: BayesFilter,
    /// The state that pays most.
    target: usize,
    state_names: Vec<String>,
    pilots: Vec<Pilot>,
    owed: f64,
    is_frozen: bool,
    times: [(&'static str, Duration); 2],
}

/// One world's robot.
struct Pilot {
    filter: BayesFilter,
    basis: PlanBasis,
    planner: BeamSearch,
    observation: Observation,
    input: Vec<f32>,
    action: usize,
    /// Time that its last plan took.
    planning: Duration,
    track: Track,
}

impl Decisions {
    /// Before the first step, for worlds of a model.
    pub fn first(model: &Model, config: &DecisionsConfig, seed: u64) -> Self {
        let actions = ActionSet::beam(model);
        let (n_states, n_actions) = (model.n_states(), actions.actions().len());
        Self {
            dqn: Dqn::new(config.settings(), summary_length(n_states), n_actions, seed),
            actions,
            world_steps: 0,
            n_states,
        }
    }

    /// The action that is worth most on a belief.
    pub fn decide(&self, belief: &Belief, robot: Cell, n_moves: usize) -> &Action {
        &self.actions.actions()[self.dqn.best(&spread_summary(belief, robot, n_moves))]
    }

    /// As a checkpoint, without settings.
    pub fn to_contents(&self) -> Contents {
        let mut contents = Contents::default();
        save_dqn(&self.dqn, &mut contents);
        for (name, text) in [
            ("actions", self.actions.names().join(SEPARATOR)),
            ("states", self.n_states.to_string()),
            ("world_steps", self.world_steps.to_string()),
        ] {
            contents.texts.insert(name.into(), text);
        }
        contents
    }

    /// Takes over a checkpoint.
    ///
    /// # Errors
    /// [`Problem`] names what is missing, of another form, or of a model with other states or actions.
    pub fn load(&mut self, contents: &Contents) -> Result<(), Problem> {
        for (name, expected) in [
            ("states", self.n_states.to_string()),
            ("actions", self.actions.names().join(SEPARATOR)),
        ] {
            let got = contents.texts.get(name);
            let got = got.ok_or_else(|| Problem::Missing(name.into()))?.clone();
            if got != expected {
                let name = name.into();
                return Err(Problem::Value {
                    name,
                    expected,
                    got,
                });
            }
        }
        load_dqn(&mut self.dqn, contents)?;
        self.world_steps = contents.count("world_steps")?;
        Ok(())
    }
}

impl DecisionsStudent {
    /// Goes on from some decisions, or begins. `filter` is that of the worlds' model before its first frame.
    pub fn new(
        decisions: Decisions,
        filter: BayesFilter,
        model: &Model,
        site: Site,
        config: &AgentConfig,
    ) -> Self {
        Self {
            site,
            config: config.clone(),
            decisions,
            filter,
            target: model.target_state(),
            state_names: model.state_names(),
            pilots: Vec::new(),
            owed: 0.0,
            is_frozen: false,
            times: ["planning", "learning"].map(|part| (part, Duration::ZERO)),
        }
    }
}

impl Pilot {
    /// A robot that has taken in what its world shows.
    fn new(student: &DecisionsStudent, observation: Observation) -> Result<Self, ZeroEvidence> {
        let mut filter = student.filter.clone();
        filter.correct(&observation.frame)?;
        let mut basis = PlanBasis::new(student.config.objective.belief);
        basis.see(filter.belief());
        filter.predict();
        Ok(Self {
            basis,
            input: spread_summary(filter.belief(), observation.robot(), student.site.n_moves),
            filter,
            planner: BeamSearch::new(student.config.beam_width),
            observation,
            action: 0,
            planning: Duration::ZERO,
            track: student.decisions.dqn.track(),
        })
    }

    /// Takes in what an action brought, and gives the transition that is complete by then.
    fn bring(&mut self, config: &DecisionsConfig, next: Vec<f32>) -> Option<Transition> {
        self.track.add(Transition {
            input: std::mem::replace(&mut self.input, next.clone()),
            action: self.action,
            reward: self.observation.result.reward as f32 * config.reward_scale,
            next,
        })
    }
}

impl Student for DecisionsStudent {
    fn kind(&self) -> &'static str {
        KIND
    }

    fn columns(&self) -> &'static [&'static str] {
        &["dqn_loss", "dqn_rate", "epsilon"]
    }

    fn attach(&mut self, observations: Vec<Observation>) -> Result<usize, StudentError> {
        let pilots = observations.into_iter().map(|seen| Pilot::new(self, seen));
        self.pilots = pilots.collect::<Result<_, _>>()?;
        // Beliefs begin anew, wherever the worlds stand.
        Ok(0)
    }

    fn begin(&mut self, world: u32, observation: Observation) -> Result<(), StudentError> {
        let pilot = Pilot::new(self, observation)?;
        self.pilots[(world - self.site.worlds.start) as usize] = pilot;
        Ok(())
    }

    fn plan(&mut self) -> Vec<Vec<Move>> {
        let start = Instant::now();
        let (decisions, config, n_moves) = (&self.decisions, &self.config, self.site.n_moves);
        let is_frozen = self.is_frozen;
        let plan = |(index, pilot): (usize, &mut Pilot)| {
            let start = Instant::now();
            let step = decisions.world_steps + index as u64;
            pilot.action = match is_frozen {
                true => decisions.dqn.best(&pilot.input),
                false => decisions.dqn.act(&pilot.input, step),
            };
            let action = &decisions.actions.actions()[pilot.action];
            let result = &pilot.observation.result;
            let random = (planner_seed(config, result.seed), result.step);
            let robot = pilot.observation.robot();
            let belief = pilot.basis.belief(pilot.filter.belief());
            let plan = action.plan(&mut pilot.planner, belief, robot, n_moves, random);
            pilot.planning = start.elapsed();
            plan.moves
        };
        let paths = self.pilots.par_iter_mut().enumerate().map(plan).collect();
        self.times[0].1 += start.elapsed();
        paths
    }

    fn take_in(
        &mut self,
        observations: Vec<Observation>,
        watched: &[usize],
    ) -> Result<(Tick, Vec<Impression>), StudentError> {
        let mut tick = Tick::default();
        for (pilot, observation) in self.pilots.iter_mut().zip(observations) {
            tick.reward += observation.result.reward;
            let likelihood = pilot.filter.likelihood();
            tick.score += score(pilot.filter.belief(), likelihood, &observation.frame);
            pilot.filter.correct(&observation.frame)?;
            pilot.observation = observation;
        }
        let impression = |&index: &usize| {
            let pilot = &self.pilots[index];
            Impression {
                belief: pilot.filter.belief().clone(),
                objective: self.decisions.actions.actions()[pilot.action].name.clone(),
                planning: pilot.planning,
            }
        };
        let impressions = watched.iter().map(impression).collect();
        let n_moves = self.site.n_moves;
        let config = &self.config.decisions;
        let bring = |pilot: &mut Pilot| {
            pilot.basis.see(pilot.filter.belief());
            pilot.filter.predict();
            let robot = pilot.observation.robot();
            let next = spread_summary(pilot.filter.belief(), robot, n_moves);
            pilot.bring(config, next)
        };
        let transitions: Vec<_> = self.pilots.par_iter_mut().map(bring).collect();
        for transition in transitions.into_iter().flatten() {
            self.decisions.dqn.remember(transition);
        }
        tick.n_worlds = self.pilots.len() as u64;
        self.decisions.world_steps += tick.n_worlds;
        tick.world_steps = self.decisions.world_steps;
        self.owed += tick.n_worlds as f64 * config.updates_per_step;
        Ok((tick, impressions))
    }

    fn learn(&mut self) -> Result<Vec<Lesson>, NotFinite> {
        let start = Instant::now();
        let settings = self.config.decisions.settings();
        let epsilon = f64::from(settings.epsilon_at(self.decisions.world_steps));
        let mut lessons = Vec::new();
        while self.owed >= 1.0 {
            self.owed -= 1.0;
            let Some(loss) = self.decisions.dqn.update()? else {
                continue;
            };
            lessons.push(Lesson {
                number: self.n_updates(),
                loss: None,
                rate: None,
                more: vec![
                    Some(f64::from(loss)),
                    Some(f64::from(settings.adam.learning_rate)),
                    Some(epsilon),
                ],
            });
        }
        self.times[1].1 += start.elapsed();
        Ok(lessons)
    }

    fn freeze(&mut self) {
        self.is_frozen = true;
    }

    fn world_steps(&self) -> u64 {
        self.decisions.world_steps
    }

    fn n_updates(&self) -> u64 {
        self.decisions.dqn.n_updates()
    }

    fn estimator(&self) -> EstimatorKind {
        EstimatorKind::KnownModel
    }

    fn state_names(&self) -> Vec<String> {
        self.state_names.clone()
    }

    fn belief(&self) -> Option<(&Belief, usize)> {
        let pilot = self.pilots.first()?;
        Some((pilot.filter.belief(), self.target))
    }

    fn contents(&self) -> Result<Contents, StudentError> {
        Ok(self.decisions.to_contents())
    }

    fn times(&self) -> Vec<(&'static str, Duration)> {
        self.times.to_vec()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decisions_survive_a_checkpoint_and_others_are_refused_by_name() {
        let model = Model::wildfire();
        let config = DecisionsConfig::default();
        let decisions = Decisions::first(&model, &config, 3);
        let contents = decisions.to_contents();
        let mut again = Decisions::first(&model, &config, 4);
        again.load(&contents).expect("of the same model");
        assert_eq!(again.dqn.named_tensors(), decisions.dqn.named_tensors());
        let mut other = contents.clone();
        other.texts.insert("states".into(), "4".into());
        let error = again.load(&other).expect_err("other states").to_string();
        assert_eq!(error, "states: expected 3, got 4");
        other = contents.clone();
        other.texts.insert("actions".into(), "exploit".into());
        let error = again.load(&other).expect_err("other actions").to_string();
        assert!(
            error.starts_with("actions: expected exploit exploit_explore"),
            "{error}"
        );
        other = contents;
        other.texts.remove("actions");
        let error = again.load(&other).expect_err("none").to_string();
        assert_eq!(error, "expected \"actions\" in it, found none");
    }
}
