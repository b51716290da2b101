//! Maps in a model file: a number for each cell, written in the file or in a `.npy` file next to it.

use super::grid::{Grid, Shape};
use super::npy::Npy;
use crate::text::MAX_TEXT_BYTES;
use ndarray::Array2;
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "expected rows of numbers from 0 to 255, or the name of a .npy file"
)]
pub enum CellMap {
    Rows(Vec<Vec<u8>>),
    /// The name of a `.npy` file next to the model file, with shape `[H, W]` and type `uint8` or `bool`.
    File(String),
}

impl CellMap {
    /// Returns the values row by row, or `None` if their file was not loaded.
    pub fn rows(&self) -> Option<Vec<Vec<u8>>> {
        match self {
            Self::Rows(rows) => Some(rows.clone()),
            Self::File(_) => None,
        }
    }

    /// Returns the values, shape `[H, W]`.
    ///
    /// # Errors
    /// If rows differ in length, the map exceeds the largest grid, or its file was not loaded. The error contains the
    /// expected and the given value.
    pub fn grid(&self) -> Result<Grid<u8>, (String, String)> {
        let rows = match self {
            Self::Rows(rows) => rows,
            Self::File(name) => {
                let expected = "rows of numbers, because this model was not read from a file";
                return Err((expected.into(), format!("{name:?}")));
            }
        };
        let width = rows.first().map_or(0, Vec::len);
        let shape = Shape::new(rows.len(), width);
        let shape = shape.map_err(|error| ("a map of a grid".into(), error.to_string()))?;
        if let Some(got) = rows.iter().map(Vec::len).find(|&length| length != width) {
            return Err((format!("rows of {width} numbers"), got.to_string()));
        }
        let grid = Grid::from_shape_vec(shape.dim(), rows.concat());
        Ok(grid.expect("invariant: as many numbers as cells"))
    }

    /// Replaces the name of a `.npy` file with the numbers that it contains. The file is next to the model file.
    pub(super) fn read_beside(&mut self, model: &Path) -> Result<(), (PathBuf, String)> {
        let Self::File(name) = &*self else {
            return Ok(());
        };
        let path = model.with_file_name(name);
        let numbers = read_array(&path).map_err(|problem| (path, problem))?;
        *self = Self::Rows(numbers.outer_iter().map(|row| row.to_vec()).collect());
        Ok(())
    }
}

fn read_array(path: &Path) -> Result<Array2<u8>, String> {
    let words = |error: std::io::Error| error.to_string();
    let metadata = path.metadata().map_err(words)?;
    if !metadata.is_file() || metadata.len() > MAX_TEXT_BYTES {
        return Err(format!(
            "expected a .npy file of at most {MAX_TEXT_BYTES} bytes"
        ));
    }
    let mut bytes = Vec::new();
    let file = File::open(path).map_err(words)?;
    let read = file.take(MAX_TEXT_BYTES).read_to_end(&mut bytes);
    read.map_err(words)?;
    let array = Npy::new(&bytes)?;
    let is_grid = match array.shape[..] {
        [height, width] => Shape::new(height, width).is_ok_and(|it| it.n_cells() == array.n_bytes),
        _ => false,
    };
    let numbers = || {
        let flags = || Some(array.read::<bool>()?.mapv(u8::from));
        array.read::<u8>().or_else(flags)
    };
    let numbers = is_grid.then(numbers).flatten();
    let numbers = numbers.and_then(|numbers| numbers.into_dimensionality().ok());
    numbers.ok_or_else(|| {
        let (shape, n_bytes) = (&array.shape, array.n_bytes);
        format!("expected an array [H, W] of uint8 or bool, got shape {shape:?} in {n_bytes} bytes")
    })
}
