//! A robot's path: [`Move`]s from a start cell to the cells flown over (paper eq. 12).

use super::grid::{Cell, Shape};
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Maximum number of moves in a path: 4096.
pub const MAX_MOVES: usize = 4096;

/// A move of the robot to a neighbouring cell, an element of the paper's set `V`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[repr(u8)]
pub enum Move {
    /// Row - 1.
    Up = 0,
    /// Row + 1.
    Down = 1,
    /// Column - 1.
    Left = 2,
    /// Column + 1.
    Right = 3,
}

/// The result of flying a path: the visited cells and the robot's last cell.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Flight {
    /// Row-major indices of the distinct cells flown over, in the order of the first visit. The start cell is among
    /// them only if the path returns to it, or if a move off the grid or into a no-fly cell leaves the robot there.
    pub visited: Vec<usize>,
    /// The robot's last cell.
    pub end: Cell,
}

/// The error for a byte that is not a move.
#[derive(Debug, Error, PartialEq, Eq)]
#[error("move {index} of the path: expected 0 (up), 1 (down), 2 (left) or 3 (right), got {value}")]
pub struct MoveError {
    pub index: usize,
    pub value: u8,
}

impl Move {
    /// All moves, in the order of their wire values.
    pub const ALL: [Self; 4] = [Self::Up, Self::Down, Self::Left, Self::Right];

    /// Returns the cell reached from `cell`. A move off the grid leaves the robot in place.
    pub fn apply(self, cell: Cell, shape: Shape) -> Cell {
        // The change in row and column, plus one. It is a table because the processor cannot predict a branch on a
        // random move: with a `match`, 64 random moves took 0.4 us.
        const STEPS: [[usize; 2]; 4] = [[0, 1], [2, 1], [1, 0], [1, 2]];
        let [down, right] = STEPS[self as usize];
        Cell {
            row: (cell.row + down).saturating_sub(1).min(shape.height() - 1),
            col: (cell.col + right).saturating_sub(1).min(shape.width() - 1),
        }
    }

    /// Decodes one move from two random or packed bits; higher bits are ignored.
    pub fn from_low_bits(bits: u64) -> Self {
        Self::ALL[(bits & 3) as usize]
    }
}

impl TryFrom<u8> for Move {
    type Error = u8;

    fn try_from(value: u8) -> Result<Self, u8> {
        Self::ALL.get(usize::from(value)).copied().ok_or(value)
    }
}

/// Decodes a path from its wire bytes, one byte per move.
///
/// # Errors
/// [`MoveError`] names the first byte that is not a move.
pub fn path_from_bytes(bytes: &[u8]) -> Result<Vec<Move>, MoveError> {
    check_moves(bytes)?;
    let moves = bytes.iter().map(|&byte| Move::from_low_bits(byte.into()));
    Ok(moves.collect())
}

/// Checks that each byte is a move.
///
/// # Errors
/// [`MoveError`] names the first byte that is not a move.
pub fn check_moves(bytes: &[u8]) -> Result<(), MoveError> {
    let is_wrong = |byte: &u8| usize::from(*byte) >= Move::ALL.len();
    // One pass without branches, which the compiler turns into vector code.
    if bytes.iter().fold(false, |any, byte| any | is_wrong(byte))
        && let Some(index) = bytes.iter().position(is_wrong)
    {
        let value = bytes[index];
        return Err(MoveError { index, value });
    }
    Ok(())
}

/// Encodes a path, one byte per move.
pub fn path_to_bytes(path: &[Move]) -> Vec<u8> {
    path.iter().map(|&m| m as u8).collect()
}

/// Flies a path from `start` over a grid without no-fly cells (paper eq. 12).
pub fn fly(shape: Shape, start: Cell, path: &[Move]) -> Flight {
    let mut visited = Vec::new();
    let after = |step: Move, cell| step.apply(cell, shape);
    let end = fly_by(after, shape, start, path, (&mut visited, &mut Vec::new()));
    Flight { visited, end }
}

/// Flies a path. `after` returns the cell that a move leads to. Writes the visited cells to the first vector. The
/// second vector is a scratch buffer. Returns the robot's last cell.
#[inline]
pub(super) fn fly_by(
    after: impl Fn(Move, Cell) -> Cell,
    shape: Shape,
    start: Cell,
    path: &[Move],
    (visited, seen): (&mut Vec<usize>, &mut Vec<u64>),
) -> Cell {
    seen.clear();
    seen.resize(shape.n_cells().div_ceil(64), 0);
    visited.resize(path.len(), 0);
    let (mut n_visited, mut cell) = (0, start);
    for &step in path {
        cell = after(step, cell);
        let index = shape.index(cell);
        // Branch-free, because the processor cannot predict whether a random path has visited this cell before.
        let (word, bit) = (&mut seen[index / 64], index % 64);
        visited[n_visited] = index;
        n_visited += usize::from(*word >> bit & 1 == 0);
        *word |= 1 << bit;
    }
    visited.truncate(n_visited);
    cell
}
