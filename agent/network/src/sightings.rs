//! The last observations of each cell of a world, and their ages: the input of the neural belief.

use crate::crop::Crop;
use emberwatch_model::frame::{Frame, UNOBSERVED};
use emberwatch_model::grid::Shape;

const SIGHTING_BYTES: usize = 5;

/// Maximum age in the features of a sighting, in steps. Older sightings have the same features.
const OLDEST: usize = 4000;

/// Numbers of steps in which the freshness of a sighting decays to `1/e`. There are several, because some worlds change
/// quickly and others slowly.
const FADING_STEPS: [f32; 3] = [10.0, 60.0, 400.0];

/// The value that a cell showed, and the step in which it was seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sighting {
    /// The observed value, or [`UNOBSERVED`] if the cell was not seen.
    pub value: u8,
    /// The step in which the cell was seen, as counted by [`Sightings`].
    pub step: u32,
}

/// The two latest sightings of each cell.
#[derive(Debug, Clone, PartialEq)]
pub struct Sightings {
    shape: Shape,
    step: u32,
    /// The last sighting of each cell and the one before, row-major.
    cells: Vec<[Sighting; 2]>,
}

/// The computation of cells' features, with a table of those that depend on an age from 0 to [`OLDEST`].
#[derive(Debug, Clone)]
pub struct Features {
    n_observations: usize,
    ages: Vec<Age>,
}

#[derive(Debug, Clone, Copy)]
struct Age {
    freshness: [f32; 3],
    logarithm: f32,
}

impl Sighting {
    const NONE: Self = Self {
        value: UNOBSERVED,
        step: 0,
    };
}

impl Sightings {
    /// Creates the sightings before the first frame.
    pub fn new(shape: Shape) -> Self {
        Self {
            shape,
            step: 0,
            cells: vec![[Sighting::NONE; 2]; shape.n_cells()],
        }
    }

    /// Returns the grid.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// Records the frame of the current step.
    pub fn see(&mut self, frame: &Frame) {
        for (cell, value) in frame.observed() {
            self.see_cell(cell, value);
        }
    }

    /// Records the value that a cell shows in the current step.
    pub fn see_cell(&mut self, cell: usize, value: u8) {
        let step = self.step;
        let [last, before] = &mut self.cells[cell];
        *before = *last;
        *last = Sighting { value, step };
    }

    /// Advances to the next step.
    pub fn pass(&mut self) {
        self.step = self.step.saturating_add(1);
    }

    /// Returns the value that a cell showed last and the number of steps since then, if it was ever seen.
    pub fn last(&self, cell: usize) -> Option<(u8, u32)> {
        let [last, _] = self.cells[cell];
        (last.value != UNOBSERVED).then(|| (last.value, self.step - last.step))
    }

    fn are_of(&self, shape: Shape, n_observations: usize) -> bool {
        let fits = |seen: &Sighting| {
            let is_value = usize::from(seen.value) < n_observations || seen.value == UNOBSERVED;
            is_value && seen.step <= self.step
        };
        self.shape == shape
            && self.cells.len() == shape.n_cells()
            && self.cells.iter().flatten().all(fits)
    }

    /// Encodes the sightings as little-endian numbers: the current step as `u32`, then for each cell the last sighting
    /// and the one before, each as its value (`u8`) and step (`u32`).
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = self.step.to_le_bytes().to_vec();
        for seen in self.cells.iter().flatten() {
            bytes.push(seen.value);
            bytes.extend(seen.step.to_le_bytes());
        }
        bytes
    }

    /// Decodes [`Self::to_bytes`]. `None` if the bytes do not fit the grid and the number of observations.
    pub fn from_bytes(bytes: &[u8], shape: Shape, n_observations: usize) -> Option<Self> {
        let (step, seen) = bytes.split_first_chunk()?;
        let (seen, []) = seen.as_chunks::<SIGHTING_BYTES>() else {
            return None;
        };
        let seen: Vec<Sighting> = seen
            .iter()
            .map(|&[value, a, b, c, d]| Sighting {
                value,
                step: u32::from_le_bytes([a, b, c, d]),
            })
            .collect();
        let (cells, []) = seen.as_chunks::<2>() else {
            return None;
        };
        let sightings = Self {
            shape,
            step: u32::from_le_bytes(*step),
            cells: cells.to_vec(),
        };
        sightings.are_of(shape, n_observations).then_some(sightings)
    }
}

impl Features {
    /// Creates the table for worlds with `n_observations` observations.
    pub fn new(n_observations: usize) -> Self {
        let age = |age: usize| Age {
            freshness: FADING_STEPS.map(|steps| (-(age as f32) / steps).exp()),
            logarithm: (age as f32).ln_1p() / 8.0,
        };
        Self {
            n_observations,
            ages: (0..=OLDEST).map(age).collect(),
        }
    }

    /// Returns the number of features of a cell. The features are, in this order:
    ///
    /// - one-hot codes of the last observation, weighted by its freshness on three time scales (3 per observation)
    /// - a one-hot code of the second-latest observation, weighted by its freshness on the middle time scale (1 per
    ///   observation)
    /// - whether the cell was never seen, the logarithm of its age, whether it is inside the grid, and the freshness of
    ///   the second-latest observation on the longest time scale
    pub fn n_channels(n_observations: usize) -> usize {
        4 * n_observations + 4
    }

    /// Writes the features of a crop's cells, `[features, rows, cols]`, to a slice of zeros.
    pub fn write(&self, sightings: &Sightings, crop: &Crop, to: &mut [f32]) {
        let [height, width] = crop.sides;
        let (rows, cols) = sightings.shape.dim();
        for row in 0..height.min(rows - crop.first[0]) {
            for col in 0..width.min(cols - crop.first[1]) {
                let cell = (crop.first[0] + row) * cols + crop.first[1] + col;
                let at = row * width + col;
                self.write_cell(sightings, cell, |feature, number| {
                    to[feature * height * width + at] = number;
                });
            }
        }
    }

    fn write_cell(&self, sightings: &Sightings, cell: usize, mut to: impl FnMut(usize, f32)) {
        let n = self.n_observations;
        let [last, before] = sightings.cells[cell].map(|seen| {
            let age = ((sightings.step - seen.step) as usize).min(OLDEST);
            let is_seen = seen.value != UNOBSERVED;
            is_seen.then(|| (usize::from(seen.value), self.ages[age]))
        });
        if let Some((value, age)) = last {
            for (at, freshness) in age.freshness.into_iter().enumerate() {
                to(at * n + value, freshness);
            }
        }
        if let Some((value, age)) = before {
            to(3 * n + value, age.freshness[1]);
            to(4 * n + 3, age.freshness[2]);
        }
        let age = last.map_or(self.ages[OLDEST], |(_, age)| age);
        to(4 * n, f32::from(last.is_none()));
        to(4 * n + 1, age.logarithm);
        to(4 * n + 2, 1.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shape() -> Shape {
        Shape::new(1, 3).expect("test shape")
    }

    /// Creates sightings in which cell 0 shows 1 at first and 0 five steps later. Cell 1 shows 2 after five steps, and
    /// cell 2 is never seen.
    fn sightings() -> Sightings {
        let mut sightings = Sightings::new(shape());
        let frame = |values| Frame::from_bytes(shape(), 3, values).expect("test frame");
        sightings.see(&frame(&[1, 255, 255]));
        (0..5).for_each(|_| sightings.pass());
        sightings.see(&frame(&[0, 2, 255]));
        (0..10).for_each(|_| sightings.pass());
        sightings
    }

    #[test]
    fn features_encode_values_ages_and_cells_off_the_grid() {
        let crop = Crop::whole(shape());
        assert_eq!((crop.sides, Features::n_channels(3)), ([4, 4], 16));
        let mut features = vec![0.0; 16 * 16];
        Features::new(3).write(&sightings(), &crop, &mut features);
        let cell = |cell: usize| -> Vec<f32> {
            let of_cell = features.iter().skip(cell).step_by(16);
            of_cell.copied().collect()
        };
        let fresh = |age: f32, steps: f32| (-age / steps).exp();
        let [a, b, c] = FADING_STEPS.map(|steps| fresh(10.0, steps));
        let log = |age: f32| age.ln_1p() / 8.0;
        let earlier = [0.0, fresh(15.0, 60.0), 0.0, 0.0];
        let last = [log(10.0), 1.0, fresh(15.0, 400.0)];
        let first = [a, 0.0, 0.0, b, 0.0, 0.0, c, 0.0, 0.0];
        assert_eq!(cell(0), [&first[..], &earlier, &last].concat());
        let second = [0.0, 0.0, a, 0.0, 0.0, b, 0.0, 0.0, c];
        let last = [log(10.0), 1.0, 0.0];
        assert_eq!(cell(1), [&second[..], &[0.0; 4], &last].concat());
        let mut never = [0.0; 16];
        (never[12], never[13], never[14]) = (1.0, log(4000.0), 1.0);
        assert_eq!(cell(2), never);
        let outside = (3..16).flat_map(cell);
        assert!(outside.into_iter().all(|number| number == 0.0));
    }

    #[test]
    fn sightings_are_restored_and_invalid_bytes_rejected() {
        let sightings = sightings();
        let bytes = sightings.to_bytes();
        let read = |bytes: &[u8]| Sightings::from_bytes(bytes, shape(), 3);
        assert_eq!(read(&bytes), Some(sightings.clone()));
        assert_eq!(sightings.last(0), Some((0, 10)));
        assert_eq!(sightings.last(2), None);
        assert_eq!(Sightings::from_bytes(&bytes, shape(), 2), None, "a value");
        let larger = Shape::new(1, 4).expect("test shape");
        assert_eq!(Sightings::from_bytes(&bytes, larger, 3), None);
        for cut in 0..bytes.len() {
            assert_eq!(read(&bytes[..cut]), None);
        }
        let mut late = bytes;
        late[5] = 16; // A step after the current one.
        assert_eq!(read(&late), None);
    }
}
