//! Checkpoints of learners, each in one safetensors file. Weights and the optimiser's moments are named tensors.
//! Counters and estimates are encoded with bincode in the byte tensor `state`. Replay buffers and the beliefs of robots
//! are not saved: a resumed training fills and begins them again.
//!
//! A checkpoint is written to a temporary file and renamed, so that readers always find a complete file. The file
//! records its kind of learner and its format, and contains a digest that reveals damage. Equal contents produce equal
//! bytes, so training runs can be compared by the hashes of their checkpoints.

use crate::file::replace_file;
use anyhow::{Context, Result, anyhow, ensure};
use bincode::config::{Configuration, Fixint, LittleEndian};
use emberwatch_acting::config::AgentConfig;
use emberwatch_acting::learned::WorldNames;
use emberwatch_model::text::shortened;
use emberwatch_network::NamedTensor;
use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensorError, SafeTensors};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::collections::{BTreeMap, HashMap};
use std::fmt::Display;
use std::fs::File;
use std::io::Read;
use std::path::Path;
use thiserror::Error;

const KIND: &str = "emberwatch.kind";
const FORMAT: &str = "emberwatch.format";
const DIGEST: &str = "emberwatch.digest";
const SETTINGS: &str = "settings";
const WORLDS: &str = "worlds";

const STATE: &str = "state";

const FORM: Configuration<LittleEndian, Fixint> =
    bincode::config::standard().with_fixed_int_encoding();

const VERSION: &str = "6";

const MAX_BYTES: u64 = 1 << 32;

/// Maximum memory for a decoded state in bytes, so that a small file cannot exhaust memory.
const MAX_STATE_BYTES: usize = 1 << 24;

/// Maximum value of a saved counter, low enough that increments cannot overflow.
const MAX_COUNT: u64 = 1 << 53;

/// The error for a well-formed file whose contents do not match its digest.
#[derive(Debug, Error)]
#[error("expected contents with digest {expected}, got {got}: the file is damaged")]
pub struct WrongDigest {
    pub expected: String,
    pub got: String,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Tensor {
    pub shape: Vec<usize>,
    /// The values, row-major.
    pub numbers: Vec<f32>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Contents {
    pub tensors: BTreeMap<String, Tensor>,
    pub state: Vec<u8>,
    pub settings: String,
    /// The worlds in which the training ran.
    pub worlds: WorldNames,
}

impl Contents {
    /// Creates contents from tensors and a state. The settings are empty, the worlds unknown.
    pub fn new(tensors: impl IntoIterator<Item = NamedTensor>, state: &impl Serialize) -> Self {
        let tensors = tensors.into_iter();
        let tensor = |(name, shape, numbers)| (name, Tensor { shape, numbers });
        let mut contents = Self {
            tensors: tensors.map(tensor).collect(),
            state: Vec::new(),
            settings: String::new(),
            worlds: WorldNames::default(),
        };
        contents.set_state(state);
        contents
    }

    pub fn set_state(&mut self, state: &impl Serialize) {
        let state = bincode::serde::encode_to_vec(state, FORM);
        self.state = state.expect("invariant: states contain values and sequences of known length");
    }

    /// Decodes the state into the learner's type `S`.
    pub fn state<S: DeserializeOwned>(&self) -> Result<S> {
        let form = FORM.with_limit::<MAX_STATE_BYTES>();
        let decoded = bincode::serde::decode_from_slice(&self.state, form);
        let (state, length) =
            decoded.map_err(|error| wrong(STATE, "the state of its learner", error))?;
        let got = self.state.len();
        check(length == got, STATE, format!("{length} bytes"), got)?;
        Ok(state)
    }

    /// Returns the values of a tensor.
    ///
    /// # Errors
    /// If the tensor is missing, has a different shape, or contains non-finite values.
    pub fn tensor(&self, name: &str, expected: &[usize]) -> Result<Vec<f32>> {
        let tensor = self.tensors.get(name);
        let tensor = tensor.with_context(|| {
            format!("{name}: expected a tensor of shape {expected:?}, got none")
        })?;
        let (shape, got) = (format!("shape {expected:?}"), format!("{:?}", tensor.shape));
        check(tensor.shape == expected, name, shape, got)?;
        check_numbers(name, &tensor.numbers, expected.iter().product())?;
        Ok(tensor.numbers.clone())
    }

    /// Returns the tensors whose names begin with a prefix.
    pub fn part(&self, prefix: &str) -> Part<'_> {
        Part {
            contents: self,
            prefix: prefix.into(),
        }
    }

    /// Checks that no mean square is negative, because optimisers compute its square root.
    pub fn check_squares(&self) -> Result<()> {
        let ends = [".second_moment", "running_var"];
        let is_square = |name: &str| {
            name.contains("adam.second.") || ends.iter().any(|end| name.ends_with(end))
        };
        let mut squares = self.tensors.iter().filter(|(name, _)| is_square(name));
        squares.try_for_each(|(name, tensor)| {
            let least = tensor.numbers.iter().copied().fold(0.0, f32::min);
            check(least >= 0.0, name, "no negative numbers", least)
        })
    }

    pub fn settings(&self) -> Result<AgentConfig> {
        let is_there = !self.settings.is_empty();
        check(is_there, SETTINGS, "the settings of an agent", "none")?;
        let config = AgentConfig::from_toml(&self.settings);
        config.map_err(|error| wrong(SETTINGS, "the settings of an agent", error))
    }

    fn worlds_text(&self) -> String {
        if self.worlds == WorldNames::default() {
            return String::new();
        }
        serde_json::to_string(&self.worlds).expect("invariant: names can be encoded")
    }

    /// Returns a checksum of all contents. It reveals accidental damage, but not manipulation.
    pub fn digest(&self) -> String {
        let mut digest = crc32fast::Hasher::new();
        for (name, Tensor { shape, numbers }) in &self.tensors {
            digest.update(format!("{name} {shape:?} ").as_bytes());
            digest.update(&little_endian(numbers));
        }
        digest.update(&self.state);
        digest.update(self.settings.as_bytes());
        digest.update(self.worlds_text().as_bytes());
        format!("{:08x}", digest.finalize())
    }
}

/// The tensors of a checkpoint whose names have a common prefix.
#[derive(Debug, Clone)]
pub struct Part<'a> {
    contents: &'a Contents,
    prefix: String,
}

impl Part<'_> {
    /// Returns the tensors of this part whose names begin with a further prefix.
    pub fn part(&self, prefix: &str) -> Self {
        Self {
            contents: self.contents,
            prefix: format!("{}{prefix}", self.prefix),
        }
    }

    /// Returns the values of a tensor of this part, with the same checks as [`Contents::tensor`].
    pub fn tensor(&self, name: &str, expected: &[usize]) -> Result<Vec<f32>> {
        self.contents
            .tensor(&format!("{}{name}", self.prefix), expected)
    }
}

/// Writes a checkpoint for a kind of learner, completely or not at all.
///
/// # Errors
/// If the system reports an error. An existing file then remains unchanged.
pub fn write(path: &Path, kind: &str, contents: &Contents) -> Result<()> {
    let bytes = encode(kind, contents).with_context(|| named(path))?;
    replace_file(path, &bytes).with_context(|| named(path))
}

/// Reads a checkpoint. Returns its kind and its contents.
pub fn read(path: &Path) -> Result<(String, Contents)> {
    let contents = decode(&read_bytes(path)?);
    contents.with_context(|| named(path))
}

/// Reads the bytes of a checkpoint, for [`decode`].
pub fn read_bytes(path: &Path) -> Result<Vec<u8>> {
    let bytes = || {
        let found = std::fs::metadata(path)?;
        ensure!(
            found.is_file(),
            "expected a regular file, got a folder, pipe or device"
        );
        check_size(found.len())?;
        let mut bytes = Vec::new();
        File::open(path)?.take(MAX_BYTES).read_to_end(&mut bytes)?;
        Ok(bytes)
    };
    bytes().with_context(|| named(path))
}

/// Names a checkpoint in errors.
pub fn named(path: &Path) -> String {
    format!("checkpoint {}", shortened(&path.display().to_string()))
}

/// Encodes a checkpoint for a kind of learner.
pub fn encode(kind: &str, contents: &Contents) -> Result<Vec<u8>> {
    let tensors = contents.tensors.iter();
    let tensor = |(name, tensor): (&String, &Tensor)| {
        let bytes = little_endian(&tensor.numbers);
        (name.clone(), Dtype::F32, tensor.shape.clone(), bytes)
    };
    let mut all: Vec<_> = tensors.map(tensor).collect();
    let state = contents.state.clone();
    all.push((STATE.into(), Dtype::U8, vec![state.len()], state));
    let views = all.iter();
    let views = views.map(|(name, kind, shape, bytes)| {
        Ok((name, TensorView::new(*kind, shape.clone(), bytes)?))
    });
    let views = views.collect::<Result<Vec<_>, _>>().map_err(damaged)?;
    let texts = [
        (KIND, kind),
        (FORMAT, VERSION),
        (DIGEST, &contents.digest()),
        (SETTINGS, &contents.settings),
        (WORLDS, &contents.worlds_text()),
    ];
    let texts = texts.map(|(name, text)| (name.into(), text.into()));
    let mut bytes = safetensors::serialize(views, Some(HashMap::from(texts))).map_err(damaged)?;
    sort_header(&mut bytes);
    check_size(bytes.len() as u64)?;
    Ok(bytes)
}

/// Sorts the header by key, because safetensors writes metadata in the random order of a hash map. Keeps the length.
fn sort_header(file: &mut [u8]) {
    type Header = BTreeMap<String, BTreeMap<String, serde_json::Value>>;
    const WRITTEN: &str = "invariant: safetensors wrote a header of its length";
    let (length, rest) = file.split_first_chunk_mut().expect(WRITTEN);
    let header = &mut rest[..u64::from_le_bytes(*length) as usize];
    let sorted: Header = serde_json::from_slice(header).expect(WRITTEN);
    let sorted = serde_json::to_vec(&sorted).expect(WRITTEN);
    header[..sorted.len()].copy_from_slice(&sorted);
}

/// Decodes a checkpoint. Returns its kind and its contents.
pub fn decode(bytes: &[u8]) -> Result<(String, Contents)> {
    let file = SafeTensors::deserialize(bytes).map_err(damaged)?;
    let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(damaged)?;
    let mut texts = metadata.metadata().clone().unwrap_or_default();
    let kind = texts
        .remove(KIND)
        .with_context(|| format!("{KIND}: expected the name of a learner, got none"))?;
    let format = texts.remove(FORMAT);
    let got = format.as_deref().unwrap_or("none");
    ensure!(
        got == VERSION,
        "{FORMAT}: expected {VERSION}, got {}, of another release: train it again",
        shortened(got)
    );
    let mut contents = Contents::new([], &());
    contents.settings = texts.remove(SETTINGS).unwrap_or_default();
    if let Some(worlds) = texts.remove(WORLDS).filter(|text| !text.is_empty()) {
        let worlds = serde_json::from_str(&worlds);
        contents.worlds = worlds.map_err(|error| wrong(WORLDS, "names of worlds", error))?;
    }
    for (name, view) in file.iter() {
        match (name, view.dtype()) {
            (STATE, Dtype::U8) => contents.state = view.data().to_vec(),
            (_, Dtype::F32) => {
                let (numbers, _) = view.data().as_chunks();
                let numbers = numbers.iter().map(|&number| f32::from_le_bytes(number));
                let (shape, numbers) = (view.shape().to_vec(), numbers.collect());
                let tensor = Tensor { shape, numbers };
                contents.tensors.insert(name.into(), tensor);
            }
            (_, other) => return Err(wrong(name, "F32", other)),
        }
    }
    let (expected, got) = (texts.remove(DIGEST).unwrap_or_default(), contents.digest());
    ensure!(got == expected, WrongDigest { expected, got });
    Ok((kind, contents))
}

fn little_endian(numbers: &[f32]) -> Vec<u8> {
    let numbers = numbers.iter();
    numbers.flat_map(|number| number.to_le_bytes()).collect()
}

fn check_size(n_bytes: u64) -> Result<()> {
    let expected = format!("at most {MAX_BYTES} bytes");
    check(n_bytes <= MAX_BYTES, "file", expected, n_bytes)
}

fn damaged(error: SafeTensorError) -> anyhow::Error {
    anyhow!("expected a complete safetensors file, got a damaged or truncated one: {error}")
}

/// Returns an error about a field if `fits` is false.
pub fn check(fits: bool, name: &str, expected: impl Display, got: impl Display) -> Result<()> {
    ensure!(fits, wrong(name, expected, got));
    Ok(())
}

/// Creates an error about a tensor or a field of the state.
pub fn wrong(name: &str, expected: impl Display, got: impl Display) -> anyhow::Error {
    let got = got.to_string();
    let (name, got) = (shortened(name), shortened(&got));
    anyhow!("{name}: expected {expected}, got {got:#}")
}

pub fn check_counts(counts: &[(&str, u64)]) -> Result<()> {
    let expected = format!("at most {MAX_COUNT}");
    let mut counts = counts.iter();
    counts.try_for_each(|&(name, count)| check(count <= MAX_COUNT, name, &expected, count))
}

/// Checks that there are exactly `length` values, and that all of them are finite.
pub fn check_numbers<T: Copy + Into<f64>>(name: &str, numbers: &[T], length: usize) -> Result<()> {
    let mut floats = numbers.iter().map(|&number| number.into());
    let wrong = floats.find(|number: &f64| !number.is_finite());
    let got = wrong.unwrap_or(numbers.len() as f64);
    let fits = wrong.is_none() && numbers.len() == length;
    check(fits, name, format!("{length} finite numbers"), got)
}

#[cfg(test)]
mod tests;
