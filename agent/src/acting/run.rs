//! The life cycle of an agent on one world: attach, act, reconnect, release.

use crate::acting::mission::Mission;
use crate::acting::pilot::Pilot;
use crate::client::errors::{is_outage, refusal};
use crate::client::info::RETRY_INTERVAL;
use anyhow::Result;
use emberwatch_protocol::message::Status;
use std::time::{Duration, Instant};

const REPORT_INTERVAL: Duration = Duration::from_secs(2);

#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Summary {
    /// Number of steps in which the agent's paths were flown.
    pub steps: u64,
    /// Reward of these steps, summed over the agent's robots.
    pub reward: f64,
}

/// Acts in successive episodes until the mission's steps are done or it must stop. Waits for a new server if one stops.
pub fn run(mission: &Mission) -> Result<Summary> {
    let (mut summary, mut is_in_step) = (Summary::default(), true);
    let mut pilot = Pilot::attach(mission)?;
    let mut report = Report {
        since: Instant::now(),
        last: summary,
    };
    let mut due = Instant::now();
    while !mission.is_over() && (mission.steps == 0 || summary.steps < mission.steps) {
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        due = Instant::now() + mission.shortest_step;
        match pilot.step(mission, summary.steps + 1 == mission.steps) {
            Ok(Some(reward)) => {
                summary.steps += 1;
                summary.reward += reward;
                report.log(&summary);
            }
            Ok(None) => {}
            Err(error) if is_outage(&error) => {
                tracing::warn!("{error}; waiting for the server to come back");
                match attach_again(mission)? {
                    Some(again) => pilot = again,
                    None => {
                        is_in_step = false;
                        break;
                    }
                }
            }
            Err(error) => return Err(error),
        }
    }
    // After an outage the world's state is unknown, so no belief is left.
    let left = if is_in_step { pilot.leave() } else { Ok(()) };
    let released = pilot.release();
    match left.and(released).map_err(anyhow::Error::from) {
        Err(error) if !is_outage(&error) => Err(error),
        _ => Ok(summary),
    }
}

struct Report {
    since: Instant,
    last: Summary,
}

impl Report {
    fn log(&mut self, summary: &Summary) {
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
        self.since = Instant::now();
        self.last = *summary;
    }
}

fn attach_again(mission: &Mission) -> Result<Option<Pilot>> {
    let mut mission = mission.clone();
    mission.takeover = false;
    while !mission.is_over() {
        match Pilot::attach(&mission) {
            Ok(pilot) => return Ok(Some(pilot)),
            // The server had only paused, so this process's former connection still holds the robots.
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

fn is_own_lease(error: &anyhow::Error) -> bool {
    let own_pid = u64::from(std::process::id());
    refusal(error).is_some_and(|(status, detail, _)| (status, detail) == (Status::Busy, own_pid))
}
