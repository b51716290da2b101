//! The connected parts of an [`Airspace`]: groups of cells between which robots can move.

use super::airspace::Airspace;
use super::grid::Cell;
use super::path::Move;

const NONE: u32 = u32::MAX;

/// The free cells of an airspace by connected part. A robot never leaves the part in which it starts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Parts {
    width: usize,
    of_cells: Vec<u32>,
    sizes: Vec<usize>,
}

impl Parts {
    /// Finds the parts of an airspace, in the order of their first cells.
    pub fn of(airspace: &Airspace) -> Self {
        let shape = airspace.shape();
        let mut parts = Self {
            width: shape.width(),
            of_cells: vec![NONE; shape.n_cells()],
            sizes: Vec::new(),
        };
        for index in 0..shape.n_cells() {
            let cell = shape.cell(index);
            if parts.of_cells[index] == NONE && airspace.is_free(cell) {
                parts.add(airspace, cell);
            }
        }
        parts
    }

    /// Adds the part of a free cell: all cells that can be reached from it.
    fn add(&mut self, airspace: &Airspace, first: Cell) {
        let (shape, part) = (airspace.shape(), self.sizes.len() as u32);
        let (mut reached, mut size) = (vec![first], 1);
        self.of_cells[shape.index(first)] = part;
        while let Some(cell) = reached.pop() {
            for next in Move::ALL.map(|step| airspace.after(step, cell)) {
                let of_next = &mut self.of_cells[shape.index(next)];
                if *of_next == NONE {
                    *of_next = part;
                    size += 1;
                    reached.push(next);
                }
            }
        }
        self.sizes.push(size);
    }

    pub fn n_free(&self) -> usize {
        self.sizes.iter().sum()
    }

    pub fn n_largest(&self) -> usize {
        self.sizes.iter().copied().max().unwrap_or(0)
    }

    /// Returns the number of cells in the part of a free cell, or 0 for a no-fly cell.
    pub fn n_around(&self, cell: Cell) -> usize {
        let part = self.of_cells[cell.row * self.width + cell.col];
        self.sizes.get(part as usize).copied().unwrap_or(0)
    }

    /// Returns the row-major indices of the cells in which robots can start at random, in ascending order. These are
    /// the cells of the largest part, or of the first of several equally large parts. Empty if no move leads out of any
    /// cell.
    pub fn starts(&self) -> Vec<usize> {
        let n_largest = self.n_largest();
        let largest = self.sizes.iter().position(|&size| size == n_largest);
        let largest = largest.filter(|_| n_largest > 1).map(|part| part as u32);
        let cells = self.of_cells.iter().enumerate();
        let inside = cells.filter(|&(_, &part)| Some(part) == largest);
        inside.map(|(index, _)| index).collect()
    }
}
