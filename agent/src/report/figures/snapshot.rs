//! One step as the paper draws it: the hidden truth, what could be seen, what was seen along the
//! path, and the belief in each state.

use super::canvas::{Align, Canvas, Point, TextStyle, draw_page};
use super::legend::{Colors, draw_entry, draw_path, draw_robot, draw_start, legend};
use super::palette::{MUTED, sequential};
use super::panels::{Layout, TITLE_ROOM};
use super::{MARGIN, WIDTH};
use crate::report::ReportError;
use ndarray::ArrayView2;
use plotters::style::RGBColor;
use protocol::{Cell, Frame, Grid, Model, Probabilities, Shape, UNOBSERVED};
use std::path::Path;

/// Upper edge of the legend, below the title.
const LEGEND_TOP: f64 = 76.0;
/// Room for the colour bar below the panels.
const FOOT: f64 = 84.0;
const COLOR_BAR: f64 = 260.0;
/// Side in points of a cell that shows its colour beside a path with a white rim.
const WIDE_CELL: f64 = 12.0;

/// One step of one world, with hindsight.
pub struct Snapshot<'a> {
    /// Names and colours of states and observations.
    pub model: &'a Model,
    /// The hidden state of each cell.
    pub truth: Grid<u8>,
    /// What the sensor would have shown of each cell.
    pub observation: Grid<u8>,
    /// What the robot saw.
    pub frame: Frame,
    /// The robot's cells, the start first.
    pub path_cells: Vec<Cell>,
    /// The belief after the frame, shape `[S, H, W]`.
    pub belief: &'a Probabilities,
    /// The step k.
    pub step: u64,
    /// Seed of the world.
    pub seed: u64,
}

/// Draws a step to a PNG file; the picture grows in height with the number of states.
///
/// # Errors
/// [`ReportError::Snapshot`] names the part that does not fit the grid or the model,
/// [`ReportError::Write`] names the file.
pub fn draw_snapshot(path: &Path, snapshot: &Snapshot<'_>) -> Result<(), ReportError> {
    let shape = check(snapshot)?;
    let colors = Colors::of(snapshot.model);
    let n_panels = 3 + snapshot.model.n_states();
    let layout = Layout::new(shape, n_panels, (MARGIN, WIDTH - 2.0 * MARGIN));
    let (legend, legend_height) = legend(snapshot.model, &colors, (layout.left(), LEGEND_TOP));
    let top = LEGEND_TOP + legend_height + 4.0;
    let height = (top + layout.height() + FOOT).ceil();
    draw_page(path, (WIDTH, height), |canvas| {
        draw_title(canvas, snapshot, shape, layout.left());
        legend.iter().for_each(|entry| draw_entry(canvas, entry));
        draw_worlds(canvas, snapshot, &layout, &colors, top);
        draw_beliefs(canvas, snapshot, &layout, top);
        draw_color_bar(canvas, (layout.left(), top + layout.height() + 34.0));
    })
}

fn check(snapshot: &Snapshot<'_>) -> Result<Shape, ReportError> {
    let (height, width) = snapshot.truth.dim();
    let n_states = snapshot.model.n_states();
    let shape = Shape::new(height, width).map_err(|error| ReportError::Snapshot {
        what: "truth",
        expected: "a grid".into(),
        got: error.to_string(),
    })?;
    let same_grid = |what, dim: (usize, usize)| {
        let got = format!("{} x {}", dim.0, dim.1);
        expect(what, dim == shape.dim(), shape.to_string(), got)
    };
    same_grid("observation", snapshot.observation.dim())?;
    same_grid("frame", snapshot.frame.values().dim())?;
    let (dim, fits) = (snapshot.belief.dim(), (n_states, height, width));
    expect(
        "belief",
        dim == fits,
        format!("shape {fits:?}"),
        format!("{dim:?}"),
    )?;
    check_values(snapshot)?;
    let off = snapshot
        .path_cells
        .iter()
        .find(|&&cell| !shape.contains(cell));
    let got = off.map_or(String::new(), Cell::to_string);
    expect(
        "path",
        off.is_none(),
        format!("cells on a {shape} grid"),
        got,
    )?;
    Ok(shape)
}

fn check_values(snapshot: &Snapshot<'_>) -> Result<(), ReportError> {
    let (n_states, n_observations) = (snapshot.model.n_states(), snapshot.model.n_observations());
    let below = |what, grid: ArrayView2<'_, u8>, n: usize, besides: Option<u8>| {
        let wrong = |value: &&u8| usize::from(**value) >= n && Some(**value) != besides;
        let found = grid.iter().find(wrong);
        let got = found.map_or(String::new(), u8::to_string);
        expect(what, found.is_none(), format!("values below {n}"), got)
    };
    below("truth", snapshot.truth.view(), n_states, None)?;
    below(
        "observation",
        snapshot.observation.view(),
        n_observations,
        None,
    )?;
    below(
        "frame",
        snapshot.frame.values(),
        n_observations,
        Some(UNOBSERVED),
    )?;
    let is_no_number = snapshot.belief.iter().find(|value| !value.is_finite());
    let got = is_no_number.map_or(String::new(), f32::to_string);
    expect(
        "belief",
        is_no_number.is_none(),
        "finite numbers".into(),
        got,
    )
}

fn expect(
    what: &'static str,
    fits: bool,
    expected: String,
    got: String,
) -> Result<(), ReportError> {
    if fits {
        return Ok(());
    }
    Err(ReportError::Snapshot {
        what,
        expected,
        got,
    })
}

fn draw_title(canvas: &mut Canvas<'_>, snapshot: &Snapshot<'_>, shape: Shape, left: f64) {
    let name = TextStyle::TITLE.fit(snapshot.model.name(), WIDTH / 2.0);
    let (step, seed) = (snapshot.step, snapshot.seed);
    let title = format!("{name}, step k = {step}");
    canvas.text((left, 36.0), Align::Left, TextStyle::TITLE, &title);
    let note = format!("world seed {seed}, {shape} cells");
    let x = left + TextStyle::TITLE.width(&title) + 16.0;
    canvas.text((x, 36.0), Align::Left, TextStyle::NOTE, &note);
}

fn draw_worlds(
    canvas: &mut Canvas<'_>,
    snapshot: &Snapshot<'_>,
    layout: &Layout,
    colors: &Colors,
    top: f64,
) {
    let at = |cell: Cell| [cell.row, cell.col];
    draw_panel(canvas, layout, (0, top), "truth (hidden)", |cell| {
        colors.states[usize::from(snapshot.truth[at(cell)])]
    });
    draw_panel(
        canvas,
        layout,
        (1, top),
        "observation of every cell",
        |cell| colors.observed(snapshot.observation[at(cell)]),
    );
    let seen = snapshot.frame.values();
    draw_panel(
        canvas,
        layout,
        (2, top),
        "observed along the path",
        |cell| colors.observed(seen[at(cell)]),
    );
    draw_flight(canvas, &snapshot.path_cells, layout, layout.corner(2, top));
}

fn draw_flight(canvas: &mut Canvas<'_>, cells: &[Cell], layout: &Layout, corner: Point) {
    let points: Vec<Point> = cells
        .iter()
        .map(|&cell| layout.center(corner, cell))
        .collect();
    // Thin against the cells, whose colours it must not hide, and never too thin to see.
    let width = (layout.cell_size() * 0.2).clamp(1.0, 3.0);
    let rim = if layout.cell_size() < WIDE_CELL {
        0.0
    } else {
        1.0
    };
    draw_path(canvas, &points, width, rim);
    let radius = (layout.cell_size() * 0.4).clamp(4.5, 9.0);
    if let (Some(&start), Some(&end)) = (points.first(), points.last()) {
        draw_start(canvas, start, radius * 0.8);
        draw_robot(canvas, end, radius * 1.2);
    }
}

fn draw_beliefs(canvas: &mut Canvas<'_>, snapshot: &Snapshot<'_>, layout: &Layout, top: f64) {
    for (state, entry) in snapshot.model.file().states.iter().enumerate() {
        let title = format!("belief: {}", entry.name);
        draw_panel(canvas, layout, (3 + state, top), &title, |cell| {
            sequential(snapshot.belief[[state, cell.row, cell.col]])
        });
    }
}

fn draw_panel(
    canvas: &mut Canvas<'_>,
    layout: &Layout,
    (index, top): (usize, f64),
    title: &str,
    color: impl Fn(Cell) -> RGBColor,
) {
    let corner = layout.corner(index, top);
    let title = TextStyle::STRONG.fit(title, layout.room());
    let at = (corner.0, corner.1 - TITLE_ROOM / 2.0);
    canvas.text(at, Align::Left, TextStyle::STRONG, &title);
    layout.fill(canvas, corner, color);
    let (width, height) = layout.panel_size();
    let from = (corner.0 - 1.0, corner.1 - 1.0);
    canvas.outline(
        from,
        (corner.0 + width + 1.0, corner.1 + height + 1.0),
        1.0,
        MUTED,
    );
}

fn draw_color_bar(canvas: &mut Canvas<'_>, (left, middle): Point) {
    let label = "belief: probability of the state";
    canvas.text((left, middle), Align::Left, TextStyle::LABEL, label);
    let left = left + TextStyle::LABEL.width(label) + 18.0;
    let (from, to) = ((left, middle - 8.0), (left + COLOR_BAR, middle + 8.0));
    let n_columns = COLOR_BAR as usize;
    for column in 0..n_columns {
        let x = left + column as f64;
        let probability = column as f32 / (n_columns - 1) as f32;
        canvas.rectangle((x, from.1), (x + 1.0, to.1), sequential(probability));
    }
    canvas.outline(
        (from.0 - 1.0, from.1 - 1.0),
        (to.0 + 1.0, to.1 + 1.0),
        1.0,
        MUTED,
    );
    for tick in ["0", "0.25", "0.5", "0.75", "1"] {
        let fraction: f64 = tick.parse().expect("invariant: ticks are numbers");
        let x = left + fraction * COLOR_BAR;
        canvas.line(&[(x, to.1), (x, to.1 + 4.0)], 1.0, MUTED);
        canvas.text((x, to.1 + 16.0), Align::Center, TextStyle::NOTE, tick);
    }
}
