//! Conversion of Rust errors to the exceptions of `emberwatch/errors.py`, and the handling of Ctrl-C.

use emberwatch_messages::errors::ChannelError;
use emberwatch_messages::errors::ConnectionError;
use emberwatch_messages::limits::memory::{self, NoMemory};
use emberwatch_messages::limits::threads::NoThreads;
use emberwatch_sim::embedded::INSTANCE;
use pyo3::call::PyCallArgs;
use pyo3::exceptions::{PyKeyboardInterrupt, PyUserWarning};
use pyo3::prelude::*;
use std::cell::RefCell;
use std::ffi::CString;
use std::fmt::Display;

thread_local! {
    /// The exception that ended a wait of this thread, for example one raised by a signal handler.
    static RAISED: RefCell<Option<PyErr>> = const { RefCell::new(None) };
}

pub fn interrupted() -> bool {
    // Python runs signal handlers only on its main thread, so other threads need not wait for the interpreter here.
    #[cfg(target_os = "linux")]
    let may_be_main = rustix::thread::gettid() == rustix::process::getpid();
    #[cfg(not(target_os = "linux"))]
    let may_be_main = true;
    may_be_main
        && Python::attach(|py| match py.check_signals() {
            Ok(()) => false,
            Err(error) => {
                RAISED.set(Some(error));
                true
            }
        })
}

pub fn raised() -> PyErr {
    RAISED
        .take()
        .unwrap_or_else(|| PyKeyboardInterrupt::new_err(()))
}

/// Stores an exception, and returns the error of an interrupted wait. [`raise`] turns this error back into the
/// exception.
pub fn interruption(raised: PyErr) -> ConnectionError {
    RAISED.set(Some(raised));
    ChannelError::Interrupted.into()
}

/// Creates an exception by calling the class or function of this name in `emberwatch/errors.py`.
pub fn error<'py>(py: Python<'py>, name: &str, arguments: impl PyCallArgs<'py>) -> PyErr {
    let module = py.import("emberwatch.errors");
    let made = module.and_then(|module| module.getattr(name)?.call1(arguments));
    made.map_or_else(|error| error, PyErr::from_value)
}

pub fn no_memory(py: Python<'_>, short: &NoMemory) -> PyErr {
    error(py, "NotEnoughMemoryError", (short.to_string(),))
}

pub fn check_memory(py: Python<'_>, what: impl Display, n_bytes: usize) -> PyResult<()> {
    // Reading the memory limits takes about 0.1 ms, so less than 16 MiB is not checked.
    if n_bytes < 16 << 20 {
        return Ok(());
    }
    memory::check(what, n_bytes as u64).map_err(|short| no_memory(py, &short))
}

pub fn no_threads(py: Python<'_>, short: &NoThreads) -> PyErr {
    error(py, "EmberwatchError", (short.to_string(), "threads"))
}

/// Issues a `UserWarning` at the line of Python code that called into this module.
pub fn warn(py: Python<'_>, words: impl Display) -> PyResult<()> {
    let words = CString::new(words.to_string())?;
    PyErr::warn(py, &py.get_type::<PyUserWarning>(), &words, 1)
}

pub fn raise(py: Python<'_>, problem: ConnectionError, what: &str, seconds: f64) -> PyErr {
    match problem {
        ConnectionError::Channel(problem) => raise_of_channel(py, problem),
        ConnectionError::Memory(short) => no_memory(py, &short),
        ConnectionError::ServerGone { instance, .. } if instance == INSTANCE => {
            let text = "these worlds were ended by shutdown: make new ones";
            error(py, "ServerGoneError", (text,))
        }
        ConnectionError::Timeout { instance, .. } => {
            let text = if instance == INSTANCE {
                format!("{what} did not end within {seconds:?} s")
            } else {
                format!("no answer to {what} from instance '{instance}' within {seconds:?} s")
            };
            error(py, "RequestTimeoutError", (text,))
        }
        ConnectionError::ServerGone { .. } => error(py, "ServerGoneError", (plain(&problem),)),
        ConnectionError::Refused {
            status,
            detail,
            message,
        } => error(py, "refusal", (status as u32, detail, message)),
        ConnectionError::Invalid { .. } => error(py, "InvalidArgumentError", (plain(&problem),)),
        other => bad_answer(py, &other.to_string()),
    }
}

pub fn raise_of_channel(py: Python<'_>, problem: ChannelError) -> PyErr {
    let text = plain(&problem);
    match problem {
        ChannelError::Interrupted => raised(),
        ChannelError::InstanceName(_) => error(py, "InvalidArgumentError", (text,)),
        ChannelError::NoServer { .. } => error(py, "NoServerError", (text,)),
        ChannelError::OtherVersion { version } => {
            error(py, "EmberwatchError", (text, "version_mismatch", version))
        }
        ChannelError::OtherPidNamespace { .. } => {
            error(py, "EmberwatchError", (text, "pid_namespace"))
        }
        _ => error(py, "EmberwatchError", (text, "channel")),
    }
}

pub fn bad_answer(py: Python<'_>, problem: &str) -> PyErr {
    error(py, "EmberwatchError", (problem, "bad_answer"))
}

/// Returns the message of an error, with names in the quotes that Python's messages use.
pub fn plain(problem: &impl Display) -> String {
    problem.to_string().replace('"', "'")
}
