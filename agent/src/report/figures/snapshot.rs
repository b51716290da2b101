//! One step as the paper draws it: the hidden truth, what could be seen, what was seen along the
//! path, and the belief in each state.

use super::WIDTH;
use super::canvas::{Align, Canvas, Point, TextStyle, draw_page};
use super::palette::{INK, MUTED, PAPER, sequential, unlike};
use super::panels::{Layout, TITLE_ROOM};
use crate::report::ReportError;
use ndarray::ArrayView2;
use plotters::style::RGBColor;
use protocol::model::parse_color;
use protocol::{Cell, Frame, Grid, Model, Probabilities, Shape, UNOBSERVED};
use std::path::Path;

const MARGIN: f64 = 32.0;
/// Height of a line of the legend.
const LINE: f64 = 26.0;
const SWATCH: f64 = 14.0;
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

/// Colours of a model, and the grey for what was not observed.
struct Colors {
    states: Vec<RGBColor>,
    observations: Vec<RGBColor>,
    unobserved: RGBColor,
}

/// A mark of the legend.
#[derive(Debug, Clone, Copy)]
enum Mark {
    /// No mark: the heading of a group.
    Heading,
    Color(RGBColor),
    Path,
    Start,
    Robot,
}

/// A mark with its name, and where it stands.
struct Entry {
    mark: Mark,
    name: String,
    at: Point,
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
    let (legend, legend_height) = legend(snapshot.model, &colors, layout.left());
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

impl Colors {
    fn of(model: &Model) -> Self {
        let file = model.file();
        let color = |text: &String| {
            let [red, green, blue] =
                parse_color(text).expect("invariant: a model's colours are checked");
            RGBColor(red, green, blue)
        };
        let states: Vec<_> = file
            .states
            .iter()
            .map(|state| color(&state.color))
            .collect();
        let observations: Vec<_> = file.observations.iter().map(|o| color(&o.color)).collect();
        let unobserved = unlike(&[states.as_slice(), observations.as_slice()].concat());
        Self {
            states,
            observations,
            unobserved,
        }
    }

    fn observed(&self, value: u8) -> RGBColor {
        let color = self.observations.get(usize::from(value));
        color.copied().unwrap_or(self.unobserved)
    }
}

/// Entries of the legend, broken into lines, and the height of those.
fn legend(model: &Model, colors: &Colors, left: f64) -> (Vec<Entry>, f64) {
    let file = model.file();
    let states = file
        .states
        .iter()
        .map(|state| state.name.as_str())
        .zip(&colors.states);
    let observations = file
        .observations
        .iter()
        .map(|o| o.name.as_str())
        .zip(&colors.observations);
    let swatch = |(name, &color): (&str, &RGBColor)| (Mark::Color(color), name.to_string());
    let path = [
        (Mark::Color(colors.unobserved), "not observed".to_string()),
        (Mark::Path, "path".into()),
        (Mark::Start, "start".into()),
        (Mark::Robot, "robot".into()),
    ];
    let heading = |text: &str| std::iter::once((Mark::Heading, text.to_string()));
    if states.clone().eq(observations.clone()) {
        let marks = heading("state, observed value:")
            .chain(states.map(swatch))
            .chain(path);
        place(&[marks.collect()], left)
    } else {
        let states = heading("state:").chain(states.map(swatch)).collect();
        let observations = heading("observed value:").chain(observations.map(swatch));
        place(&[states, observations.chain(path).collect()], left)
    }
}

/// Places each group of marks on lines of its own.
fn place(groups: &[Vec<(Mark, String)>], left: f64) -> (Vec<Entry>, f64) {
    let mut entries = Vec::new();
    let mut middle = LEGEND_TOP;
    for group in groups {
        let mut x = left;
        for (mark, name) in group {
            let name = TextStyle::LABEL.fit(name, WIDTH - left - MARGIN - 30.0);
            let width = mark.width() + TextStyle::LABEL.width(&name);
            if x > left && x + width > WIDTH - MARGIN {
                (x, middle) = (left, middle + LINE);
            }
            entries.push(Entry {
                mark: *mark,
                name,
                at: (x, middle),
            });
            x += width + if mark.width() > 0.0 { 24.0 } else { 12.0 };
        }
        middle += LINE;
    }
    (entries, middle - LEGEND_TOP)
}

impl Mark {
    /// Width of the mark and the space behind it.
    fn width(self) -> f64 {
        match self {
            Self::Heading => 0.0,
            Self::Path => SWATCH + 16.0,
            Self::Color(_) | Self::Start | Self::Robot => SWATCH + 7.0,
        }
    }
}

fn draw_entry(canvas: &mut Canvas<'_>, entry: &Entry) {
    let (x, y) = entry.at;
    let middle = (x + SWATCH / 2.0, y);
    match entry.mark {
        Mark::Heading => {}
        Mark::Color(color) => {
            let (from, to) = ((x, y - SWATCH / 2.0), (x + SWATCH, y + SWATCH / 2.0));
            canvas.rectangle(from, to, color);
            canvas.outline(from, to, 0.5, MUTED);
        }
        Mark::Path => draw_path(canvas, &[(x + 2.0, y), (x + SWATCH + 7.0, y)], 2.0, 0.0),
        Mark::Start => draw_start(canvas, middle, 4.5),
        Mark::Robot => draw_robot(canvas, middle, 6.5),
    }
    let style = match entry.mark {
        Mark::Heading => TextStyle::LABEL.colored(MUTED),
        _ => TextStyle::LABEL,
    };
    canvas.text((x + entry.mark.width(), y), Align::Left, style, &entry.name);
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
    let corner = layout.corner(2, top);
    let points: Vec<Point> = snapshot
        .path_cells
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

/// Draws a path of straight legs, with a white rim where cells are wide enough to show beside it.
fn draw_path(canvas: &mut Canvas<'_>, points: &[Point], width: f64, rim: f64) {
    for (half, color) in [(width / 2.0 + rim, PAPER), (width / 2.0, INK)] {
        for ends in points.windows(2) {
            let ((x0, y0), (x1, y1)) = (ends[0], ends[1]);
            // A leg runs along a row or a column, so it is a rectangle, without blurred edges.
            let from = (x0.min(x1) - half, y0.min(y1) - half);
            canvas.rectangle(from, (x0.max(x1) + half, y0.max(y1) + half), color);
        }
    }
}

fn draw_start(canvas: &mut Canvas<'_>, (x, y): Point, half: f64) {
    canvas.rectangle((x - half, y - half), (x + half, y + half), INK);
    let inner = half - 1.5;
    canvas.rectangle((x - inner, y - inner), (x + inner, y + inner), PAPER);
}

fn draw_robot(canvas: &mut Canvas<'_>, center: Point, radius: f64) {
    canvas.disc(center, radius, PAPER);
    canvas.disc(center, radius - 1.0, INK);
    canvas.disc(center, radius - 2.5, PAPER);
    canvas.disc(center, (radius - 4.5).max(1.0), INK);
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
