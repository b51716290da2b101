//! Beliefs as bytes, for pickles and files: a magic text, a checksum that reveals damage, and a [`Saved`] in bincode.

use bincode::config::{Configuration, Limit};
use bincode::{BorrowDecode, Encode};

/// The first bytes of a saved belief, with the number of the format.
const MAGIC: &[u8] = b"emberwatch belief 1\n";

/// The limit keeps damaged lengths from exhausting memory.
const FORM: Configuration<
    bincode::config::LittleEndian,
    bincode::config::Varint,
    Limit<{ 1 << 36 }>,
> = bincode::config::standard().with_limit();

/// A saved belief, and what it is built from again. Texts and bytes are borrowed.
#[derive(Encode, BorrowDecode)]
pub struct Saved<'a> {
    pub kind: &'a str,
    pub model: Option<&'a str>,
    /// Number of states, height and width.
    pub dim: (usize, usize, usize),
    pub is_single: bool,
    /// The first belief, as `f32`. Empty if there is a checkpoint.
    pub prior: &'a [u8],
    pub checkpoint: &'a [u8],
    /// Of each world, the number of predictions since the first belief, and the estimator's state.
    pub worlds: Vec<(u64, &'a [u8])>,
}

pub fn is_saved(bytes: &[u8]) -> bool {
    bytes.starts_with(MAGIC)
}

impl<'a> Saved<'a> {
    pub fn to_bytes(&self) -> Vec<u8> {
        let content = bincode::encode_to_vec(self, FORM);
        let content = content.expect("invariant: texts and bytes can be encoded");
        let checksum = crc32fast::hash(&content).to_le_bytes();
        [MAGIC, &checksum, &content].concat()
    }

    /// Returns `None` if the bytes are damaged.
    pub fn from_bytes(bytes: &'a [u8]) -> Option<Self> {
        let (checksum, content) = bytes.strip_prefix(MAGIC)?.split_first_chunk()?;
        if crc32fast::hash(content) != u32::from_le_bytes(*checksum) {
            return None;
        }
        let (saved, n_read): (Self, usize) =
            bincode::borrow_decode_from_slice(content, FORM).ok()?;
        (n_read == content.len() && !saved.worlds.is_empty()).then_some(saved)
    }
}
