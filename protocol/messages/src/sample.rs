//! What is published, as a reader has it.

/// A sample of a channel that is published: copied out of shared memory, or read from a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample<H> {
    /// The binary header.
    pub header: H,
    /// The bytes behind it.
    pub payload: Vec<u8>,
}
