//! The agent's life on one world: attach, act, reconnect, leave.

use crate::acting::handover::{leave, resume, take_over_left};
use crate::acting::registry::{self, Task};
use crate::config::AgentConfig;
use crate::estimation::Prior;
use crate::estimation::belief::Belief;
use crate::estimation::first_belief::first_belief;
use crate::learning::learned::Learned;
use crate::planning::policy::{EstimatorKind, Policy};
use crate::rollout::{self, Robot, Seen};
use crate::server::client::{
    Client, Observation, RETRY_INTERVAL, is_belief_left, is_outage, refusal, refused, server_info,
    shape_of,
};
use crate::server::feed::Feed;
use crate::server::truth::TruthFeed;
use anyhow::{Result, bail, ensure};
use protocol::channels::Instance;
use protocol::control::ServerInfo;
use protocol::message::Status;
use protocol::{Grid, Model};
use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// How often progress is told.
const REPORT_INTERVAL: Duration = Duration::from_secs(2);

/// What to do on one world.
#[derive(Debug, Clone)]
pub struct Mission {
    pub instance: Instance,
    pub world: u32,
    pub policy: String,
    /// Steps to act for; 0: until stopped.
    pub steps: u64,
    /// Take the world from its holder.
    pub takeover: bool,
    /// The model, where the server does not reveal its own.
    pub model: Option<Model>,
    pub config: AgentConfig,
    /// What was learned, for policies that act on it.
    pub learned: Learned,
}

/// What a mission did.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Summary {
    pub steps: u64,
    /// Sum of their rewards.
    pub reward: f64,
}

/// Acts until the steps are done or `stop` is set. Waits for a server that ends, however often.
pub fn run(mission: &Mission, stop: &AtomicBool) -> Result<Summary> {
    let (mut summary, mut is_in_step) = (Summary::default(), true);
    let mut attached = Attached::attach(mission)?;
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
        robot,
        feed,
        ..
    } = attached;
    // After an outage nobody knows where the world stands.
    let left = match is_in_step {
        true => leave(&mut client, mission.world, &robot),
        false => Ok(()),
    };
    let released = left.and_then(|()| client.release());
    feed.end();
    match released.map_err(anyhow::Error::from) {
        Err(error) if !is_outage(&error) => Err(error),
        _ => Ok(summary),
    }
}

impl Mission {
    fn worlds(&self) -> Range<u32> {
        self.world..self.world.saturating_add(1)
    }
}

/// An agent at its world.
struct Attached {
    client: Client,
    truth: Option<TruthFeed>,
    robot: Robot,
    feed: Feed,
    report: Report,
}

/// Tells of progress now and then.
struct Report {
    since: Instant,
    last: Summary,
}

impl Attached {
    /// Acquires the world where it stands and takes in its last frame.
    fn attach(mission: &Mission) -> Result<Self> {
        let (info, model) = prepare(&mission.instance, &mission.worlds(), mission.model.as_ref())?;
        let policy = Policy::named(&mission.policy, &model)?;
        ensure!(
            policy.estimator != EstimatorKind::NextTruth,
            "policy {:?} needs worlds that run one step ahead: only `compare` has them",
            policy.name
        );
        let shape = shape_of(&info)?;
        // What takes long is done before the lease begins to run, and not at all where a belief was left.
        let prior = if policy.estimator.knows_model() {
            let any = Belief::from_initial(&model, shape);
            if let Some(attached) = Self::go_on(mission, &model, &policy, &any)? {
                return Ok(attached);
            }
            mission.config.prior(info.burn_in)
        } else {
            Prior::Initial
        };
        let prior = first_belief(prior, &model, shape, mission.config.seed)?;
        let mut attached = Self::acquire(mission, &model, &policy, &prior)?;
        if !resume(&mut attached.client, mission.world, &mut attached.robot)? {
            attached.begin()?;
        }
        Ok(attached)
    }

    /// Acquires the world if a belief was left about it, in the place of `any`.
    fn go_on(
        mission: &Mission,
        model: &Model,
        policy: &Policy,
        any: &Belief,
    ) -> Result<Option<Self>> {
        let task = Task {
            model,
            shape: any.shape(),
            n_moves: 1,
            prior: any,
            seed: 0,
            learned: &mission.learned,
        };
        let agent = registry::agent(policy, &mission.config, task)?;
        let Some(kind) = agent.estimator().kind() else {
            return Ok(None);
        };
        if !is_belief_left(&mission.instance, mission.world, &kind)? {
            return Ok(None);
        }
        let mut attached = Self::acquire(mission, model, policy, any)?;
        if take_over_left(&mut attached.client, mission.world, &mut attached.robot)? {
            return Ok(Some(attached));
        }
        // Another agent acted since.
        attached.client.release()?;
        Ok(None)
    }

    /// Acquires the world for an agent before its first frame.
    fn acquire(mission: &Mission, model: &Model, policy: &Policy, prior: &Belief) -> Result<Self> {
        let (client, mut observations) =
            Client::acquire_and_observe(&mission.instance, mission.worlds(), mission.takeover)?;
        let observation = observations.remove(0);
        let (seed, step) = (observation.result.seed, observation.result.step);
        tracing::info!(
            world = mission.world,
            seed,
            step,
            policy = policy.name,
            "acting"
        );
        let task = Task {
            model,
            shape: client.shape(),
            n_moves: client.info().n_moves,
            prior,
            seed: mission.config.planner_seed(seed),
            learned: &mission.learned,
        };
        let agent = registry::agent(policy, &mission.config, task)?;
        let is_told = policy.estimator == EstimatorKind::Truth;
        let truth = is_told.then(|| open_truth(mission, &client)).transpose()?;
        let feed = Feed::open(&mission.instance, agent.belief());
        let report = Report {
            since: Instant::now(),
            last: Summary::default(),
        };
        Ok(Self {
            client,
            truth,
            robot: Robot::new(agent, observation),
            feed,
            report,
        })
    }

    fn begin(&mut self) -> Result<()> {
        let truth = self.truth.as_ref();
        let truth = truth_of(truth, &self.client, self.robot.observation())?;
        let (feed, world) = (&mut self.feed, self.client.worlds().start);
        let look = |robot: &Robot| show(feed, world, robot, false);
        self.robot.begin(truth.as_ref(), look)
    }

    /// One step of the rollout; returns the reward. The last belief is shown in any case.
    fn step(&mut self, is_last: bool) -> Result<f64> {
        let world = self.client.worlds().start;
        rollout::step(
            std::slice::from_mut(&mut self.robot),
            |robot| robot,
            Robot::plan,
            |paths| {
                let observation = self.client.step(world..world + 1, paths)?.remove(0);
                let truth = truth_of(self.truth.as_ref(), &self.client, &observation)?;
                anyhow::Ok(vec![Seen { observation, truth }])
            },
            |_, robot, _| {
                show(&mut self.feed, world, robot, is_last);
                Ok(())
            },
        )?;
        Ok(self.robot.observation().result.reward)
    }
}

/// The hidden states that an observation shows part of, for policies that are told them.
fn truth_of(
    feed: Option<&TruthFeed>,
    client: &Client,
    observation: &Observation,
) -> Result<Option<Grid<u8>>> {
    let Some(feed) = feed else {
        return Ok(None);
    };
    let result = &observation.result;
    let states = feed.states(client.worlds(), &[result.seed], result.step)?;
    Ok(states.into_iter().next())
}

/// Shows a robot's posterior to those who look on, if it is time or in any case.
fn show(feed: &mut Feed, world: u32, robot: &Robot, in_any_case: bool) {
    if feed.is_due() || in_any_case {
        feed.show(&robot.view(world));
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

/// What a server says of itself, and its model, or the one given; checks that it has the worlds.
pub fn prepare(
    instance: &Instance,
    worlds: &Range<u32>,
    model: Option<&Model>,
) -> Result<(ServerInfo, Model)> {
    let info = server_info(instance)?;
    if worlds.end > info.n_worlds {
        let (status, detail) = (Status::NoSuchWorld, info.n_worlds.into());
        return Err(refused(status, detail, status.explain(detail)).into());
    }
    let revealed = info.model.as_deref().map(Model::from_toml).transpose()?;
    let model = match (model, revealed) {
        (Some(given), Some(revealed)) if *given != revealed => {
            bail!(
                "model: expected the server's own, {:?}, as it reveals it, got another, {:?}",
                revealed.file().name,
                given.file().name
            );
        }
        (Some(given), _) => given.clone(),
        (None, Some(revealed)) => revealed,
        (None, None) => bail!(
            "instance {:?} does not reveal its model: expected --model FILE",
            instance.name()
        ),
    };
    let (expected, got) = (info.n_observations, model.file().observations.len());
    ensure!(
        got == expected,
        "model: expected the server's {expected} observations, got {got}"
    );
    Ok((info, model))
}

fn open_truth(mission: &Mission, client: &Client) -> Result<TruthFeed> {
    ensure!(
        client.info().publish_truth,
        "policy {:?} needs the truth channel: start the server with --publish-truth",
        mission.policy
    );
    TruthFeed::open(&mission.instance, client.shape())
}

/// Attaches to a server that has come back; `None` if it is time to stop.
fn attach_again(mission: &Mission, stop: &AtomicBool) -> Result<Option<Attached>> {
    let mut mission = mission.clone();
    mission.takeover = false;
    while !stop.load(Ordering::Relaxed) {
        match Attached::attach(&mission) {
            Ok(attached) => return Ok(Some(attached)),
            // The server did not end, it paused: our former connection holds the world still.
            Err(error) if is_own_lease(&error) && !mission.takeover => mission.takeover = true,
            Err(error) if is_outage(&error) => {
                mission.takeover = false;
                std::thread::sleep(RETRY_INTERVAL);
            }
            Err(error) => return Err(error),
        }
    }
    Ok(None)
}

/// Whether a world is taken by this very process.
fn is_own_lease(error: &anyhow::Error) -> bool {
    let own_pid = u64::from(std::process::id());
    refusal(error).is_some_and(|(status, detail, _)| (status, detail) == (Status::Busy, own_pid))
}
