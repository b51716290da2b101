//! Subscribers to the channels on which servers and agents publish.

use crate::connection::{checked, duration};
use crate::errors::{error, raise_of_channel};
use crate::owned::Owned;
use crate::samples::{Published, check_version, frame, outlook, truth};
use crate::wire::Observer;
use emberwatch_messages::errors::ChannelError;
use emberwatch_messages::instance::Instance;
use emberwatch_messages::message::{AgentHeader, FrameHeader, Header, TruthHeader};
use emberwatch_messages::sample::Sample;
use pyo3::prelude::*;
use std::collections::HashMap;
use std::time::Instant;

/// A subscription to one channel.
struct Reading<H: Header> {
    observer: Observer<H>,
    /// The only world whose samples are returned; `None` for all worlds.
    world: Option<u32>,
    /// The sequence number that is expected next from each publisher.
    next: HashMap<u32, u64>,
}

/// A sample, and the number of samples lost before it.
type Read<H> = Result<Option<(Sample<H>, u64)>, ChannelError>;

impl<H: Header + Published> Reading<H> {
    fn open(
        py: Python<'_>,
        instance: &str,
        world: Option<u32>,
        open: fn(&Instance) -> Result<Observer<H>, ChannelError>,
    ) -> PyResult<Owned<Self>> {
        let name = checked(py, instance)?;
        let observer = py.detach(|| open(&name));
        let observer = observer.map_err(|error| raise_of_channel(py, error))?;
        let next = HashMap::new();
        let reading = Self {
            observer,
            world,
            next,
        };
        Ok(Owned::new(instance, reading))
    }

    fn receive(&mut self, seconds: f64) -> Read<H> {
        let (start, mut n_lost) = (Instant::now(), 0);
        loop {
            let left = duration(seconds).saturating_sub(start.elapsed());
            let Some(sample) = self.observer.receive(left)? else {
                return Ok(None);
            };
            let header = &sample.header;
            let next = self.next.insert(header.publisher(), header.sequence() + 1);
            // A number below the expected one means that a new server publishes, so no loss is counted.
            n_lost += next.map_or(0, |next| header.sequence().saturating_sub(next));
            if self.world.is_none_or(|world| world == header.world()) {
                return Ok(Some((sample, n_lost)));
            }
        }
    }
}

fn next<H: Header + Published + Send>(
    py: Python<'_>,
    reading: &Owned<Reading<H>>,
    seconds: f64,
) -> PyResult<Option<(Sample<H>, u64)>> {
    let read = reading.with(py, |reading| reading.receive(seconds))?;
    let read = read.map_err(|error| raise_of_channel(py, error))?;
    if let Some((sample, _)) = &read {
        check_version(&sample.header).map_err(|problem| wrong(py, &problem))?;
    }
    Ok(read)
}

fn wrong(py: Python<'_>, problem: &str) -> PyErr {
    let text = format!("sample: {problem}");
    error(py, "EmberwatchError", (text, "bad_answer"))
}

macro_rules! reader {
    ($name:ident, $header:ty, $open:expr, $decode:expr) => {
        #[doc = "A subscriber to one channel; see `_native.pyi`."]
        #[pyclass(frozen, module = "emberwatch._native")]
        pub struct $name(Owned<Reading<$header>>);

        #[pymethods]
        impl $name {
            #[new]
            #[pyo3(signature = (instance, world=None))]
            fn new(py: Python<'_>, instance: &str, world: Option<u32>) -> PyResult<Self> {
                Reading::open(py, instance, world, $open).map(Self)
            }

            fn receive<'py>(
                &self,
                py: Python<'py>,
                seconds: f64,
            ) -> PyResult<Option<Bound<'py, PyAny>>> {
                let Some((sample, n_lost)) = next(py, &self.0, seconds)? else {
                    return Ok(None);
                };
                let decoded = $decode(py, &sample, n_lost);
                let fields = decoded.map_err(|problem: String| wrong(py, &problem))?;
                Ok(Some(fields.into_pyobject(py)?.into_any()))
            }

            fn close(&self, py: Python<'_>) -> PyResult<()> {
                self.0.close(py)
            }
        }
    };
}

reader!(Frames, FrameHeader, Observer::frames, frame);
reader!(Truths, TruthHeader, Observer::truth, truth);
reader!(Outlooks, AgentHeader, Observer::agents, outlook);
