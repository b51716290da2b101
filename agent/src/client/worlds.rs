//! The worlds that a command acts on: those of a running server, or worlds simulated in this process.

use crate::client::info::connect;
use crate::client::truth::TruthFeed;
use anyhow::{Context, Result};
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::client::Backend;
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::control::ServerInfo;
use emberwatch_protocol::feed::Feed;
use emberwatch_protocol::grid::Probabilities;
use emberwatch_protocol::message::{StepReply, StepRequest};
use emberwatch_protocol::{Connection, Grid};
use emberwatch_sim::config::Checked;
use emberwatch_sim::embedded::Embedded;
use std::time::Duration;

/// Worlds of a running server, or of this process.
pub enum Worlds {
    Attached {
        instance: Instance,
        connection: Box<Connection>,
        /// `None` if hidden states are not needed or not published.
        truth: Option<Box<TruthFeed>>,
    },
    Simulated(Box<Embedded>),
}

impl Worlds {
    /// Connects to a running server. With `reads_truth`, also reads hidden states, if the server publishes them.
    pub fn attach(instance: &Instance, reads_truth: bool) -> Result<Self> {
        let connection = connect(instance)?;
        let info = connection.info();
        let truth = (reads_truth && info.publish_truth).then(|| {
            let shape = info.shape().map_err(anyhow::Error::msg)?;
            TruthFeed::open(instance, shape).map(Box::new)
        });
        Ok(Self::Attached {
            instance: instance.clone(),
            truth: truth.transpose()?,
            connection: Box::new(connection),
        })
    }

    /// Simulates worlds in this process, and starts their burn-ins. Warns of settings that do badly.
    pub fn simulate(settings: Checked) -> Result<Self> {
        for warning in settings.warnings() {
            tracing::warn!("{warning}");
        }
        Ok(Self::Simulated(Box::new(Embedded::new(settings)?)))
    }

    /// Returns whether hidden states can be read. A server may not publish them.
    pub fn has_truth(&self) -> bool {
        match self {
            Self::Attached { truth, .. } => truth.is_some(),
            Self::Simulated(_) => true,
        }
    }

    /// Returns the hidden states of the first worlds, whose episodes have these seeds, at a step. Each step must be
    /// read once, in order. Returns `None` without hidden states.
    ///
    /// # Errors
    /// If the server does not publish them in time.
    pub fn states(&mut self, seeds: &[u64], step: u64) -> Result<Option<Vec<Grid<u8>>>> {
        match self {
            Self::Attached { truth, .. } => {
                let states = |truth: &TruthFeed| truth.states(0..seeds.len() as u32, seeds, step);
                truth.as_deref().map(states).transpose()
            }
            Self::Simulated(worlds) => {
                let episodes = worlds.episodes(0..seeds.len())?;
                let episodes = episodes.context("invariant: worlds are ready after a reset")?;
                Ok(Some(
                    episodes.iter().map(|it| it.states().clone()).collect(),
                ))
            }
        }
    }

    /// Opens the feed of beliefs to observers of the server. Worlds of this process have no observers.
    pub fn feed(&self, belief: &Probabilities) -> Feed {
        match self {
            Self::Attached { instance, .. } => Feed::open(instance, belief),
            Self::Simulated(_) => Feed::closed(),
        }
    }
}

impl Backend for Worlds {
    fn info(&self) -> &ServerInfo {
        match self {
            Self::Attached { connection, .. } => connection.info(),
            Self::Simulated(worlds) => worlds.info(),
        }
    }

    fn step(
        &mut self,
        request: StepRequest,
        body: &[u8],
        timeout: Duration,
    ) -> Result<(StepReply, Vec<u8>), ConnectionError> {
        match self {
            Self::Attached { connection, .. } => connection.step(request, body, timeout),
            Self::Simulated(worlds) => worlds.step(request, body, timeout),
        }
    }

    fn control_text(&mut self, text: &[u8], timeout: Duration) -> Result<Vec<u8>, ConnectionError> {
        match self {
            Self::Attached { connection, .. } => connection.control_text(text, timeout),
            Self::Simulated(worlds) => worlds.control_text(text, timeout),
        }
    }
}
