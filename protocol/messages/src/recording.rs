//! A recording: the samples that a server published, in a file. PROTOCOL.md section 13 contains the byte tables.
//!
//! A file begins with a [`FileHeader`]. Records follow, each a [`RecordHeader`] and a compressed body. The last record
//! contains the number of records. So the file itself reveals samples that the recorder missed, damaged records, and a
//! missing end.

mod format;
mod progress;
mod reader;
mod writer;

pub use format::{
    Event, FileHeader, Kind, MAGIC, MAX_BODY_BYTES, MAX_STORED_BYTES, Record, RecordHeader,
    RecordingError, Totals, VERSIONS,
};
pub use reader::Reader;
pub use writer::Writer;
