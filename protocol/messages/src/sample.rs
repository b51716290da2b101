//! A published sample, as a reader receives it.

/// A sample of a publish-subscribe channel, copied out of shared memory or read from a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample<H> {
    pub header: H,
    pub payload: Vec<u8>,
}
