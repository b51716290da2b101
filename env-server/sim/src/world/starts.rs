//! The cells where robots start, and the number of free cells that they can reach from there.

use emberwatch_model::Parts;
use emberwatch_model::settings::Start;
use emberwatch_model::{Airspace, Cell, Shape};
use std::collections::BTreeSet;
use std::fmt::{Display, Formatter};

/// The number of free cells, and of those that robots cannot reach because of no-fly cells.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Reach {
    pub n_free: usize,
    /// Number of free cells outside the largest connected part. Random starts lie only inside that part.
    pub n_cut_off: usize,
    /// The fixed starts outside the largest connected part.
    pub closed_in: Vec<ClosedIn>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClosedIn {
    cell: Cell,
    n_reached: usize,
    n_free: usize,
}

impl Reach {
    /// Checks that `n_robots` robots can start in an airspace and leave their start cells.
    ///
    /// # Errors
    /// If a start is a no-fly cell or cannot be left. The error contains the texts after "expected" and "got".
    pub fn of(start: Start, airspace: &Airspace, n_robots: usize) -> Result<Self, [String; 2]> {
        if airspace.is_open() {
            let n_free = airspace.shape().n_cells();
            return Ok(Self {
                n_free,
                ..Self::default()
            });
        }
        let parts = Parts::of(airspace);
        if parts.n_largest() < 2 {
            let got = "a no-fly map that leaves no two adjacent free cells".into();
            return Err(["a cell that robots can leave".into(), got]);
        }
        let n_free = parts.n_free();
        let places = (0..n_robots).filter_map(|robot| fixed_start(start, airspace.shape(), robot));
        let mut closed_in = Vec::new();
        for cell in places.collect::<BTreeSet<Cell>>() {
            let n_reached = parts.n_around(cell);
            if n_reached == 0 {
                let got = format!("{cell}, a no-fly cell");
                return Err(["a cell where robots may be".into(), got]);
            }
            if n_reached == 1 {
                let got = format!("{cell}, which no-fly cells cut off");
                return Err(["a cell that robots can leave".into(), got]);
            }
            if n_reached < parts.n_largest() {
                closed_in.push(ClosedIn {
                    cell,
                    n_reached,
                    n_free,
                });
            }
        }
        Ok(Self {
            n_free,
            n_cut_off: n_free - parts.n_largest(),
            closed_in,
        })
    }

    /// Describes the share of free cells that robots with random starts cannot reach. Returns `None` if they reach all.
    pub fn cut_off(&self) -> Option<String> {
        let Self {
            n_free, n_cut_off, ..
        } = *self;
        let percent = 100.0 * n_cut_off as f64 / n_free as f64;
        (n_cut_off > 0).then(|| {
            format!(
                "no-fly cells cut off {n_cut_off} of {n_free} free cells ({percent:.2} %) from the largest connected \
                 part, in which random starts lie"
            )
        })
    }
}

impl Display for ClosedIn {
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        let Self {
            cell,
            n_reached,
            n_free,
        } = self;
        write!(
            f,
            "start: no-fly cells enclose {cell}: robots that start there reach {n_reached} of {n_free} free cells; \
             choose another start, or free cells in the map `no_fly`"
        )
    }
}

/// Returns the row-major indices of the cells from which random starts are drawn, or `None` for all cells of the grid.
pub(super) fn random_starts(airspace: &Airspace) -> Option<Vec<usize>> {
    (!airspace.is_open()).then(|| Parts::of(airspace).starts())
}

pub(super) fn fixed_start(start: Start, shape: Shape, robot: usize) -> Option<Cell> {
    match start {
        Start::Corner => Some(corner_or_side(shape, robot)),
        Start::Centre => Some(shape.centre()),
        Start::Random => None,
        Start::At(cell) => Some(cell),
    }
}

/// Returns a corner of the grid or the middle of a side. The first eight robots get different cells.
fn corner_or_side(shape: Shape, robot: usize) -> Cell {
    let (bottom, right) = (shape.height() - 1, shape.width() - 1);
    let places = [
        (0, 0),
        (bottom, right),
        (0, right),
        (bottom, 0),
        (0, right / 2),
        (bottom, right / 2),
        (bottom / 2, 0),
        (bottom / 2, right),
    ];
    let (row, col) = places[robot % places.len()];
    Cell { row, col }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::Rules;
    use emberwatch_model::randomness::{Purpose, stream};
    use emberwatch_model::{CellMap, Model};
    use rand::RngExt;

    /// Returns a model whose rows of no-fly cells are marked by `#`.
    fn model(rows: &str) -> Model {
        let of_row = |row: &str| row.bytes().map(|it| u8::from(it == b'#')).collect();
        let mut file = Model::wildfire().file().clone();
        file.no_fly = Some(CellMap::Rows(rows.split(' ').map(of_row).collect()));
        Model::new(file).expect("a model")
    }

    #[test]
    fn enclosed_fixed_starts_are_named_with_the_cells_they_reach() {
        let shape = Shape::new(3, 6).expect("a shape");
        let pocket = model("..#... ###... ......").airspace(shape);
        let pocket = pocket.expect("the grid");
        let reach = |start| Reach::of(start, &pocket, 2).expect("a start that can be left");
        let corner = reach(Start::Corner);
        assert_eq!((corner.n_free, corner.n_cut_off), (14, 2));
        assert_eq!(corner.closed_in.len(), 1, "the other corner is outside");
        for (said, words) in [
            (corner.closed_in[0].to_string(), "(0, 0)"),
            (corner.closed_in[0].to_string(), "reach 2 of 14 free cells"),
            (
                corner.cut_off().expect("a share"),
                "2 of 14 free cells (14.29 %)",
            ),
        ] {
            assert!(said.contains(words), "{said}");
        }
        assert!(reach(Start::Centre).closed_in.is_empty());
        assert!(reach(Start::Random).closed_in.is_empty());
        let open = Reach::of(Start::Corner, &Airspace::open(shape), 2);
        assert_eq!(open.map(|it| it.cut_off()), Ok(None));
    }

    #[test]
    fn starts_that_no_robot_can_leave_are_refused() {
        let shape = Shape::new(3, 6).expect("a shape");
        for (rows, start, expected, got) in [
            (
                "#..... ...... ......",
                Start::Corner,
                "robots may be",
                "(0, 0), a no-fly",
            ),
            (
                ".#.... #..... ......",
                Start::Corner,
                "can leave",
                "(0, 0), which no-fly",
            ),
            (
                "#.#.#. .#.#.# #.#.#.",
                Start::Random,
                "can leave",
                "no two adjacent",
            ),
        ] {
            let airspace = model(rows).airspace(shape).expect("the grid");
            let refused = Reach::of(start, &airspace, 1).expect_err(got);
            assert!(
                refused[0].contains(expected) && refused[1].contains(got),
                "{refused:?}"
            );
        }
    }

    #[test]
    fn random_starts_on_a_connected_map_are_all_free_cells() {
        let rows = ".#.... .####. ......";
        let shape = Shape::new(3, 6).expect("a shape");
        let rules = Rules::new(&model(rows), shape, 0, 0, Start::Random).expect("rules");
        let cells = rows.replace(' ', "");
        let free: Vec<usize> = cells.match_indices('.').map(|(at, _)| at).collect();
        for (seed, robot) in (0..200).zip([0, 1].into_iter().cycle()) {
            let mut stream = stream(seed, Purpose::Start, robot as u64);
            let expected = shape.cell(free[stream.random_range(0..free.len())]);
            assert_eq!(rules.start_cell(seed, robot), expected);
        }
    }
}
