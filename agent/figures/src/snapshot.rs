//! A snapshot of one step, as in the paper: the hidden states, the observations of all cells, the observations along
//! the path, and, if there is a belief, the probability of each state.

use crate::legend::{Named, draw_legend, draw_path, draw_robot, draw_start};
use crate::palette::{Color, MUTED, sequential, unlike};
use crate::panels::{Layout, TITLE_HEIGHT};
use crate::svg::{Align, MARGIN, Point, Svg, WIDTH};
use crate::text::TextStyle;
use ndarray::ArrayView2;

/// Upper edge of the legend, below the title.
const LEGEND_TOP: f64 = 76.0;
/// Height of the colour bar below the panels.
const FOOT: f64 = 84.0;
const COLOR_BAR: f64 = 260.0;
/// Minimum side length of cells, in points, at which the path gets a white rim. The rim would hide smaller cells.
const WIDE_CELL: f64 = 12.0;

/// One step of one world, including its hidden states.
#[derive(Debug, Clone)]
pub struct Snapshot<'a> {
    pub title: String,
    /// Small text after the title.
    pub note: String,
    pub states: Vec<Named>,
    pub observations: Vec<Named>,
    /// The hidden state of each cell, shape `[H, W]`.
    pub truth: ArrayView2<'a, u8>,
    /// The observation that the sensor would make in each cell, shape `[H, W]`.
    pub observation: ArrayView2<'a, u8>,
    /// The robot's frame, shape `[H, W]`. Cells with 255, or another value without a name, were not observed.
    pub frame: ArrayView2<'a, u8>,
    /// The cells (row, column) of the robot's path, beginning with its start.
    pub path: Vec<(usize, usize)>,
    /// The name of each state, and its posterior probabilities given the frame, shape `[H, W]`.
    pub beliefs: Vec<(String, ArrayView2<'a, f32>)>,
}

impl Snapshot<'_> {
    /// Returns the page as SVG. Its height depends on the number of beliefs.
    ///
    /// # Panics
    /// If the grids differ in size.
    pub fn svg(&self) -> String {
        let n_panels = 3 + self.beliefs.len();
        let layout = Layout::new(self.truth.dim(), n_panels, (MARGIN, WIDTH - 2.0 * MARGIN));
        let unobserved = self.unobserved();
        let corner = (layout.left(), LEGEND_TOP);
        let (mut page, states) = (Svg::new(), &self.states);
        self.draw_title(&mut page, layout.left());
        let legend = draw_legend(&mut page, states, &self.observations, unobserved, corner);
        let top = LEGEND_TOP + legend + 4.0;
        self.draw_worlds(&mut page, &layout, top, unobserved);
        for (index, (state, belief)) in self.beliefs.iter().enumerate() {
            let title = format!("belief: {state}");
            draw_panel(&mut page, &layout, (3 + index, top), &title, |row, col| {
                sequential(belief[[row, col]])
            });
        }
        if !self.beliefs.is_empty() {
            draw_color_bar(&mut page, (layout.left(), top + layout.height() + 34.0));
        }
        page.finish(WIDTH, (top + layout.height() + FOOT).ceil())
    }

    /// Returns the grey for cells that were not observed.
    fn unobserved(&self) -> Color {
        let named = self.states.iter().chain(&self.observations);
        unlike(&named.map(|it| it.color).collect::<Vec<_>>())
    }

    fn draw_title(&self, page: &mut Svg, left: f64) {
        let title = TextStyle::TITLE.fit(&self.title, WIDTH / 2.0);
        page.text((left, 36.0), Align::Left, TextStyle::TITLE, &title);
        let x = left + TextStyle::TITLE.width(&title) + 16.0;
        let note = TextStyle::NOTE.fit(&self.note, WIDTH - MARGIN - x);
        page.text((x, 36.0), Align::Left, TextStyle::NOTE, &note);
    }

    fn draw_worlds(&self, page: &mut Svg, layout: &Layout, top: f64, unobserved: Color) {
        for (index, title, grid, named) in [
            (0, "truth (hidden)", &self.truth, &self.states),
            (
                1,
                "observation of every cell",
                &self.observation,
                &self.observations,
            ),
            (
                2,
                "observed along the path",
                &self.frame,
                &self.observations,
            ),
        ] {
            draw_panel(page, layout, (index, top), title, |row, col| {
                let named = named.get(usize::from(grid[[row, col]]));
                named.map_or(unobserved, |named| named.color)
            });
        }
        let corner = layout.corner(2, top);
        let centers = self.path.iter().map(|&cell| layout.center(corner, cell));
        let points: Vec<Point> = centers.collect();
        // Thin enough not to hide the colours of the cells, and thick enough to be visible.
        let width = (layout.cell_size() * 0.2).clamp(1.0, 3.0);
        let rim = if layout.cell_size() < WIDE_CELL {
            0.0
        } else {
            1.0
        };
        draw_path(page, &points, width, rim);
        let radius = (layout.cell_size() * 0.4).clamp(4.5, 9.0);
        if let (Some(&start), Some(&end)) = (points.first(), points.last()) {
            draw_start(page, start, radius * 0.8);
            draw_robot(page, end, radius * 1.2);
        }
    }
}

fn draw_panel(
    page: &mut Svg,
    layout: &Layout,
    (index, top): (usize, f64),
    title: &str,
    color: impl Fn(usize, usize) -> Color,
) {
    let corner = layout.corner(index, top);
    let title = TextStyle::STRONG.fit(title, layout.room());
    let at = (corner.0, corner.1 - TITLE_HEIGHT / 2.0);
    page.text(at, Align::Left, TextStyle::STRONG, &title);
    layout.fill(page, corner, color);
    let (width, height) = layout.panel_size();
    let to = (corner.0 + width + 1.0, corner.1 + height + 1.0);
    page.outline((corner.0 - 1.0, corner.1 - 1.0), to, 1.0, MUTED);
}

fn draw_color_bar(page: &mut Svg, (left, middle): Point) {
    let label = "belief: probability of the state";
    page.text((left, middle), Align::Left, TextStyle::LABEL, label);
    let left = left + TextStyle::LABEL.width(label) + 18.0;
    let (top, bottom) = (middle - 8.0, middle + 8.0);
    for column in 0..COLOR_BAR as usize {
        let x = left + column as f64;
        let color = sequential(column as f32 / (COLOR_BAR - 1.0) as f32);
        page.rectangle((x, top), (x + 1.0, bottom), color);
    }
    let to = (left + COLOR_BAR + 1.0, bottom + 1.0);
    page.outline((left - 1.0, top - 1.0), to, 1.0, MUTED);
    for (fraction, tick) in [
        (0.0, "0"),
        (0.25, "0.25"),
        (0.5, "0.5"),
        (0.75, "0.75"),
        (1.0, "1"),
    ] {
        let x = left + fraction * COLOR_BAR;
        page.rule((x, bottom), (x, bottom + 4.0), 1.0, MUTED);
        page.text((x, bottom + 16.0), Align::Center, TextStyle::NOTE, tick);
    }
}
