//! Curves over one axis, panel under panel: how learning went.

use super::axis::{Axis, spread};
use super::canvas::{Align, Canvas, Point, TextStyle, draw_page};
use super::palette::{GRID, INK, LINES, MUTED, blend};
use super::{MARGIN, WIDTH};
use crate::report::ReportError;
use plotters::style::RGBColor;
use std::path::Path;

/// Height of a panel with its title.
const PANEL: f64 = 190.0;
/// Height of the page's title, and of the axis under the last panel.
const HEAD: f64 = 84.0;
const FOOT: f64 = 64.0;
/// Empty room under a plot.
const GAP: f64 = 22.0;
/// Room for the name of a panel, above its plot.
const TITLE: f64 = 30.0;
const LABEL_GAP: f64 = 19.0;
const LEADER: f64 = 26.0;
/// How much a band hides of what is under it.
const BAND: f64 = 0.2;
/// Room for tick labels, left of all panels alike.
const LEFT: f64 = MARGIN + 64.0;

/// How a panel's values are placed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scale {
    /// As they are, over zero.
    Linear,
    /// By their decimal logarithm; values that have none are left out.
    Logarithmic,
}

/// A named line.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    /// Its name.
    pub name: String,
    /// Its points, from the least x to the greatest.
    pub points: Vec<(f64, f64)>,
    /// Half the height of a band around it, a number a point; empty for none.
    pub errors: Vec<f64>,
}

/// Curves of one unit.
#[derive(Debug, Clone, PartialEq)]
pub struct Panel {
    /// What is drawn, with its unit.
    pub title: String,
    /// How.
    pub scale: Scale,
    /// At most eight lines; points that are not finite are left out.
    pub curves: Vec<Curve>,
}

/// A page of panels.
#[derive(Debug, Clone, PartialEq)]
pub struct Page {
    /// Its title.
    pub title: String,
    /// A line of small print under it.
    pub note: String,
    /// What the common axis counts.
    pub axis: String,
    /// From top to bottom.
    pub panels: Vec<Panel>,
}

/// Draws a page as a PNG or SVG file. Panels without a point are left out.
///
/// # Errors
/// [`ReportError::Empty`] without any point, [`ReportError::Write`] names the file.
pub fn draw_curves(path: &Path, page: &Page) -> Result<(), ReportError> {
    let panels: Vec<DrawnPanel> = page.panels.iter().filter_map(Panel::drawn).collect();
    let points = panels.iter().flat_map(DrawnPanel::points);
    let most = points.map(|point| point.0);
    let most = most.fold(0.0, f64::max);
    if panels.is_empty() {
        return Err(ReportError::Empty { what: "curves" });
    }
    let names = panels.iter().flat_map(|panel| &panel.curves);
    let names = names.map(|curve| TextStyle::LABEL.width(&curve.name));
    let right = WIDTH - MARGIN - names.fold(0.0, f64::max) - LEADER - 6.0;
    let steps = Axis::counting_to((most.ceil() as usize).max(1), 6);
    let height = HEAD + PANEL * panels.len() as f64 + FOOT;
    draw_page(path, (WIDTH, height), |canvas| {
        canvas.text((MARGIN, 36.0), Align::Left, TextStyle::TITLE, &page.title);
        canvas.text((MARGIN, 64.0), Align::Left, TextStyle::NOTE, &page.note);
        for (index, panel) in panels.iter().enumerate() {
            let top = HEAD + PANEL * index as f64;
            let plot = Plot {
                top: top + TITLE,
                bottom: top + PANEL - GAP,
                right,
                values: panel.axis(),
                steps: &steps,
            };
            canvas.text(
                (MARGIN, top + 10.0),
                Align::Left,
                TextStyle::LABEL,
                &panel.title,
            );
            plot.draw(canvas, panel);
        }
        draw_steps(canvas, &steps, right, height - FOOT - GAP, &page.axis);
    })
}

impl Panel {
    /// What can be drawn of it, with logarithms taken.
    fn drawn(&self) -> Option<DrawnPanel> {
        let curves = self
            .curves
            .iter()
            .filter_map(|curve| curve.drawn(self.scale));
        let curves: Vec<Drawn> = curves.take(LINES.len()).collect();
        (!curves.is_empty()).then(|| DrawnPanel {
            title: self.title.clone(),
            scale: self.scale,
            curves,
        })
    }
}

impl Curve {
    /// A curve without a band.
    pub fn new(name: &str, points: Vec<(f64, f64)>) -> Self {
        Self {
            name: name.into(),
            points,
            errors: Vec::new(),
        }
    }

    /// What can be drawn of it; a band ends where its scale does.
    fn drawn(&self, scale: Scale) -> Option<Drawn> {
        let errors = self.errors.iter().copied().map(Some);
        let errors = errors.chain(std::iter::repeat(None));
        let (mut points, mut band) = (Vec::new(), Vec::new());
        for (&(x, y), error) in self.points.iter().zip(errors) {
            let at = scale.place(y);
            if x.is_finite() && at.is_finite() {
                points.push((x, at));
                let edges = error.map(|error| [y - error, y + error].map(|y| scale.place(y)));
                let edges = edges.filter(|edges| edges.iter().all(|edge| edge.is_finite()));
                band.extend(edges.map(|edges| (x, edges)));
            }
        }
        let name = self.name.clone();
        (!points.is_empty()).then_some(Drawn { name, points, band })
    }
}

impl Scale {
    fn place(self, y: f64) -> f64 {
        match self {
            Self::Linear => y,
            Self::Logarithmic => y.log10(),
        }
    }
}

/// A curve whose every number can be drawn, logarithms taken.
struct Drawn {
    name: String,
    points: Vec<(f64, f64)>,
    /// Lower and upper edge of the band.
    band: Vec<(f64, [f64; 2])>,
}

/// Curves that can be drawn.
struct DrawnPanel {
    title: String,
    scale: Scale,
    curves: Vec<Drawn>,
}

impl DrawnPanel {
    /// Of curves and bands.
    fn points(&self) -> impl Iterator<Item = (f64, f64)> + '_ {
        let edges = |&(x, edges): &(f64, [f64; 2])| edges.map(|edge| (x, edge));
        let band = move |curve: &Drawn| curve.band.iter().flat_map(edges).collect::<Vec<_>>();
        let points = |curve: &Drawn| curve.points.clone();
        self.curves
            .iter()
            .flat_map(move |curve| [points(curve), band(curve)].concat())
    }

    fn axis(&self) -> Axis {
        let values = self.points().map(|point| point.1);
        match self.scale {
            Scale::Linear => Axis::covering(values, 4),
            Scale::Logarithmic => Axis::of_powers(values),
        }
    }

    fn label(&self, axis: &Axis, tick: f64) -> String {
        match self.scale {
            Scale::Linear => axis.label(tick),
            Scale::Logarithmic => format!("1e{tick:.0}"),
        }
    }
}

/// Where a panel's plot is.
struct Plot<'a> {
    top: f64,
    bottom: f64,
    right: f64,
    values: Axis,
    steps: &'a Axis,
}

impl Plot<'_> {
    fn place(&self, (x, y): (f64, f64)) -> Point {
        let across = LEFT + self.steps.fraction(x) * (self.right - LEFT);
        let down = self.bottom - self.values.fraction(y) * (self.bottom - self.top);
        (across, down)
    }

    fn draw_band(&self, canvas: &mut Canvas<'_>, band: &[(f64, [f64; 2])], color: RGBColor) {
        let lower = band.iter().map(|&(x, [lower, _])| self.place((x, lower)));
        let upper = band
            .iter()
            .rev()
            .map(|&(x, [_, upper])| self.place((x, upper)));
        let area: Vec<Point> = lower.chain(upper).collect();
        if area.len() > 3 {
            canvas.veil(&area, color, BAND);
        }
    }

    fn draw(&self, canvas: &mut Canvas<'_>, panel: &DrawnPanel) {
        for &tick in &self.values.ticks {
            let (_, y) = self.place((0.0, tick));
            let is_zero = tick == 0.0 && panel.scale == Scale::Linear;
            let color = if is_zero { INK } else { GRID };
            canvas.line(&[(LEFT, y), (self.right, y)], 1.0, color);
            let label = panel.label(&self.values, tick);
            canvas.text((LEFT - 10.0, y), Align::Right, TextStyle::NOTE, &label);
        }
        let mut ends = Vec::new();
        for (curve, &color) in panel.curves.iter().zip(&LINES) {
            self.draw_band(canvas, &curve.band, color);
            let points: Vec<Point> = curve
                .points
                .iter()
                .map(|&point| self.place(point))
                .collect();
            canvas.line(&points, 1.5, color);
            ends.extend(points.last().copied());
        }
        let heights: Vec<f64> = ends.iter().map(|end| end.1).collect();
        let heights = spread(&heights, LABEL_GAP, (self.top, self.bottom));
        let named = panel
            .curves
            .iter()
            .zip(&LINES)
            .zip(ends.into_iter().zip(heights));
        for ((curve, &color), (end, height)) in named {
            let name = self.right + LEADER;
            let bend = (self.right + 6.0, end.1);
            canvas.line(&[end, bend, (name - 6.0, height)], 1.0, color);
            let style = TextStyle::LABEL.colored(blend(color, INK, 0.35));
            canvas.text((name, height), Align::Left, style, &curve.name);
        }
    }
}

fn draw_steps(canvas: &mut Canvas<'_>, steps: &Axis, right: f64, y: f64, label: &str) {
    for &tick in &steps.ticks {
        let x = LEFT + steps.fraction(tick) * (right - LEFT);
        canvas.line(&[(x, y), (x, y + 5.0)], 1.0, MUTED);
        canvas.text(
            (x, y + 18.0),
            Align::Center,
            TextStyle::NOTE,
            &steps.label(tick),
        );
    }
    let center = ((LEFT + right) / 2.0, y + 44.0);
    canvas.text(center, Align::Center, TextStyle::LABEL, label);
}
