//! Writes a recording record by record.

use super::format::{
    Event, FileHeader, Kind, MAGIC, MAX_BODY_BYTES, Record, RecordHeader, RecordingError, Totals,
    checksum,
};
use super::progress::Progress;
use crate::message::VERSION;
use flate2::{Compress, Compression, FlushCompress, Status};
use std::io::Write;

/// The compression level. At this level, a frame of 64 x 64 cells with 64 moves is compressed to 153 bytes in 15 us,
/// and hidden states to 651 bytes in 48 us. Level 1 is equally fast, but yields 207 and 1,025 bytes. Level 6 yields 146
/// and 560 bytes, but takes five times as long.
const LEVEL: u32 = 2;

/// A writer of a recording. Call [`Self::finish`] at the end: readers report an error for a recording without an end
/// record.
#[derive(Debug)]
pub struct Writer<W> {
    output: W,
    progress: Progress,
    compressor: Compress,
    body: Vec<u8>,
    stored: Vec<u8>,
    n_bytes: u64,
}

impl<W: Write> Writer<W> {
    /// Begins a recording.
    ///
    /// # Errors
    /// If the system returns an error.
    pub fn new(mut output: W) -> Result<Self, RecordingError> {
        let header = FileHeader {
            magic: MAGIC,
            version: VERSION,
            reserved: 0,
        };
        output.write_all(bytemuck::bytes_of(&header))?;
        Ok(Self {
            output,
            progress: Progress::new(VERSION),
            compressor: Compress::new(Compression::new(LEVEL), false),
            body: Vec::new(),
            stored: Vec::new(),
            n_bytes: size_of::<FileHeader>() as u64,
        })
    }

    /// Writes a record.
    ///
    /// # Errors
    /// If the system returns an error, or if a sample does not match the last server or is earlier than the previous
    /// record. Such a sample is not written.
    pub fn write(&mut self, record: &Record) -> Result<(), RecordingError> {
        self.progress
            .accept(record)
            .map_err(RecordingError::Refused)?;
        self.body.clear();
        let kind = match &record.event {
            Event::Server(info) => {
                serde_json::to_writer(&mut self.body, info).expect("invariant: replies serialise");
                Kind::Server
            }
            Event::Frame(sample) => {
                self.body.extend(bytemuck::bytes_of(&sample.header));
                self.body.extend(&sample.payload);
                Kind::Frame
            }
            Event::Truth(sample) => {
                self.body.extend(bytemuck::bytes_of(&sample.header));
                self.body.extend(&sample.payload);
                Kind::Truth
            }
        };
        self.append(kind, record.nanos, record.n_lost)
    }

    pub fn flush(&mut self) -> Result<(), RecordingError> {
        Ok(self.output.flush()?)
    }

    pub fn n_bytes(&self) -> u64 {
        self.n_bytes
    }

    /// Writes the end record, and returns the totals of the recording.
    ///
    /// # Errors
    /// If the system returns an error.
    pub fn finish(&mut self) -> Result<Totals, RecordingError> {
        let totals = self.progress.totals;
        self.body.clear();
        serde_json::to_writer(&mut self.body, &totals).expect("invariant: totals serialise");
        self.append(Kind::End, self.progress.nanos, 0)?;
        self.flush()?;
        Ok(totals)
    }

    fn append(&mut self, kind: Kind, nanos: u64, n_lost: u32) -> Result<(), RecordingError> {
        if self.body.len() > MAX_BODY_BYTES {
            let got = self.body.len();
            let problem = format!("body: expected at most {MAX_BODY_BYTES} bytes, got {got}");
            return Err(RecordingError::Refused(problem));
        }
        self.compressor.reset();
        self.stored.clear();
        self.stored
            .reserve(self.body.len() + self.body.len() / 1024 + 64);
        let status =
            self.compressor
                .compress_vec(&self.body, &mut self.stored, FlushCompress::Finish);
        if !matches!(status, Ok(Status::StreamEnd)) {
            let problem = format!("compression: expected the end of the stream, got {status:?}");
            return Err(RecordingError::Io(std::io::Error::other(problem)));
        }
        let mut header = RecordHeader {
            nanos,
            kind: kind as u32,
            length: self.stored.len() as u32,
            n_lost,
            checksum: 0,
        };
        header.checksum = checksum(&header, &self.stored);
        self.output.write_all(bytemuck::bytes_of(&header))?;
        self.output.write_all(&self.stored)?;
        self.n_bytes += (size_of::<RecordHeader>() + self.stored.len()) as u64;
        Ok(())
    }
}
