//! The agent's life on one world: attach, act, reconnect, leave.

use crate::agent::{Agent, AgentError, Task};
use crate::belief::Belief;
use crate::client::{
    Claim, Client, Observation, RETRY_INTERVAL, is_away, is_belief_left, server_info, shape_of,
};
use crate::compare::planner_seed;
use crate::config::AgentConfig;
use crate::estimator::Prior;
use crate::estimator::filter::known_model_kind;
use crate::feed::{Feed, View};
use crate::first_belief::first_belief;
use crate::handover::{leave, resume, take_over_left};
use crate::learned::Learned;
use crate::policy::{EstimatorKind, Policy, UnknownPolicy};
use crate::truth::{TruthError, TruthFeed};
use protocol::channels::Instance;
use protocol::connection::ConnectionError;
use protocol::control::ServerInfo;
use protocol::message::Status;
use protocol::model::ModelError;
use protocol::{Grid, Model};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use thiserror::Error;

/// How often progress is told.
const REPORT_INTERVAL: Duration = Duration::from_secs(2);

/// What to do on one world.
#[derive(Debug, Clone)]
pub struct Mission {
    /// The server.
    pub instance: Instance,
    /// The world.
    pub world: u32,
    /// The policy's name.
    pub policy: String,
    /// Steps to act for; 0: until stopped.
    pub steps: u64,
    /// Take the world from its holder.
    pub takeover: bool,
    /// The model, where the server does not reveal its own.
    pub model: Option<Model>,
    /// Settings of planners and estimators.
    pub config: AgentConfig,
    /// What was learned, for policies that act on it.
    pub learned: Learned,
}

/// Why a mission ended early.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RunError {
    /// The server refused, or cannot be reached in the first place.
    #[error(transparent)]
    Connection(#[from] ConnectionError),
    /// The agent failed.
    #[error(transparent)]
    Agent(#[from] AgentError),
    /// The policy's name.
    #[error(transparent)]
    Policy(#[from] UnknownPolicy),
    /// The model.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The hidden states that an oracle needs.
    #[error(transparent)]
    Truth(#[from] TruthError),
    /// The server hides its model and none was given.
    #[error("instance {instance:?} does not reveal its model: expected --model FILE")]
    NoModel {
        /// The instance.
        instance: String,
    },
    /// A model of other observations than the server's.
    #[error("model: expected the server's {expected} observations, got {got}")]
    OtherModel {
        /// The server's number of observations.
        expected: usize,
        /// The model's.
        got: usize,
    },
    /// A model that contradicts the one that the server reveals.
    #[error(
        "model: expected the server's own, {expected:?}, as it reveals it, got another, {got:?}"
    )]
    RevealedModel {
        /// The server's.
        expected: String,
        /// The one given.
        got: String,
    },
    /// A policy that only `compare` can feed.
    #[error("policy {policy:?} needs worlds that run one step ahead: only `compare` has them")]
    Clairvoyant {
        /// The policy.
        policy: String,
    },
}

/// What a mission did.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Summary {
    /// Steps acted.
    pub steps: u64,
    /// Sum of their rewards.
    pub reward: f64,
}

/// Acts until the steps are done or `stop` is set. Waits for a server that ends, however often.
///
/// # Errors
/// [`RunError`]; a lost lease is one.
pub fn run(mission: &Mission, stop: &AtomicBool) -> Result<Summary, RunError> {
    let (mut summary, mut is_in_step) = (Summary::default(), true);
    let mut attached = Attached::attach(mission, mission.takeover)?;
    while !stop.load(Ordering::Relaxed) && (mission.steps == 0 || summary.steps < mission.steps) {
        match attached.step(summary.steps + 1 == mission.steps) {
            Ok(reward) => {
                summary.steps += 1;
                summary.reward += reward;
                attached.report.tell(&summary);
            }
            Err(error) if is_outage(&error) => {
                tracing::warn!("{error}; waiting for it to come back");
                match attach_again(mission, stop)? {
                    Some(again) => attached = again,
                    None => {
                        is_in_step = false;
                        break;
                    }
                }
            }
            Err(error) => return Err(error),
        }
    }
    let Attached {
        mut client,
        agent,
        observation,
        feed,
        ..
    } = attached;
    // After an outage nobody knows where the world stands.
    let left = match is_in_step {
        true => leave(&mut client, &agent, &observation),
        false => Ok(()),
    };
    let released = left.and_then(|()| client.release());
    feed.end();
    match released.map_err(RunError::from) {
        Err(error) if !is_outage(&error) => Err(error),
        _ => Ok(summary),
    }
}

/// An agent at its world.
struct Attached {
    client: Client,
    truth: Option<TruthFeed>,
    agent: Agent,
    observation: Observation,
    feed: Feed,
    planning: Duration,
    report: Report,
}

/// Tells of progress now and then.
struct Report {
    since: Instant,
    last: Summary,
}

impl Attached {
    /// Acquires the world where it stands and takes in its last frame.
    fn attach(mission: &Mission, takeover: bool) -> Result<Self, RunError> {
        let (info, model) = prepare(&mission.instance, mission.world, mission.model.as_ref())?;
        let policy = Policy::named(&mission.policy, &model)?;
        if policy.estimator == EstimatorKind::NextTruth {
            return Err(RunError::Clairvoyant {
                policy: policy.name,
            });
        }
        let shape = shape_of(&info)?;
        // What takes long is done before the lease begins to run, and not at all where a belief was left.
        let prior = match policy.estimator {
            EstimatorKind::KnownModel => {
                let any = Belief::from_initial(&model, shape);
                if let Some(attached) = Self::go_on(mission, takeover, &model, &policy, &any)? {
                    return Ok(attached);
                }
                mission.config.prior(info.burn_in)
            }
            _ => Prior::Initial,
        };
        let prior = first_belief(prior, &model, shape, mission.config.seed)?;
        let mut attached = Self::acquire(mission, takeover, &model, &policy, &prior)?;
        let present = &attached.observation;
        if !resume(&mut attached.client, &mut attached.agent, present)? {
            attached.take_in(false)?;
        }
        Ok(attached)
    }

    /// Acquires the world if a belief was left about it, in the place of `any`.
    fn go_on(
        mission: &Mission,
        takeover: bool,
        model: &Model,
        policy: &Policy,
        any: &Belief,
    ) -> Result<Option<Self>, RunError> {
        let kind = known_model_kind(model);
        if !is_belief_left(&mission.instance, mission.world, &kind)? {
            return Ok(None);
        }
        let mut attached = Self::acquire(mission, takeover, model, policy, any)?;
        let present = &attached.observation;
        if take_over_left(&mut attached.client, &mut attached.agent, present)? {
            return Ok(Some(attached));
        }
        // Another agent acted since.
        attached.client.release()?;
        Ok(None)
    }

    /// Acquires the world for an agent before its first frame.
    fn acquire(
        mission: &Mission,
        takeover: bool,
        model: &Model,
        policy: &Policy,
        prior: &Belief,
    ) -> Result<Self, RunError> {
        let worlds = mission.world..mission.world + 1;
        let claim = Claim {
            worlds: worlds.clone(),
            takeover,
            time_to_live: None,
        };
        let mut client = Client::acquire(&mission.instance, &claim)?;
        let observation = client.observe(worlds)?.remove(0);
        let (seed, step) = (observation.result.seed, observation.result.step);
        tracing::info!(
            world = mission.world,
            seed,
            step,
            policy = policy.name,
            "acting"
        );
        let n_moves = client.info().n_moves;
        let seed = planner_seed(&mission.config, seed);
        let task = Task {
            model,
            shape: client.shape(),
            n_moves,
            prior,
            seed,
            learned: &mission.learned,
        };
        let agent = Agent::new(policy, &mission.config, task)?;
        let truth = if policy.estimator == EstimatorKind::Truth {
            Some(open_truth(mission, &client)?)
        } else {
            None
        };
        let feed = Feed::open(&mission.instance, agent.belief());
        let report = Report {
            since: Instant::now(),
            last: Summary::default(),
        };
        Ok(Self {
            client,
            truth,
            agent,
            observation,
            feed,
            planning: Duration::ZERO,
            report,
        })
    }

    /// Plans, flies, corrects, predicts; returns the reward. The last belief is shown in any case.
    fn step(&mut self, is_last: bool) -> Result<f64, RunError> {
        let start = Instant::now();
        let plan = self
            .agent
            .plan(self.observation.robot(), self.observation.result.step);
        self.planning = start.elapsed();
        self.observation = self
            .client
            .step(self.client.worlds(), &[plan.moves])?
            .remove(0);
        self.take_in(is_last)?;
        Ok(self.observation.result.reward)
    }

    fn take_in(&mut self, is_last: bool) -> Result<(), RunError> {
        let truth = self.read_truth()?;
        self.agent
            .correct(&self.observation.frame, truth.as_ref())?;
        if self.feed.is_due() || is_last {
            self.feed.show(&View {
                world: self.client.worlds().start,
                result: &self.observation.result,
                belief: self.agent.belief(),
                intent: self.agent.intent(self.planning),
            });
        }
        self.agent.predict();
        Ok(())
    }

    fn read_truth(&self) -> Result<Option<Grid<u8>>, TruthError> {
        let Some(feed) = &self.truth else {
            return Ok(None);
        };
        let result = &self.observation.result;
        let states = feed.states(self.client.worlds(), &[result.seed], result.step)?;
        Ok(states.into_iter().next())
    }
}

impl Report {
    fn tell(&mut self, summary: &Summary) {
        let elapsed = self.since.elapsed();
        if elapsed < REPORT_INTERVAL {
            return;
        }
        let steps = summary.steps - self.last.steps;
        let mean_reward = (summary.reward - self.last.reward) / steps.max(1) as f64;
        let steps_per_second = (steps as f64 / elapsed.as_secs_f64()).round();
        tracing::info!(
            steps = summary.steps,
            mean_reward,
            steps_per_second,
            "acting"
        );
        *self = Self {
            since: Instant::now(),
            last: *summary,
        };
    }
}

/// What a server says of itself, and its model, or the one given; checks that it has the world.
///
/// # Errors
/// [`RunError`].
pub fn prepare(
    instance: &Instance,
    world: u32,
    model: Option<&Model>,
) -> Result<(ServerInfo, Model), RunError> {
    let info = server_info(instance)?;
    if world >= info.n_worlds {
        let (status, detail) = (Status::NoSuchWorld, info.n_worlds.into());
        let message = status.explain(detail);
        return Err(ConnectionError::Refused {
            status,
            detail,
            message,
        }
        .into());
    }
    let revealed = info.model.as_deref().map(Model::from_toml).transpose()?;
    let model = match (model, revealed) {
        (Some(given), Some(revealed)) if *given != revealed => {
            return Err(RunError::RevealedModel {
                expected: revealed.file().name.clone(),
                got: given.file().name.clone(),
            });
        }
        (Some(given), _) => given.clone(),
        (None, Some(revealed)) => revealed,
        (None, None) => {
            let instance = instance.name().into();
            return Err(RunError::NoModel { instance });
        }
    };
    let (expected, got) = (info.n_observations, model.file().observations.len());
    if got != expected {
        return Err(RunError::OtherModel { expected, got });
    }
    Ok((info, model))
}

fn open_truth(mission: &Mission, client: &Client) -> Result<TruthFeed, RunError> {
    if client.info().publish_truth {
        return Ok(TruthFeed::open(&mission.instance, client.shape())?);
    }
    Err(AgentError::NeedsTruth {
        policy: mission.policy.clone(),
    }
    .into())
}

/// Attaches to a server that has come back; `None` if it is time to stop.
fn attach_again(mission: &Mission, stop: &AtomicBool) -> Result<Option<Attached>, RunError> {
    let mut takeover = false;
    while !stop.load(Ordering::Relaxed) {
        match Attached::attach(mission, takeover) {
            Ok(attached) => return Ok(Some(attached)),
            // The server did not end, it paused: our former connection holds the world still.
            Err(error) if is_own_lease(&error) && !takeover => takeover = true,
            Err(error) if is_outage(&error) => {
                takeover = false;
                std::thread::sleep(RETRY_INTERVAL);
            }
            Err(error) => return Err(error),
        }
    }
    Ok(None)
}

/// Whether a world is taken by this very process.
fn is_own_lease(error: &RunError) -> bool {
    let own_pid = u64::from(std::process::id());
    matches!(
        error,
        RunError::Connection(ConnectionError::Refused { status: Status::Busy, detail, .. })
            if *detail == own_pid
    )
}

/// Whether the server is away and may come back.
pub fn is_outage(error: &RunError) -> bool {
    matches!(error, RunError::Connection(error) if is_away(error))
}
