//! Stand-ins for `wire` on systems other than Linux, where connecting is impossible.

use emberwatch_messages::backend::{Backend, StepAnswer};
use emberwatch_messages::control::ServerInfo;
use emberwatch_messages::errors::{ChannelError, ConnectionError};
use emberwatch_messages::instance::Instance;
use emberwatch_messages::message::{AgentHeader, FrameHeader, StepRequest, TruthHeader};
use emberwatch_messages::sample::Sample;
use std::convert::Infallible;
use std::marker::PhantomData;
use std::time::Duration;

/// A connection, which cannot exist on these systems.
pub struct Connection(Infallible);

impl Connection {
    /// Refuses to connect.
    pub fn open_within(
        instance: &Instance,
        _: &str,
        _: (Duration, Duration),
        _: impl FnMut(&ConnectionError) -> bool,
    ) -> Result<Self, ConnectionError> {
        Err(refusal(instance).into())
    }
}

impl Backend for Connection {
    fn info(&self) -> &ServerInfo {
        match self.0 {}
    }

    fn step(
        &mut self,
        _: StepRequest,
        _: &[u8],
        _: Duration,
    ) -> Result<StepAnswer, ConnectionError> {
        match self.0 {}
    }

    fn control_text(&mut self, _: &[u8], _: Duration) -> Result<Vec<u8>, ConnectionError> {
        match self.0 {}
    }
}

/// An observer, which cannot exist on these systems.
pub struct Observer<H>(Infallible, PhantomData<H>);

impl Observer<FrameHeader> {
    /// Refuses to observe.
    pub fn frames(instance: &Instance) -> Result<Self, ChannelError> {
        Err(refusal(instance))
    }
}

impl Observer<TruthHeader> {
    /// Refuses to observe.
    pub fn truth(instance: &Instance) -> Result<Self, ChannelError> {
        Err(refusal(instance))
    }
}

impl Observer<AgentHeader> {
    /// Refuses to observe.
    pub fn agents(instance: &Instance) -> Result<Self, ChannelError> {
        Err(refusal(instance))
    }
}

impl<H> Observer<H> {
    pub fn next_of(
        &self,
        _: Option<u32>,
        _: Duration,
    ) -> Result<Option<(Sample<H>, u64)>, ConnectionError> {
        match self.0 {}
    }
}

fn refusal(instance: &Instance) -> ChannelError {
    ChannelError::OtherSystem {
        instance: instance.name().into(),
    }
}
