//! A published sample, as a reader receives it.

/// A sample of a publish-subscribe channel, copied out of shared memory or read from a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample<H> {
    /// The binary header.
    pub header: H,
    /// The bytes after the header.
    pub payload: Vec<u8>,
}
