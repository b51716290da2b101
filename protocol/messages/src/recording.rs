//! A recording: what a server published, in a file. PROTOCOL.md section 13 has its byte tables.
//!
//! A file begins with a [`FileHeader`]; records follow, each a [`RecordHeader`] and a compressed body,
//! and the last one says how many there are. So a file itself shows what it lacks: samples that the
//! recorder missed, records that are damaged, a missing end.

mod format;
mod progress;
mod reader;
mod writer;

pub use format::{
    Event, FileHeader, Kind, MAGIC, MAX_BODY_BYTES, MAX_STORED_BYTES, Record, RecordHeader,
    RecordingError, Totals, VERSION,
};
pub use reader::Reader;
pub use writer::Writer;
