//! Values that differ between zones, laid out for loops over [`LANES`] cells of a row at once.

use super::grid::Grid;
use super::vectors::LANES;
use std::collections::HashMap;

/// Values that depend on the zone of each cell, such as the weights of its kernel.
///
/// A *chunk* is [`LANES`] consecutive cells of a row. Chunks are numbered row by row, and the last one of a row may be
/// shorter. Chunks with the same pattern of zones share their values.
#[derive(Debug, Clone)]
pub struct ZonedNumbers<T> {
    /// Number of values per cell.
    n_numbers: usize,
    /// For each chunk, the index of its pattern of zones. Empty if all chunks have the same pattern.
    patterns: Vec<u32>,
    /// For each pattern, the lanes of each value.
    lanes: Vec<[T; LANES]>,
}

impl<T: Copy> ZonedNumbers<T> {
    /// Lays out `numbers` for the cells of a grid. Each entry of `numbers` has one value per zone.
    ///
    /// `zones` contains the zone of each cell, shape `[H, W]`. Without it, all cells are in zone 0.
    pub fn new(numbers: &[Vec<T>], zones: Option<&Grid<u8>>) -> Self {
        let (mut patterns, mut distinct) = (Vec::new(), Vec::new());
        let mut indices = HashMap::new();
        let zones = zones.filter(|_| !numbers.is_empty());
        for row in zones.iter().flat_map(|zones| zones.rows()) {
            for cells in row.to_vec().chunks(LANES) {
                let mut pattern = [0; LANES];
                pattern[..cells.len()].copy_from_slice(cells);
                let index = indices.entry(pattern).or_insert_with(|| {
                    distinct.push(pattern);
                    distinct.len() as u32 - 1
                });
                patterns.push(*index);
            }
        }
        if distinct.is_empty() {
            distinct.push([0; LANES]);
        }
        let lanes = distinct.iter().flat_map(|pattern| {
            let lanes = |by_zone: &Vec<T>| pattern.map(|zone| by_zone[usize::from(zone)]);
            numbers.iter().map(lanes)
        });
        Self {
            n_numbers: numbers.len(),
            lanes: lanes.collect(),
            patterns,
        }
    }

    /// Returns the size of its heap memory in bytes.
    pub fn memory_bytes(&self) -> usize {
        size_of_val(&*self.patterns) + size_of_val(&*self.lanes)
    }

    /// Returns the values for the cells of a chunk.
    #[inline(always)]
    pub fn of_chunk(&self, chunk: usize) -> &[[T; LANES]] {
        let pattern = self
            .patterns
            .get(chunk)
            .map_or(0, |&pattern| pattern as usize);
        &self.lanes[pattern * self.n_numbers..][..self.n_numbers]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chunks_with_the_same_zones_share_their_values() {
        let numbers = [vec![1, 2, 3], vec![4, 5, 6]];
        let zones = Grid::from_shape_fn((4, LANES + 2), |(row, _)| (row % 3) as u8);
        let zoned = ZonedNumbers::new(&numbers, Some(&zones));
        assert_eq!(zoned.of_chunk(0), [[1; LANES], [4; LANES]]);
        assert_eq!(zoned.of_chunk(0), zoned.of_chunk(6), "rows 0 and 3");
        assert_eq!(
            zoned.lanes.len(),
            2 * 5,
            "three patterns of whole chunks, two of short ones"
        );
        let alike = ZonedNumbers::new(&numbers, None);
        assert_eq!(alike.of_chunk(5), [[1; LANES], [4; LANES]]);
    }
}
