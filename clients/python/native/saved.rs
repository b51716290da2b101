//! Beliefs as bytes, for pickles and files. A header is followed by the first belief, the checkpoint, and the state of
//! each world, each with its length. A checksum reveals damage.

use serde::{Deserialize, Serialize};

/// The first bytes of a saved belief, with the number of the format.
const MAGIC: &[u8] = b"emberwatch belief 1\n";

/// The sources of a saved belief, as JSON.
#[derive(Serialize, Deserialize)]
pub struct Header {
    pub kind: String,
    /// Text of the model file, if the model is known.
    pub model: Option<String>,
    /// Number of states, height and width.
    pub dim: (usize, usize, usize),
    pub is_single: bool,
    /// Number of predictions of each world since the first belief.
    pub steps: Vec<u64>,
}

/// A saved belief. The bytes are borrowed from a file or a pickle.
pub struct Saved<'a> {
    pub header: Header,
    /// The first belief, as `f32`. Empty if there is a checkpoint.
    pub prior: &'a [u8],
    /// Empty if there is none.
    pub checkpoint: &'a [u8],
    pub worlds: Vec<&'a [u8]>,
}

/// Returns whether a file contains a saved belief.
pub fn is_saved(bytes: &[u8]) -> bool {
    bytes.starts_with(MAGIC)
}

impl<'a> Saved<'a> {
    pub fn to_bytes(&self) -> Vec<u8> {
        let header = serde_json::to_vec(&self.header).expect("invariant: a header is JSON");
        let parts = [&header, self.prior, self.checkpoint];
        let parts = parts.iter().chain(&self.worlds);
        let n_bytes: usize = parts.clone().map(|part| 8 + part.len()).sum();
        let mut bytes = Vec::with_capacity(MAGIC.len() + 4 + n_bytes);
        bytes.extend([MAGIC, &[0; 4]].concat());
        for part in parts {
            bytes.extend((part.len() as u64).to_le_bytes());
            bytes.extend_from_slice(part);
        }
        let (first, content) = bytes.split_at_mut(MAGIC.len() + 4);
        first[MAGIC.len()..].copy_from_slice(&crc32fast::hash(content).to_le_bytes());
        bytes
    }

    /// Returns `None` if the bytes are damaged.
    pub fn from_bytes(bytes: &'a [u8]) -> Option<Self> {
        let (checksum, content) = bytes.strip_prefix(MAGIC)?.split_first_chunk()?;
        if crc32fast::hash(content) != u32::from_le_bytes(*checksum) {
            return None;
        }
        let mut rest = content;
        let mut next = || {
            let (length, after) = rest.split_first_chunk()?;
            let length = usize::try_from(u64::from_le_bytes(*length)).ok()?;
            let (part, after) = after.split_at_checked(length)?;
            rest = after;
            Some(part)
        };
        let header: Header = serde_json::from_slice(next()?).ok()?;
        let (prior, checkpoint) = (next()?, next()?);
        let worlds: Option<Vec<_>> = header.steps.iter().map(|_| next()).collect();
        let worlds = worlds.filter(|it| !it.is_empty())?;
        rest.is_empty().then_some(Self {
            header,
            prior,
            checkpoint,
            worlds,
        })
    }
}
