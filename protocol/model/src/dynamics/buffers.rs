//! The buffers of a world's transition, which is made band by band.

use super::lanes::{LANES, high_bits, list_lanes, transposed};
use super::places::Places;
use crate::grid::Shape;
use crate::parameters::Model;
use std::ops::Range;
use std::sync::Arc;

/// The keys of a step's generators: for the bytes and for the draws.
pub(super) type Keys = [u64; 2];

/// Number of cells in a band, a multiple of [`LANES`]. Each band is finished before the next one begins, so that its
/// bytes, states and lists stay in a 32 KiB cache.
const BAND: usize = 8192;

#[derive(Debug, Clone)]
pub(super) struct Buffers {
    pub(super) places: Places,
    /// One bit per home (see `places.rs`), which is set if a cell of the grid has this home.
    on_grid: Arc<[u64]>,
    /// The marked cells of a band, each as the index of its home.
    pub(super) listed: Vec<u32>,
    pub(super) randoms: Vec<u8>,
}

impl Buffers {
    pub(super) fn new(model: &Model, shape: Shape) -> Self {
        let places = Places::new(model, shape);
        let in_band = places.next.len().min(BAND);
        Self {
            on_grid: on_grid(shape, &places).into(),
            places,
            listed: vec![0; in_band + LANES],
            randoms: vec![0; in_band * size_of::<u32>()],
        }
    }

    pub(super) fn n_bytes(model: &Model, shape: Shape) -> usize {
        let (n_places, n_homes) = Places::lengths(model, shape);
        let in_band = n_homes.min(BAND);
        n_places + n_homes + (2 * in_band + LANES) * size_of::<u32>()
    }

    pub(super) fn bands(&self) -> impl Iterator<Item = Range<usize>> + use<> {
        let n_homes = self.places.next.len();
        let bands = (0..n_homes).step_by(BAND);
        bands.map(move |first| first..n_homes.min(first + BAND))
    }

    /// Lists the homes of the cells in a band whose next state is a mark, with its high bit set. Returns their number.
    #[inline(never)] // If it were inlined, LLVM would run out of registers, and a step would take 10 % longer.
    pub(super) fn list_marked(&mut self, band: Range<usize>) -> usize {
        let (chunks, _) = self.places.next[band.clone()].as_chunks();
        let on_grid = &self.on_grid[band.start / LANES..];
        let mut n_listed = 0;
        for ((home, lanes), on_grid) in band.step_by(LANES).zip(chunks).zip(on_grid) {
            let bits = high_bits(lanes) & on_grid;
            let to = self.listed[n_listed..]
                .first_chunk_mut()
                .expect("invariant: the list is LANES longer than a band");
            list_lanes(bits, home as u32, to);
            n_listed += bits.count_ones() as usize;
        }
        n_listed
    }
}

/// Returns one bit per home, in the order of [`high_bits`], which is set if a cell of the grid has this home.
fn on_grid(shape: Shape, places: &Places) -> Vec<u64> {
    let mut bits = vec![0; places.next.len() / LANES];
    for row in 0..shape.height() {
        let first = places.home(row, 0);
        for home in first..first + shape.width() {
            bits[home / LANES] |= 1_u64 << transposed((home % LANES) as u32);
        }
    }
    bits
}
