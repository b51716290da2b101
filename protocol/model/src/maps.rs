//! Maps of factors that multiply the hazards of a model: the arrays of an `.npz` archive.

use super::npy::Npy;
use crate::text::shortened;
use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use ndarray::ArrayD;
use ndarray_npy::NpzWriter;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Cursor, Read};
use std::path::{Path, PathBuf};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive};

/// Maximum size of a model's archive of maps: 8 MiB.
pub const MAX_ARCHIVE_BYTES: u64 = 8 << 20;

/// Maximum number of values in all maps of a model together: 256 MiB of `f32`.
pub const MAX_MAP_VALUES: usize = 1 << 26;

/// The maps by name, each of shape `[H, W]` or `[KH, KW, H, W]`.
pub type Maps = BTreeMap<String, ArrayD<f32>>;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(
    untagged,
    deny_unknown_fields,
    expecting = "expected the name of an .npz file, or a table with its bytes as `npz`"
)]
pub enum MapsEntry {
    /// The name of an `.npz` file next to the model file.
    File(String),
    /// The compressed archive itself, with which the model can be sent to other processes.
    Packed { npz: String },
}

impl MapsEntry {
    /// Packs maps. Equal maps make equal entries.
    pub fn packed(maps: &Maps) -> Self {
        let options = SimpleFileOptions::default().compression_method(CompressionMethod::Deflated);
        let mut archive = NpzWriter::new_with_options(Cursor::new(Vec::new()), options);
        for (name, map) in maps {
            let added = archive.add_array(name.as_str(), map);
            added.expect("invariant: memory can be written");
        }
        let bytes = archive.finish().expect("invariant: memory can be written");
        Self::Packed {
            npz: BASE64.encode(bytes.into_inner()),
        }
    }

    /// Returns the maps.
    ///
    /// # Errors
    /// If the archive is damaged or too large, or its file was not loaded. The error contains the expected and the
    /// given value.
    pub fn unpack(&self) -> Result<Maps, (String, String)> {
        let npz = match self {
            Self::Packed { npz } => npz,
            Self::File(name) => {
                let expected =
                    "an archive in the model, because the model was not read from a file";
                return Err((expected.into(), format!("{:?}", shortened(name))));
            }
        };
        let broken = |problem: String| ("an .npz archive in base64".to_owned(), problem);
        let bytes = BASE64
            .decode(npz)
            .map_err(|error| broken(error.to_string()))?;
        read_archive(&bytes).map_err(broken)
    }

    /// Replaces the name of a file with its packed maps. The file is next to the model file.
    pub(super) fn read_beside(&mut self, model: &Path) -> Result<(), (PathBuf, String)> {
        let Self::File(name) = &*self else {
            return Ok(());
        };
        let path = model.with_file_name(name);
        *self = read_file(&path)
            .and_then(|bytes| read_archive(&bytes))
            .map(|maps| Self::packed(&maps))
            .map_err(|problem| (path, problem))?;
        Ok(())
    }
}

fn read_file(path: &Path) -> Result<Vec<u8>, String> {
    let words = |error: std::io::Error| error.to_string();
    let metadata = path.metadata().map_err(words)?;
    if !metadata.is_file() || metadata.len() > MAX_ARCHIVE_BYTES {
        return Err(format!(
            "expected an .npz file of at most {MAX_ARCHIVE_BYTES} bytes, got {} bytes",
            metadata.len()
        ));
    }
    let mut bytes = Vec::new();
    let file = File::open(path).map_err(words)?;
    file.take(MAX_ARCHIVE_BYTES)
        .read_to_end(&mut bytes)
        .map_err(words)?;
    Ok(bytes)
}

/// Reads all arrays of an archive. What is allocated grows with the bytes that are present, and stays below the limit.
fn read_archive(bytes: &[u8]) -> Result<Maps, String> {
    let unfit =
        |error| format!("expected an .npz (zip) archive, got another or a damaged file ({error})");
    let mut archive = ZipArchive::new(Cursor::new(bytes)).map_err(unfit)?;
    let members: Vec<String> = archive.file_names().map(String::from).collect();
    let mut maps = Maps::new();
    let mut n_left = MAX_MAP_VALUES;
    for member in members {
        let Some(name) = member.strip_suffix(".npy") else {
            return Err(format!(
                "expected only .npy members, got {:?}",
                shortened(&member)
            ));
        };
        let array = |problem: String| format!("array {:?}: {problem}", shortened(name));
        let file = archive
            .by_name(&member)
            .map_err(|error| array(error.to_string()))?;
        let mut bytes = Vec::new();
        // Each value has at most 8 bytes.
        let read = file.take(8 * n_left as u64 + 1024).read_to_end(&mut bytes);
        read.map_err(|error| array(error.to_string()))?;
        let map = numbers(&bytes, n_left).map_err(array)?;
        n_left -= map.len();
        maps.insert(name.into(), map);
    }
    Ok(maps)
}

fn numbers(bytes: &[u8], most: usize) -> Result<ArrayD<f32>, String> {
    let array = Npy::new(bytes)?;
    let n_values = array.n_values();
    match n_values {
        Some(n) if n <= most => (),
        _ => {
            return Err(format!(
                "expected at most {MAX_MAP_VALUES} values in all maps, got shape {:?}",
                array.shape
            ));
        }
    }
    if n_values.is_none_or(|n| n > array.n_bytes) {
        return Err(format!(
            "expected as many values as its header states, got shape {:?} in {} bytes",
            array.shape, array.n_bytes
        ));
    }
    let map = None
        .or_else(|| array.read::<f32>())
        .or_else(|| Some(array.read::<f64>()?.mapv(|number| number as f32)))
        .or_else(|| Some(array.read::<u8>()?.mapv(f32::from)))
        .or_else(|| Some(array.read::<bool>()?.mapv(|flag| f32::from(u8::from(flag)))))
        .or_else(|| Some(array.read::<i32>()?.mapv(|number| number as f32)))
        .or_else(|| Some(array.read::<i64>()?.mapv(|number| number as f32)));
    let map = map.ok_or("expected float32, float64, uint8, int32, int64 or bool")?;
    // A row-major copy, because NumPy also writes arrays column by column.
    Ok(map.as_standard_layout().into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array;

    fn two() -> Maps {
        let fuel = Array::from_shape_fn((3, 4), |(row, col)| (row * col) as f32 / 7.0);
        let slope =
            Array::from_shape_fn((3, 3, 3, 4), |(a, c, row, col)| (a + c * row + col) as f32);
        [("fuel", fuel.into_dyn()), ("slope", slope.into_dyn())]
            .map(|(name, map)| (name.to_owned(), map))
            .into()
    }

    #[test]
    fn packed_maps_are_the_same_maps() {
        let entry = MapsEntry::packed(&two());
        assert_eq!(entry.unpack(), Ok(two()));
        assert_eq!(entry, MapsEntry::packed(&two()));
    }

    #[test]
    fn damaged_archives_are_refused() {
        let MapsEntry::Packed { npz } = MapsEntry::packed(&two()) else {
            unreachable!("packed")
        };
        let bytes = BASE64.decode(&npz).expect("base64");
        for n in 0..bytes.len() {
            let npz = BASE64.encode(&bytes[..n]);
            assert!(MapsEntry::Packed { npz }.unpack().is_err(), "{n} bytes");
        }
        for at in 0..bytes.len() {
            let mut damaged = bytes.clone();
            damaged[at] ^= 0x55;
            let npz = BASE64.encode(damaged);
            // Whatever is damaged, nothing panics.
            let _ = MapsEntry::Packed { npz }.unpack();
        }
    }
}
