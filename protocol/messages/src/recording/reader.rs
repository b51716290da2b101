//! Reads a recording record by record, and checks every byte before using it.

use super::format::{
    Event, FileHeader, Kind, MAGIC, MAX_BODY_BYTES, MAX_STORED_BYTES, Record, RecordHeader,
    RecordingError, Totals, VERSIONS, checksum,
};
use super::progress::Progress;
use crate::control::ServerInfo;
use crate::sample::Sample;
use bytemuck::{Pod, Zeroable};
use flate2::bufread::DeflateDecoder;
use serde::de::DeserializeOwned;
use serde_json::Value;
use std::io::Read;

/// A reader of a recording: an iterator of records that ends after the first error.
///
/// A file without an end record yields [`RecordingError::Cut`] after its last complete record. A damaged file yields
/// [`RecordingError::Damaged`] at the first damaged record.
#[derive(Debug)]
pub struct Reader<R> {
    input: R,
    offset: u64,
    progress: Progress,
    stored: Vec<u8>,
    is_over: bool,
}

impl<R: Read> Reader<R> {
    /// Begins to read a recording. `input` should be buffered, and positioned at the beginning of the file.
    ///
    /// # Errors
    /// If the file is not a recording, has another version, or is shorter than a header.
    pub fn new(mut input: R) -> Result<Self, RecordingError> {
        let mut header = FileHeader::zeroed();
        let n_read = fill(&mut input, &mut header)?;
        let n_magic = n_read.min(MAGIC.len());
        if header.magic[..n_magic] != MAGIC[..n_magic] {
            return Err(RecordingError::Foreign(format!(
                "not a recording: expected it to begin with {:?}, got {:?}",
                MAGIC.escape_ascii().to_string(),
                header.magic[..n_magic].escape_ascii().to_string()
            )));
        }
        if n_read < size_of::<FileHeader>() {
            return Err(RecordingError::Cut {
                offset: 0,
                got: n_read as u64,
                n_steps: 0,
            });
        }
        if !VERSIONS.contains(&header.version) {
            let (first, last, got) = (VERSIONS.start(), VERSIONS.end(), header.version);
            let problem = format!("recording version: expected {first} to {last}, got {got}");
            return Err(RecordingError::Foreign(problem));
        }
        if header.reserved != 0 {
            let got = header.reserved;
            let problem = format!("recording: expected 0 in byte 12 to 15, got {got}");
            return Err(RecordingError::Foreign(problem));
        }
        Ok(Self {
            input,
            offset: n_read as u64,
            progress: Progress::new(header.version),
            stored: Vec::new(),
            is_over: false,
        })
    }

    pub fn totals(&self) -> Totals {
        self.progress.totals
    }

    fn read(&mut self) -> Result<Option<Record>, RecordingError> {
        let (offset, n_steps) = (self.offset, self.progress.n_steps);
        let mut header = RecordHeader::zeroed();
        let n_read = fill(&mut self.input, &mut header)?;
        let cut = |got: usize| RecordingError::Cut {
            offset,
            got: got as u64,
            n_steps,
        };
        if n_read < size_of::<RecordHeader>() {
            return Err(cut(n_read));
        }
        let damaged = |problem: String| RecordingError::Damaged {
            offset,
            problem,
            n_steps,
        };
        let length = header.length as usize;
        if length > MAX_STORED_BYTES {
            let problem = format!("body: expected at most {MAX_STORED_BYTES} bytes, got {length}");
            return Err(damaged(problem));
        }
        // The buffer grows as bytes arrive, so a wrong length cannot cause a large allocation.
        self.stored.clear();
        let mut body = (&mut self.input).take(length as u64);
        body.read_to_end(&mut self.stored)?;
        if self.stored.len() < length {
            return Err(cut(n_read + self.stored.len()));
        }
        let expected = checksum(&header, &self.stored);
        if header.checksum != expected {
            let got = header.checksum;
            return Err(damaged(format!(
                "checksum: expected {expected:#010x}, got {got:#010x}"
            )));
        }
        let body = inflated(&self.stored).map_err(damaged)?;
        self.offset += (n_read + length) as u64;
        if header.kind == Kind::End as u32 {
            return self.check_end(&body).map_err(damaged).map(|()| None);
        }
        if header.kind == Kind::Server as u32 && self.progress.version == 2 {
            check_sensor(&body)?;
        }
        let record = Record {
            nanos: header.nanos,
            n_lost: header.n_lost,
            event: event(header.kind, &body).map_err(damaged)?,
        };
        self.progress.accept(&record).map_err(damaged)?;
        Ok(Some(record))
    }

    fn check_end(&mut self, body: &[u8]) -> Result<(), String> {
        let (expected, got) = (self.totals(), json::<Totals>(body)?);
        if got != expected {
            return Err(format!("totals: expected {expected:?}, got {got:?}"));
        }
        match fill(&mut self.input, &mut [0u8; 1]) {
            Ok(0) => Ok(()),
            Ok(_) => Err("expected nothing after the end, got more bytes".into()),
            Err(error) => Err(error.to_string()),
        }
    }
}

impl<R: Read> Iterator for Reader<R> {
    type Item = Result<Record, RecordingError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.is_over {
            return None;
        }
        let read = self.read();
        self.is_over = !matches!(read, Ok(Some(_)));
        read.transpose()
    }
}

fn fill<T: Pod>(input: &mut impl Read, value: &mut T) -> Result<usize, std::io::Error> {
    let bytes = bytemuck::bytes_of_mut(value);
    let mut n_read = 0;
    while n_read < bytes.len() {
        match input.read(&mut bytes[n_read..]) {
            Ok(0) => break,
            Ok(n) => n_read += n,
            Err(error) if error.kind() == std::io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(n_read)
}

fn inflated(stored: &[u8]) -> Result<Vec<u8>, String> {
    let mut decoder = DeflateDecoder::new(stored);
    let mut body = Vec::new();
    let mut limited = (&mut decoder).take(MAX_BODY_BYTES as u64 + 1);
    limited
        .read_to_end(&mut body)
        .map_err(|error| format!("body: expected deflate, got {error}"))?;
    if body.len() > MAX_BODY_BYTES {
        return Err(format!(
            "body: expected at most {MAX_BODY_BYTES} bytes, got more"
        ));
    }
    match decoder.into_inner().len() {
        0 => Ok(body),
        got => Err(format!(
            "body: expected one deflate stream, got {got} bytes after it"
        )),
    }
}

fn event(kind: u32, body: &[u8]) -> Result<Event, String> {
    match kind {
        kind if kind == Kind::Server as u32 => Ok(Event::Server(Box::new(server(body)?))),
        kind if kind == Kind::Frame as u32 => Ok(Event::Frame(sample(body)?)),
        kind if kind == Kind::Truth as u32 => Ok(Event::Truth(sample(body)?)),
        got => Err(format!("kind: expected 1 to 4, got {got}")),
    }
}

/// Checks that a server of version 2 had the sensor and the rewards of this version.
fn check_sensor(body: &[u8]) -> Result<(), RecordingError> {
    let server: Value = serde_json::from_slice(body).unwrap_or_default();
    let airspace = &server["airspace"];
    if airspace["n_rings"].as_u64().unwrap_or(1) == 1 && airspace["pays"] != "seen" {
        return Ok(());
    }
    let expected = "a sensor with one observation matrix, and rewards for visited cells";
    Err(RecordingError::Foreign(format!(
        "recording: expected {expected}, got {airspace}: use the release that recorded it"
    )))
}

/// Parses a server's description. Models of version 2 state that visited cells pay, which is now the only rule.
fn server(body: &[u8]) -> Result<ServerInfo, String> {
    let mut info: ServerInfo = json(body)?;
    let recorded = info.recorded_world.as_mut();
    let description = recorded.and_then(|recorded| recorded.description.as_mut());
    for text in info.model.iter_mut().chain(description) {
        *text = text.replace("pays = \"visited\"\n", "");
    }
    Ok(info)
}

fn sample<H: Pod>(body: &[u8]) -> Result<Sample<H>, String> {
    let (header, payload) = body.split_at_checked(size_of::<H>()).ok_or_else(|| {
        format!(
            "sample: expected {} bytes, got {}",
            size_of::<H>(),
            body.len()
        )
    })?;
    Ok(Sample {
        header: bytemuck::pod_read_unaligned(header),
        payload: payload.to_vec(),
    })
}

fn json<T: DeserializeOwned>(body: &[u8]) -> Result<T, String> {
    serde_json::from_slice(body).map_err(|error| format!("JSON: {error}"))
}
