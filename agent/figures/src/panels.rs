//! The layout of equally sized panels on a page. Each panel shows the cells of one grid, aligned to whole pixels.

use crate::palette::Color;
use crate::svg::{Run, Svg};
use std::collections::BTreeMap;

/// Pixels per point.
const SCALE: f64 = 2.0;

/// Distance between panels in points.
const GAP: f64 = 26.0;
/// Height of the title above a panel.
pub const TITLE_HEIGHT: f64 = 30.0;
/// Minimum width of a panel's column in points, so that its title fits.
const MIN_WIDTH: f64 = 190.0;
/// Target height of all panels together in points, unless panels would become lower than [`MIN_HEIGHT`].
const PAGE_HEIGHT: f64 = 860.0;
/// Minimum height of a panel in points, which takes precedence over [`PAGE_HEIGHT`].
const MIN_HEIGHT: f64 = 130.0;

/// Maximum length of a panel's longer side in points. Larger panels would not show more detail.
const MAX_SIDE: f64 = 540.0;

/// The scale of cells: pixels per cell side, or for large grids, cells per pixel side (`stride`).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Zoom {
    pixels: usize,
    stride: usize,
}

/// Panels of equal size, arranged in rows and columns.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Layout {
    shape: (usize, usize),
    columns: usize,
    n_panels: usize,
    zoom: Zoom,
    /// Left edge of the first panel in points.
    left: f64,
}

impl Layout {
    /// Returns the layout with the largest cells within `width` points. Among layouts with equally large cells, it
    /// prefers three columns, and then fewer rows.
    pub fn new(shape: (usize, usize), n_panels: usize, (left, width): (f64, f64)) -> Self {
        let most = ((width + GAP) / (MIN_WIDTH + GAP)) as usize;
        let candidates = (1..=most.clamp(1, n_panels)).map(|columns| {
            let zoom = Zoom::fitting(shape, n_panels, columns, width);
            Self {
                shape,
                columns,
                n_panels,
                zoom,
                left,
            }
        });
        let rank = |layout: &Self| {
            let size = (layout.zoom.pixels, std::cmp::Reverse(layout.zoom.stride));
            (size, layout.columns == 3, layout.columns)
        };
        let best = candidates
            .max_by_key(rank)
            .expect("invariant: one column is a candidate");
        let used = best.columns as f64 * (best.room() + GAP) - GAP;
        Self {
            left: left + (width - used).max(0.0) / 2.0,
            ..best
        }
    }

    /// Returns the height of all rows in points, including titles.
    pub fn height(&self) -> f64 {
        let rows = self.n_panels.div_ceil(self.columns) as f64;
        rows * (TITLE_HEIGHT + self.panel_size().1 + GAP) - GAP
    }

    /// Returns the width of a column, which contains a panel and its title, in points.
    pub fn room(&self) -> f64 {
        self.panel_size().0.max(MIN_WIDTH)
    }

    /// Returns the left edge of the first panel in points.
    pub fn left(&self) -> f64 {
        self.left
    }

    /// Returns the upper left corner of panel `index`, below its title. Rows begin at `top`.
    pub fn corner(&self, index: usize, top: f64) -> (f64, f64) {
        let (row, column) = (index / self.columns, index % self.columns);
        let x = self.left + column as f64 * (self.room() + GAP);
        let y = top + row as f64 * (TITLE_HEIGHT + self.panel_size().1 + GAP) + TITLE_HEIGHT;
        // Aligned to whole pixels, so that all cells have the same size.
        ((x * SCALE).round() / SCALE, (y * SCALE).round() / SCALE)
    }

    /// Returns the width and height of a panel in points.
    pub fn panel_size(&self) -> (f64, f64) {
        let points = |cells: usize| (self.zoom.n_pixels(cells)) as f64 / SCALE;
        (points(self.shape.1), points(self.shape.0))
    }

    /// Returns the side length of a cell in points.
    pub fn cell_size(&self) -> f64 {
        self.zoom.pixels as f64 / self.zoom.stride as f64 / SCALE
    }

    /// Returns the centre of a cell (row, column) in a panel at `corner`.
    pub fn center(&self, corner: (f64, f64), (row, col): (usize, usize)) -> (f64, f64) {
        let middle = |at: usize| (at as f64 + 0.5) * self.cell_size();
        (corner.0 + middle(col), corner.1 + middle(row))
    }

    /// Fills each cell (row, column) of a panel at `corner` with its colour. Large grids are downsampled by nearest
    /// neighbour, which creates no colours outside the legend.
    pub fn fill(&self, page: &mut Svg, corner: (f64, f64), color: impl Fn(usize, usize) -> Color) {
        let Zoom { pixels, stride } = self.zoom;
        let side = pixels as f64 / SCALE;
        let mut runs: BTreeMap<[u8; 3], Vec<Run>> = BTreeMap::new();
        for (down, row) in (0..self.shape.0).step_by(stride).enumerate() {
            let colors = (0..self.shape.1).step_by(stride).map(|col| color(row, col));
            let colors: Vec<Color> = colors.collect();
            let mut right = 0;
            for run in colors.chunk_by(|a, b| a == b) {
                let Color(red, green, blue) = run[0];
                let at = (
                    corner.0 + right as f64 * side,
                    corner.1 + down as f64 * side,
                );
                runs.entry([red, green, blue])
                    .or_default()
                    .push((at, run.len()));
                right += run.len();
            }
        }
        for ([red, green, blue], runs) in runs {
            page.squares(&runs, side, Color(red, green, blue));
        }
    }
}

impl Zoom {
    fn fitting(shape: (usize, usize), n_panels: usize, columns: usize, width: f64) -> Self {
        let rows = n_panels.div_ceil(columns) as f64;
        let columns = columns as f64;
        let room = (width - GAP * (columns - 1.0)) / columns * SCALE;
        let height = (PAGE_HEIGHT / rows - TITLE_HEIGHT - GAP).max(MIN_HEIGHT) * SCALE;
        let longer = shape.1.max(shape.0) as f64;
        let cell = (room / shape.1 as f64)
            .min(height / shape.0 as f64)
            .min(MAX_SIDE * SCALE / longer);
        if cell >= 1.0 {
            Self {
                pixels: cell as usize,
                stride: 1,
            }
        } else {
            Self {
                pixels: 1,
                stride: (1.0 / cell).ceil() as usize,
            }
        }
    }

    fn n_pixels(self, cells: usize) -> usize {
        cells.div_ceil(self.stride) * self.pixels
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(shape: (usize, usize), n_panels: usize, columns: usize) {
        let layout = Layout::new(shape, n_panels, (30.0, 1140.0));
        assert_eq!(layout.columns, columns, "{layout:?}");
        let (width, height) = layout.panel_size();
        assert!(
            width >= 1.0 && height >= 0.5 && width <= 1140.0,
            "{layout:?}"
        );
        let corner = layout.corner(columns - 1, 0.0);
        assert!(corner.0 >= 30.0 && corner.0 + width <= 1170.5, "{layout:?}");
    }

    #[test]
    fn panels_stay_on_the_page_for_every_grid() {
        check((64, 64), 6, 3);
        check((5, 40), 6, 2);
        check((4096, 4096), 6, 3);
        check((1, 1), 5, 3);
    }
}
