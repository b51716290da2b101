//! States files: recorded hidden states as NumPy arrays, with a description. See docs/recorded-worlds.md.
//!
//! An array's header is checked before its values are read or decompressed. The allocated memory grows with the bytes
//! that are present, not with the size that a header claims. Values are read into their final place; only an array in
//! Fortran order is copied once more.

use emberwatch_model::built_in::STATES;
use emberwatch_model::grid::Shape;
use emberwatch_model::text::{parse_problem, read_text, shortened};
use emberwatch_model::{Description, Model};
use ndarray::{Array3, ShapeBuilder};
use ndarray_npy::npy::header::Header;
use std::ffi::OsStr;
use std::fmt::Display;
use std::fs::File;
use std::io::{BufReader, Cursor, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use thiserror::Error;
use zip::ZipArchive;

pub const MAX_BYTES: u64 = 1 << 32;

/// Maximum length of an array's header. Headers written by NumPy have 128 bytes. Longer ones are refused, because many
/// nested brackets could overflow the parser's stack.
const MAX_HEADER_BYTES: usize = 512;

/// Maximum length of the end record of a zip archive: 22 bytes and a comment.
const MAX_ZIP_END_BYTES: u64 = 22 + u16::MAX as u64;

/// The axes of an array: K recorded steps, height H and width W.
type Dim = (usize, usize, usize);

#[derive(Debug)]
pub struct StatesFile {
    pub description: Description,
    /// A model with the description's states and observations but no transitions.
    pub model: Model,
    pub shape: Shape,
    pub sequences: Sequences,
}

#[derive(Debug, Default)]
pub struct Sequences {
    /// Each has shape `[K, H, W]`, row-major, with K at least 2.
    pub arrays: Vec<Array3<u8>>,
    n_states: usize,
    n_bytes: u64,
    checksum: crc32fast::Hasher,
}

#[derive(Debug, Error)]
#[error("states file {}: {problem}", shortened(path))]
pub struct StatesError {
    path: String,
    problem: String,
}

impl StatesFile {
    /// Loads the built-in states of this name, or the states file at this path.
    pub fn named(name: &str) -> Result<Self, StatesError> {
        match STATES.iter().find(|(known, ..)| *known == name) {
            Some((_, archive, description)) => Ok(read_built_in(archive, description)
                .expect("invariant: built-in states are valid (tested)")),
            None => Self::read(Path::new(name)),
        }
    }

    /// Returns the name and the description, as text, of each of the built-in recorded states.
    pub fn built_in_descriptions() -> impl Iterator<Item = (&'static str, &'static str)> {
        STATES.iter().map(|(name, _, text)| (*name, *text))
    }

    /// Reads a `.npz` or `.npy` file with its description next to it, or a folder that contains such files and one
    /// description.
    pub fn read(path: &Path) -> Result<Self, StatesError> {
        read(path).map_err(|problem| StatesError {
            path: path.display().to_string(),
            problem,
        })
    }

    fn new((description, model): (Description, Model), sequences: Sequences) -> Self {
        Self {
            description,
            model,
            shape: shape_of(&sequences.arrays[0]),
            sequences,
        }
    }
}

impl Sequences {
    /// Values of added arrays must be below `n_states`.
    pub fn new(n_states: usize) -> Self {
        Self {
            n_states,
            ..Self::default()
        }
    }

    pub fn checksum(&self) -> u32 {
        self.checksum.clone().finalize()
    }

    pub fn add_archive(&mut self, mut archive: impl Read + Seek) -> Result<(), String> {
        let n_entries = n_entries(&mut archive).map_err(|error| error.to_string())?;
        let unfit = |error| {
            format!("expected a .npz (zip) archive, got another or a damaged file ({error})")
        };
        let mut archive = ZipArchive::new(archive).map_err(unfit)?;
        let mut names: Vec<String> = archive.file_names().map(String::from).collect();
        if let Some(got) = n_entries.filter(|&n| n != names.len()) {
            let n_names = names.len();
            return Err(format!(
                "expected distinct array names, got {n_names} for {got} arrays"
            ));
        }
        names.sort_by(|a, b| bare(a).cmp(bare(b)));
        for name in &names {
            if !name.ends_with(".npy") {
                return Err(format!(
                    "expected only .npy members, got {:?}",
                    shortened(name)
                ));
            }
            let member = archive
                .by_name(name)
                .map_err(|error| format!("array {:?}: {error}", bare(name)))?;
            let n_bytes = member.size();
            self.add_array(bare(name), n_bytes, member)?;
        }
        if names.is_empty() {
            Err("expected at least one array, got none".into())
        } else {
            Ok(())
        }
    }

    /// Reads and adds one array in NumPy's format, header included, of `n_bytes` bytes.
    pub fn add_array(&mut self, name: &str, n_bytes: u64, from: impl Read) -> Result<(), String> {
        let about = |problem: String| format!("array {name:?}: {problem}");
        self.n_bytes = self.n_bytes.saturating_add(n_bytes);
        if self.n_bytes > MAX_BYTES {
            let got = self.n_bytes;
            let expected = format!("expected at most {MAX_BYTES} bytes in all arrays");
            return Err(about(format!("{expected}, got {got}")));
        }
        let array = self.read_array(n_bytes, from).map_err(about)?;
        let (n_recorded, height, width) = array.dim();
        for length in [n_recorded, height, width] {
            self.checksum.update(&(length as u64).to_le_bytes());
        }
        self.checksum.update(cells(&array));
        self.arrays.push(array);
        Ok(())
    }

    fn read_array(&self, n_bytes: u64, from: impl Read) -> Result<Array3<u8>, String> {
        let mut from = from.take(n_bytes + 1);
        let header = read_header(&mut from)?;
        let n_values = n_bytes.saturating_sub(n_bytes + 1 - from.limit());
        let dim = checked_dim(&header, n_values)?;
        self.check_dim(dim)?;
        let mut values = Vec::new();
        let read = from.read_to_end(&mut values);
        let got = read.map_err(|error| error.to_string())? as u64;
        if got != n_values {
            let got = n_bytes - n_values + got;
            return Err(format!("expected {n_bytes} bytes, got {got} or more"));
        }
        let layout = dim.set_f(header.layout.is_fortran());
        let array = Array3::from_shape_vec(layout, values)
            .expect("invariant: there are as many values as cells");
        let array = if array.is_standard_layout() {
            array
        } else {
            array.as_standard_layout().into_owned()
        };
        self.check_states(&array)?;
        Ok(array)
    }

    fn check_dim(&self, (n_recorded, height, width): Dim) -> Result<(), String> {
        let shape = Shape::new(height, width).map_err(|error| error.to_string())?;
        if n_recorded < 2 {
            return Err(format!(
                "expected at least 2 recorded steps, got {n_recorded}"
            ));
        }
        if let Some(first) = self.arrays.first().map(shape_of)
            && first != shape
        {
            return Err(format!(
                "expected {first} cells, as in the first array, got {shape}"
            ));
        }
        Ok(())
    }

    fn check_states(&self, array: &Array3<u8>) -> Result<(), String> {
        let (shape, cells) = (shape_of(array), cells(array));
        let most = cells.iter().fold(0, |most, &state| state.max(most));
        if usize::from(most) < self.n_states {
            return Ok(());
        }
        let wrong = cells.iter().position(|&state| state == most);
        let (step, cell) = (wrong.unwrap_or(0) / shape.n_cells(), wrong.unwrap_or(0));
        let cell = shape.cell(cell % shape.n_cells());
        Err(format!(
            "expected states below {}, as in the description, got {most} in cell {cell} of recorded step {step}",
            self.n_states
        ))
    }
}

fn read(path: &Path) -> Result<StatesFile, String> {
    let at = |path: &Path, error: &dyn Display| format!("{}: {error}", path.display());
    let metadata = path.metadata().map_err(|error| error.to_string())?;
    let (files, description) = if metadata.is_dir() {
        (files_of(path)?, path.join("states.toml"))
    } else {
        (vec![path.to_owned()], path.with_extension("toml"))
    };
    if let Some(other) = files
        .iter()
        .find(|file| !is_array(file) && !is_archive(file))
    {
        let expected = "expected a .npz or .npy file, or a folder of these";
        return Err(format!(
            "{expected}, got {:?}",
            other.file_name().unwrap_or_default()
        ));
    }
    let described = read_description(&description)
        .map_err(|error| format!("description {}", at(&description, &error)))?;
    let mut sequences = Sequences::new(described.1.n_states());
    for file in &files {
        let added = add_file(&mut sequences, file);
        added.map_err(|problem| {
            if file == path {
                problem
            } else {
                at(Path::new(file.file_name().unwrap_or_default()), &problem)
            }
        })?;
    }
    Ok(StatesFile::new(described, sequences))
}

fn read_built_in(archive: &[u8], description: &str) -> Result<StatesFile, String> {
    let described = described(description).map_err(|error| error.to_string())?;
    let mut sequences = Sequences::new(described.1.n_states());
    sequences.add_archive(Cursor::new(archive))?;
    Ok(StatesFile::new(described, sequences))
}

fn read_description(path: &Path) -> anyhow::Result<(Description, Model)> {
    check_regular(path).map_err(anyhow::Error::msg)?;
    described(&read_text(path)?)
}

fn described(text: &str) -> anyhow::Result<(Description, Model)> {
    let description: Result<Description, _> = toml::from_str(text);
    let description = description.map_err(|error| anyhow::anyhow!(parse_problem(error)))?;
    let model = description.unchanging()?;
    Ok((description, model))
}

fn files_of(folder: &Path) -> Result<Vec<PathBuf>, String> {
    let entries = std::fs::read_dir(folder).map_err(|error| error.to_string())?;
    let paths: Result<Vec<PathBuf>, _> = entries
        .map(|entry| entry.map(|entry| entry.path()))
        .collect();
    let mut files = paths.map_err(|error| error.to_string())?;
    files.retain(|file| is_array(file) || is_archive(file));
    files.sort();
    if files.is_empty() {
        Err("expected .npz or .npy files in the folder, got none".into())
    } else {
        Ok(files)
    }
}

fn add_file(sequences: &mut Sequences, path: &Path) -> Result<(), String> {
    let n_bytes = check_regular(path)?;
    let file = File::open(path).map_err(|error| error.to_string())?;
    if is_archive(path) {
        sequences.add_archive(BufReader::new(file))
    } else {
        let name = path.file_stem().unwrap_or_default().to_string_lossy();
        sequences.add_array(&name, n_bytes, file)
    }
}

/// Returns the length of a file, or an error if it is not a regular file: opening a pipe would block until it has a
/// writer.
fn check_regular(path: &Path) -> Result<u64, String> {
    let metadata = std::fs::metadata(path).map_err(|error| error.to_string())?;
    if metadata.is_file() {
        Ok(metadata.len())
    } else {
        Err("expected a regular file, got a folder, pipe or device".into())
    }
}

/// Reads the number of entries from the end record of an archive. This reveals duplicate names: `ZipArchive` keeps only
/// one entry per name, so it reports fewer entries. Returns `None` if there is no end record, or if its 16-bit count is
/// saturated.
fn n_entries(archive: &mut (impl Read + Seek)) -> std::io::Result<Option<usize>> {
    let n_bytes = archive.seek(SeekFrom::End(0))?;
    archive.seek(SeekFrom::Start(n_bytes.saturating_sub(MAX_ZIP_END_BYTES)))?;
    let mut end = Vec::new();
    archive.read_to_end(&mut end)?;
    let at = end.windows(4).rposition(|bytes| bytes == b"PK\x05\x06");
    let count =
        at.and_then(|at| Some(u16::from_le_bytes([*end.get(at + 10)?, *end.get(at + 11)?])));
    Ok(count.filter(|&count| count != u16::MAX).map(usize::from))
}

fn is_array(path: &Path) -> bool {
    path.extension() == Some(OsStr::new("npy"))
}

fn is_archive(path: &Path) -> bool {
    path.extension() == Some(OsStr::new("npz"))
}

fn bare(name: &str) -> &str {
    name.strip_suffix(".npy").unwrap_or(name)
}

fn shape_of(array: &Array3<u8>) -> Shape {
    let (_, height, width) = array.dim();
    Shape::new(height, width).expect("invariant: the shape was checked")
}

fn cells(array: &Array3<u8>) -> &[u8] {
    array.as_slice().expect("invariant: arrays are row-major")
}

fn read_header(from: &mut impl Read) -> Result<Header, String> {
    let mut start = Vec::new();
    let read = from.by_ref().take(12).read_to_end(&mut start);
    read.map_err(|error| error.to_string())?;
    let length = match start.strip_prefix(b"\x93NUMPY") {
        Some([1, _, low, high, ..]) => u16::from_le_bytes([*low, *high]).into(),
        Some([_, _, a, b, c, d]) => u32::from_le_bytes([*a, *b, *c, *d]),
        _ => 0,
    };
    if length as usize > MAX_HEADER_BYTES {
        return Err(format!(
            "expected a NumPy array with a header of at most {MAX_HEADER_BYTES} bytes, got {length}"
        ));
    }
    Header::from_reader(&mut start.as_slice().chain(from))
        .map_err(|error| format!("expected a NumPy array: {error}"))
}

/// Checks that an array's header fits the `n_values` bytes after it, and returns the lengths of the array's axes.
fn checked_dim(header: &Header, n_values: u64) -> Result<Dim, String> {
    let dtype = &header.type_descriptor;
    if !matches!(
        dtype.as_string().map(|name| &**name),
        Some("|u1" | "u1" | "B")
    ) {
        return Err(format!("expected dtype '|u1' (uint8), got {dtype}"));
    }
    let &[n_recorded, height, width] = &*header.shape else {
        let got = header.shape.len();
        return Err(format!("expected three axes [K, H, W], got {got}"));
    };
    let n_cells = height.checked_mul(width);
    let n_cells = n_cells.and_then(|n_cells| n_cells.checked_mul(n_recorded));
    let n_cells = n_cells
        .ok_or_else(|| format!("expected a NumPy array: too many cells, {:?}", header.shape))?
        as u64;
    if n_cells > n_values {
        let missing = n_cells - n_values;
        return Err(format!("cut short: expected {missing} more bytes"));
    }
    match n_values - n_cells {
        0 => Ok((n_recorded, height, width)),
        behind => Err(format!(
            "expected the end after the array, got {behind} more bytes"
        )),
    }
}
