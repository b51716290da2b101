//! Access to the arrays in this crate's `tests/data`, which come from runs of the authors' code.

use emberwatch_model::frame::{Frame, UNOBSERVED};
use emberwatch_model::grid::Shape;
use ndarray::{Array, ArrayView2, Dimension};
use ndarray_npy::{NpzReader, ReadableElement};
use std::fs::File;

pub struct Golden(pub NpzReader<File>);

impl Golden {
    pub fn open(name: &str) -> Self {
        let path = format!("{}/tests/data/{name}.npz", env!("CARGO_MANIFEST_DIR"));
        Self(NpzReader::new(File::open(path).expect("golden file")).expect("npz"))
    }

    pub fn get<T: ReadableElement, D: Dimension>(&mut self, name: &str) -> Array<T, D> {
        let array = self.0.by_name(&format!("{name}.npy"));
        array.unwrap_or_else(|error| panic!("{name}: {error}"))
    }
}

pub fn frame_from(observations: ArrayView2<'_, u8>, mask: ArrayView2<'_, u8>) -> Frame {
    let seen = |(&value, &visited): (&u8, &u8)| if visited > 0 { value } else { UNOBSERVED };
    let bytes: Vec<u8> = observations.iter().zip(mask).map(seen).collect();
    let (height, width) = observations.dim();
    let shape = Shape::new(height, width).expect("shape");
    Frame::from_bytes(shape, 3, &bytes).expect("valid frame")
}
