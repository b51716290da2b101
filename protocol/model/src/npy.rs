//! Reads NumPy arrays from bytes that may lie about their size.

use ndarray::{ArrayD, IxDyn};
use ndarray_npy::npy::header::Header;
use ndarray_npy::{ReadNpyExt, ReadableElement};
use std::io::Cursor;

/// Maximum size of an array's header. NumPy writes 128 bytes; nested brackets in a long header could overflow the
/// parser's stack.
const MAX_HEADER_BYTES: u16 = 512;

pub(super) struct Npy<'b> {
    bytes: &'b [u8],
    /// The shape that the header states.
    pub shape: Vec<usize>,
    /// Number of bytes after the header.
    pub n_bytes: usize,
}

impl<'b> Npy<'b> {
    /// Reads the header of an array.
    ///
    /// # Errors
    /// If the bytes don't begin with the header of a `.npy` file.
    pub fn new(bytes: &'b [u8]) -> Result<Self, String> {
        let header = match bytes.strip_prefix(b"\x93NUMPY") {
            Some([1, _, low, high, ..]) => u16::from_le_bytes([*low, *high]),
            _ => return Err("expected a NumPy array".into()),
        };
        if header > MAX_HEADER_BYTES {
            let expected = format!("expected a header of at most {MAX_HEADER_BYTES} bytes");
            return Err(format!("{expected}, got {header}"));
        }
        let mut rest = Cursor::new(bytes);
        let header = Header::from_reader(&mut rest).map_err(|error| error.to_string())?;
        Ok(Self {
            bytes,
            shape: header.shape,
            n_bytes: bytes.len() - rest.position() as usize,
        })
    }

    /// `None` if it overflows.
    pub fn n_values(&self) -> Option<usize> {
        self.shape
            .iter()
            .try_fold(1, |n: usize, &side| n.checked_mul(side))
    }

    /// Returns the values if they have type `T`. The parser allocates what the header states, so check the number of
    /// values first.
    pub fn read<T: ReadableElement>(&self) -> Option<ArrayD<T>> {
        ArrayD::<T>::read_npy(Cursor::new(self.bytes))
            .ok()
            .filter(|it| it.raw_dim() == IxDyn(&self.shape))
    }
}
