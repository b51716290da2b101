//! What a checkpoint holds: tensors, bytes and texts by name, each read back as what it must be or refused.

use crate::learning::checkpoint::problem::Problem;
use std::collections::BTreeMap;

/// Largest count: far from where one more would not fit.
const MAX_COUNT: u64 = 1 << 53;

/// Bytes of a number of 64 bits.
const WORD: usize = 8;

/// One tensor.
#[derive(Debug, Clone, PartialEq)]
pub struct Tensor {
    /// Its shape.
    pub shape: Vec<usize>,
    /// Its numbers, row-major.
    pub numbers: Vec<f32>,
}

/// A tensor of bytes: what is no 32-bit float, such as frames or counters.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Bytes {
    /// Its shape.
    pub shape: Vec<usize>,
    /// Its bytes, row-major.
    pub bytes: Vec<u8>,
}

/// The contents of a checkpoint.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Contents {
    /// By name.
    pub tensors: BTreeMap<String, Tensor>,
    /// By name, which none of the tensors has.
    pub bytes: BTreeMap<String, Bytes>,
    /// By name; among them the effective settings.
    pub texts: BTreeMap<String, String>,
}

impl Bytes {
    /// Whole numbers, little-endian, shape `[n, 8]`.
    pub fn of_counts(counts: impl IntoIterator<Item = u64>) -> Self {
        let counts = counts.into_iter().flat_map(u64::to_le_bytes);
        Self::of_rows(WORD, counts.collect())
    }

    /// Floats of 64 bits, little-endian, shape `[n, 8]`.
    pub fn of_floats(floats: impl IntoIterator<Item = f64>) -> Self {
        let floats = floats.into_iter().flat_map(f64::to_le_bytes);
        Self::of_rows(WORD, floats.collect())
    }

    /// Rows of so many bytes, shape `[n, width]`.
    ///
    /// # Panics
    /// If they are no whole rows.
    pub fn of_rows(width: usize, bytes: Vec<u8>) -> Self {
        assert_eq!(bytes.len() % width, 0, "bytes: expected whole rows");
        let shape = vec![bytes.len() / width, width];
        Self { shape, bytes }
    }
}

impl Contents {
    /// A tensor that must be there, in this shape, with finite numbers.
    ///
    /// # Errors
    /// [`Problem`] names it.
    pub fn tensor(&self, name: &str, expected: &[usize]) -> Result<&[f32], Problem> {
        let missing = || Problem::Missing(name.into());
        let Tensor { shape, numbers } = self.tensors.get(name).ok_or_else(missing)?;
        if shape != expected {
            let (name, expected, got) = (name.into(), expected.to_vec(), shape.clone());
            return Err(Problem::Shape {
                name,
                expected,
                got,
            });
        }
        match numbers.iter().find(|number| !number.is_finite()) {
            None => Ok(numbers),
            Some(got) => Err(Problem::Value {
                name: name.into(),
                expected: "finite numbers".into(),
                got: got.to_string(),
            }),
        }
    }

    /// A tensor of bytes that must be there, in this shape.
    ///
    /// # Errors
    /// [`Problem`] names it.
    pub fn bytes(&self, name: &str, expected: &[usize]) -> Result<&[u8], Problem> {
        let missing = || Problem::Missing(name.into());
        let Bytes { shape, bytes } = self.bytes.get(name).ok_or_else(missing)?;
        if shape == expected {
            return Ok(bytes);
        }
        let (name, expected, got) = (name.into(), expected.to_vec(), shape.clone());
        Err(Problem::Shape {
            name,
            expected,
            got,
        })
    }

    /// Rows of so many bytes, any number of them, that must be there.
    ///
    /// # Errors
    /// [`Problem`] names them.
    pub fn rows(&self, name: &str, width: usize) -> Result<&[u8], Problem> {
        let n_rows = self.bytes.get(name).and_then(|bytes| bytes.shape.first());
        self.bytes(name, &[n_rows.copied().unwrap_or(0), width])
    }

    /// What [`Bytes::of_counts`] made.
    ///
    /// # Errors
    /// [`Problem`] names it.
    pub fn counts(&self, name: &str) -> Result<Vec<u64>, Problem> {
        let (words, _) = self.rows(name, WORD)?.as_chunks::<WORD>();
        Ok(words.iter().map(|&word| u64::from_le_bytes(word)).collect())
    }

    /// What [`Bytes::of_floats`] made of so many finite numbers.
    ///
    /// # Errors
    /// [`Problem`] names it.
    pub fn floats(&self, name: &str, n_floats: usize) -> Result<Vec<f64>, Problem> {
        let (words, _) = self.bytes(name, &[n_floats, WORD])?.as_chunks::<WORD>();
        let floats: Vec<f64> = words.iter().map(|&word| f64::from_le_bytes(word)).collect();
        match floats.iter().find(|float| !float.is_finite()) {
            None => Ok(floats),
            Some(got) => Err(Problem::Value {
                name: name.into(),
                expected: "finite numbers".into(),
                got: got.to_string(),
            }),
        }
    }

    /// A whole number that must be there.
    ///
    /// # Errors
    /// [`Problem`] names it.
    pub fn count(&self, name: &str) -> Result<u64, Problem> {
        let text = self.texts.get(name);
        let text = text.ok_or_else(|| Problem::Missing(name.into()))?;
        let count = text.parse().ok().filter(|count| *count <= MAX_COUNT);
        count.ok_or_else(|| Problem::Value {
            name: name.into(),
            expected: format!("a whole number up to {MAX_COUNT}"),
            got: text.clone(),
        })
    }

    /// FNV-1a (Fowler, Noll, Vo) over names, shapes, numbers and texts: against damage, not malice.
    pub(super) fn digest(&self) -> String {
        let mut hash = 0xcbf2_9ce4_8422_2325_u64;
        let mut take = |bytes: &[u8]| {
            for &byte in bytes {
                hash = (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
            }
        };
        let sides = |shape: &[usize]| -> Vec<u8> {
            let sides = shape.iter();
            sides.flat_map(|&n| (n as u64).to_le_bytes()).collect()
        };
        for (name, tensor) in &self.tensors {
            take(name.as_bytes());
            take(&sides(&tensor.shape));
            tensor.numbers.iter().for_each(|n| take(&n.to_le_bytes()));
        }
        for (name, Bytes { shape, bytes }) in &self.bytes {
            take(name.as_bytes());
            take(&sides(shape));
            take(bytes);
        }
        for (name, text) in &self.texts {
            take(name.as_bytes());
            take(text.as_bytes());
        }
        format!("{hash:016x}")
    }
}
