//! The classes `Observer`, `TruthReader` and `OutlookReader`: subscribers of what servers and agents publish.

use crate::arguments::{Number, duration};
use crate::client::checked;
use crate::errors::{raise, raise_of_channel};
use crate::owned::Owned;
use crate::records;
use crate::refusal::invalid;
use crate::wire::Observer as Subscriber;
use emberwatch_messages::message::{AgentHeader, FrameHeader, TruthHeader};
use pyo3::prelude::*;
use pyo3::types::PyTuple;

/// Seconds that an iteration without a timeout waits at a time, because an infinite wait would overflow.
const HOUR: f64 = 3600.0;

macro_rules! reader {
    ($(#[$doc:meta])* $name:ident, $header:ty, $open:path, $record:path) => {
        $(#[$doc])*
        #[pyclass(frozen, subclass, weakref, dict, module = "emberwatch")]
        pub struct $name {
            #[pyo3(get)]
            instance: String,
            subscriber: Owned<Subscriber<$header>>,
            world: Option<u32>,
            timeout: Option<f64>,
        }

        #[pymethods]
        impl $name {
            #[new]
            #[pyo3(signature = (instance="default", *, world=None, timeout=None))]
            fn new(
                py: Python<'_>,
                instance: &str,
                world: Option<Number>,
                timeout: Option<f64>,
            ) -> PyResult<Self> {
                if let Some(got) = timeout.filter(|it| it.is_nan() || *it < 0.0) {
                    let expected = "seconds of at least 0, or None";
                    return Err(invalid(py, "timeout", expected, got));
                }
                let name = checked(py, instance)?;
                let subscriber = py.detach(|| $open(&name));
                let subscriber = subscriber.map_err(|error| raise_of_channel(py, error))?;
                Ok(Self {
                    instance: instance.into(),
                    subscriber: Owned::new(instance, subscriber),
                    world: world.map(|it| it.0),
                    timeout,
                })
            }

            /// Returns the next sample; None if none arrives within `timeout` seconds.
            fn receive<'py>(
                &self,
                py: Python<'py>,
                timeout: f64,
            ) -> PyResult<Option<Bound<'py, PyAny>>> {
                let limit = duration(py, timeout)?;
                let next = |from: &mut Subscriber<$header>| from.next_of(self.world, limit);
                let read = self.subscriber.with(py, next)?;
                let read = read.map_err(|error| raise(py, error, "a sample", timeout))?;
                read.map(|(sample, n_lost)| $record(py, &sample, n_lost)).transpose()
            }

            fn __iter__(slf: PyRef<'_, Self>) -> PyRef<'_, Self> {
                slf
            }

            fn __next__<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
                loop {
                    let sample = self.receive(py, self.timeout.unwrap_or(HOUR))?;
                    if sample.is_some() || self.timeout.is_some() {
                        return Ok(sample);
                    }
                }
            }

            /// Closes the channel. May be called again.
            fn close(&self, py: Python<'_>) -> PyResult<()> {
                self.subscriber.close(py)
            }

            fn __enter__(slf: PyRef<'_, Self>) -> PyRef<'_, Self> {
                slf
            }

            fn __repr__(&self) -> String {
                format!("<{} of instance {:?}>", stringify!($name), self.instance)
            }

            #[pyo3(signature = (*_error))]
            fn __exit__(&self, py: Python<'_>, _error: &Bound<'_, PyTuple>) -> PyResult<()> {
                self.close(py)
            }
        }
    };
}

reader! {
    /// A reader of the frames of an instance: one `Frame` for each step of each world.
    ///
    /// Iterate over it, or call `receive`. A slow reader loses samples; it never delays the server.
    /// The server publishes the current frame of every world when an observer connects, so the same
    /// step of the same episode may arrive twice.
    ///
    /// The server of the instance may start later. `world` is the only world to observe; None: all.
    /// The iteration ends after `timeout` seconds without a frame; None: never.
    Observer, FrameHeader, Subscriber::frames, records::frame
}

reader! {
    /// A reader of the hidden states of an instance, if its server publishes them: one `Truth` for
    /// each step of each world. Otherwise as `Observer`.
    TruthReader, TruthHeader, Subscriber::truth, records::truth
}

reader! {
    /// A reader of the beliefs of the agents of an instance, as `Outlook`. Otherwise as `Observer`.
    ///
    /// Agents publish their beliefs only while there is a reader.
    OutlookReader, AgentHeader, Subscriber::agents, records::outlook
}
