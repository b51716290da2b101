//! Reads recordings, record by record.

use crate::errors::error;
use crate::records;
use crate::refusal::invalid;
use emberwatch_messages::recording::{Event, Reader, RecordingError};
use pyo3::exceptions::PyOSError;
use pyo3::prelude::*;
use std::fs::File;
use std::io::BufReader;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

#[pyclass(frozen, module = "emberwatch._native")]
pub struct Recording {
    name: String,
    reader: Mutex<Reader<BufReader<File>>>,
}

#[pymethods]
impl Recording {
    #[new]
    fn new(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let name = path.display().to_string();
        // Opening a FIFO would wait for its writer, and no signal would end the wait.
        let found = py.detach(|| std::fs::metadata(&path));
        if !found.map_err(|error| unread(&name, &error))?.is_file() {
            return Err(invalid(py, "recording", "a regular file", name));
        }
        let reader = py.detach(|| Reader::new(BufReader::new(File::open(path)?)));
        let reader = reader.map_err(|problem| raise(py, &name, problem))?;
        Ok(Self {
            name,
            reader: Mutex::new(reader),
        })
    }

    fn __iter__(slf: PyRef<'_, Self>) -> PyRef<'_, Self> {
        slf
    }

    /// Returns nanoseconds since the recording began, and a `Frame`, `Truth` or `ServerInfo`.
    fn __next__<'py>(&self, py: Python<'py>) -> PyResult<Option<(u64, Bound<'py, PyAny>)>> {
        let record = py.detach(|| {
            let mut reader = self.reader.lock().unwrap_or_else(PoisonError::into_inner);
            reader.next()
        });
        let record = record.transpose();
        let record = record.map_err(|problem| raise(py, &self.name, problem))?;
        let Some(record) = record else {
            return Ok(None);
        };
        let n_lost = record.n_lost.into();
        let made = match record.event {
            Event::Server(info) => records::server_info(py, &info),
            Event::Frame(sample) => records::frame(py, &sample, n_lost),
            Event::Truth(sample) => records::truth(py, &sample, n_lost),
        };
        Ok(Some((record.nanos, made?)))
    }
}

/// Creates the exception for a file that could not be read. Its code is "cut" if the recording ends early, "damaged" if
/// it is damaged, and "recording" if the file is no recording.
fn raise(py: Python<'_>, name: &str, problem: RecordingError) -> PyErr {
    let text = format!("{name}: {problem}");
    let code = match problem {
        RecordingError::Io(error) => return unread(name, &error),
        RecordingError::Cut { .. } => "cut",
        RecordingError::Damaged { .. } => "damaged",
        _ => "recording",
    };
    error(py, "EmberwatchError", (text, code))
}

fn unread(name: &str, error: &std::io::Error) -> PyErr {
    match error.raw_os_error() {
        Some(code) => PyOSError::new_err((code, error.to_string(), name.to_owned())),
        None => PyOSError::new_err(format!("{name}: {error}")),
    }
}
