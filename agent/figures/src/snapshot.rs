//! One step as the paper draws it: the hidden truth, what could be seen, what was seen along the
//! path, and the belief in each state.

use crate::legend::{Legend, Named, draw_path, draw_robot, draw_start};
use crate::palette::{Color, MUTED, sequential, unlike};
use crate::panels::{Layout, TITLE_ROOM};
use crate::svg::{Align, MARGIN, Point, Svg, WIDTH};
use crate::text::TextStyle;
use ndarray::{ArrayView2, ArrayView3};
use thiserror::Error;

/// Value of a cell in which nothing was observed.
const UNOBSERVED: u8 = 255;
/// Upper edge of the legend, below the title.
const LEGEND_TOP: f64 = 76.0;
/// Room for the colour bar below the panels.
const FOOT: f64 = 84.0;
const COLOR_BAR: f64 = 260.0;
/// Side in points of a cell that shows its colour beside a path with a white rim.
const WIDE_CELL: f64 = 12.0;

/// One step of one world, with hindsight.
#[derive(Debug, Clone)]
pub struct Snapshot<'a> {
    /// What is shown.
    pub title: String,
    /// What else is said of it.
    pub note: String,
    /// The states.
    pub states: Vec<Named>,
    /// The observations.
    pub observations: Vec<Named>,
    /// The hidden state of each cell, shape `[H, W]`.
    pub truth: ArrayView2<'a, u8>,
    /// What the sensor would have shown of each cell, shape `[H, W]`.
    pub observation: ArrayView2<'a, u8>,
    /// What the robot saw, 255 where that is nothing, shape `[H, W]`.
    pub frame: ArrayView2<'a, u8>,
    /// The robot's cells (row, column), the start first.
    pub path: Vec<(usize, usize)>,
    /// The belief after the frame, shape `[S, H, W]`.
    pub belief: ArrayView3<'a, f32>,
}

/// A part of a snapshot that does not fit the others.
#[derive(Debug, Clone, Error, PartialEq, Eq)]
#[error("snapshot: {what}: expected {expected}, got {got}")]
pub struct Misfit {
    what: &'static str,
    expected: String,
    got: String,
}

impl Snapshot<'_> {
    /// The page as SVG; it grows in height with the number of states.
    ///
    /// # Errors
    /// Names the part that does not fit the truth's grid, the states or the observations.
    pub fn svg(&self) -> Result<String, Misfit> {
        self.check()?;
        let n_panels = 3 + self.states.len();
        let layout = Layout::new(self.truth.dim(), n_panels, (MARGIN, WIDTH - 2.0 * MARGIN));
        let unobserved = self.unobserved();
        let corner = (layout.left(), LEGEND_TOP);
        let legend = Legend::new(&self.states, &self.observations, unobserved, corner);
        let top = LEGEND_TOP + legend.height() + 4.0;
        let mut page = Svg::new(WIDTH, (top + layout.height() + FOOT).ceil());
        self.draw_title(&mut page, layout.left());
        legend.draw(&mut page);
        self.draw_worlds(&mut page, &layout, top);
        for (state, entry) in self.states.iter().enumerate() {
            let title = format!("belief: {}", entry.name);
            draw_panel(&mut page, &layout, (3 + state, top), &title, |row, col| {
                sequential(self.belief[[state, row, col]])
            });
        }
        draw_color_bar(&mut page, (layout.left(), top + layout.height() + 34.0));
        Ok(page.finish())
    }

    fn check(&self) -> Result<(), Misfit> {
        let (n_states, n_observations) = (self.states.len(), self.observations.len());
        let (height, width) = self.truth.dim();
        expect("truth", self.truth.is_empty(), "cells", || "none".into())?;
        let expected = format!("shape {:?}", [height, width]);
        for (what, grid) in [("observation", &self.observation), ("frame", &self.frame)] {
            let shape = grid.shape();
            expect(what, grid.dim() != self.truth.dim(), &expected, || {
                format!("{shape:?}")
            })?;
        }
        let (shape, fits) = (self.belief.shape(), [n_states, height, width]);
        expect("belief", shape != fits, &format!("shape {fits:?}"), || {
            format!("{shape:?}")
        })?;
        let below = |what, grid: ArrayView2<'_, u8>, n: usize, besides: Option<u8>| {
            let wrong = |value: &u8| usize::from(*value) >= n && Some(*value) != besides;
            let found = grid.iter().copied().find(|value| wrong(value));
            let expected = format!("values below {n}");
            expect(what, found.is_some(), &expected, || {
                format!("{}", found.unwrap_or(0))
            })
        };
        below("truth", self.truth, n_states, None)?;
        below("observation", self.observation, n_observations, None)?;
        below("frame", self.frame, n_observations, Some(UNOBSERVED))?;
        let wrong = self.belief.iter().find(|value| !value.is_finite());
        expect("belief", wrong.is_some(), "finite numbers", || {
            format!("{wrong:?}")
        })?;
        let off = self
            .path
            .iter()
            .find(|cell| cell.0 >= height || cell.1 >= width);
        let expected = format!("cells of a {height} x {width} grid");
        expect("path", off.is_some(), &expected, || format!("{off:?}"))
    }

    /// A grey for what was not observed.
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

    fn draw_worlds(&self, page: &mut Svg, layout: &Layout, top: f64) {
        draw_panel(page, layout, (0, top), "truth (hidden)", |row, col| {
            self.states[usize::from(self.truth[[row, col]])].color
        });
        let unobserved = self.unobserved();
        let color = |value: u8| self.observations.get(usize::from(value)).map(|it| it.color);
        let observed = |value| color(value).unwrap_or(unobserved);
        for (index, title, grid) in [
            (1, "observation of every cell", &self.observation),
            (2, "observed along the path", &self.frame),
        ] {
            let at = (index, top);
            draw_panel(page, layout, at, title, |row, col| {
                observed(grid[[row, col]])
            });
        }
        let corner = layout.corner(2, top);
        let centers = self.path.iter().map(|&cell| layout.center(corner, cell));
        let points: Vec<Point> = centers.collect();
        // Thin against the cells, whose colours it must not hide, and never too thin to see.
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

fn expect(
    what: &'static str,
    is_wrong: bool,
    expected: &str,
    got: impl FnOnce() -> String,
) -> Result<(), Misfit> {
    match is_wrong {
        true => Err(Misfit {
            what,
            expected: expected.into(),
            got: got(),
        }),
        false => Ok(()),
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
    let at = (corner.0, corner.1 - TITLE_ROOM / 2.0);
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
