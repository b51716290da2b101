//! Panels of curves over a common axis, with error bands, and names at the ends of the curves.

use crate::axis::{Axis, is_drawable, spread};
use crate::palette::{Color, GRID, INK, LINES, MUTED, SHADE, blend};
use crate::svg::{Align, MARGIN, Point, Svg, WIDTH};
use crate::text::TextStyle;

/// Maximum number of curves per panel: the number of available colours.
pub const MAX_CURVES: usize = LINES.len();

/// Heights of a panel including its title: if there are several panels, and if there is only one.
const PANEL: f64 = 190.0;
const ONLY_PANEL: f64 = 556.0;
/// Height of the page's title, and of the axis below the last panel.
const HEAD: f64 = 84.0;
const FOOT: f64 = 64.0;
/// Height of the gap below a plot.
const GAP: f64 = 22.0;
/// Height of a panel's title above its plot.
const TITLE: f64 = 30.0;
/// Minimum distance between names, and length of the line from a curve's end to its name.
const LABEL_GAP: f64 = 20.0;
const LEADER: f64 = 28.0;
/// Maximum width of a name. Longer names are shortened.
const MAX_LABEL_WIDTH: f64 = 230.0;
/// Opacity of an error band.
const BAND: f64 = 0.18;
/// Maximum share of the plot's height for the shaded background.
const SHADE_HEIGHT: f64 = 0.4;

#[derive(Debug, Clone, PartialEq)]
pub struct Lines {
    pub title: String,
    /// A line of small print below the title.
    pub note: String,
    /// Label of the common axis, which starts at zero.
    pub axis: String,
    /// Panels from top to bottom. Panels without points are omitted.
    pub panels: Vec<Panel>,
}

/// Curves that share a unit.
#[derive(Debug, Clone, PartialEq)]
pub struct Panel {
    /// The quantity, with its unit.
    pub title: String,
    pub scale: Scale,
    /// At most [`MAX_CURVES`] curves. Further curves are omitted.
    pub curves: Vec<Curve>,
    pub shade: Option<Shade>,
}

/// The scale of a panel's values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scale {
    Linear,
    /// Base-10 logarithmic. Values that are not positive are omitted.
    Logarithmic,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    pub name: String,
    /// Points in order of x. Non-finite points are omitted.
    pub points: Vec<(f64, f64)>,
    /// Half the height of the error band at each point. Empty if there is no band.
    pub errors: Vec<f64>,
}

/// A shaded area above the axis, with a separate scale.
#[derive(Debug, Clone, PartialEq)]
pub struct Shade {
    pub name: String,
    pub points: Vec<(f64, f64)>,
}

impl Curve {
    pub fn new(name: &str, points: Vec<(f64, f64)>) -> Self {
        Self {
            name: name.into(),
            points,
            errors: Vec::new(),
        }
    }
}

impl Lines {
    /// Returns the page as SVG, or `None` if there are no points.
    pub fn svg(&self) -> Option<String> {
        let panels: Vec<Drawn<'_>> = self.panels.iter().filter_map(Drawn::of).collect();
        let last = panels
            .iter()
            .flat_map(Drawn::points)
            .map(|point| point.0)
            .fold(0.0, f64::max);
        if panels.is_empty() {
            return None;
        }
        let height = if panels.len() == 1 { ONLY_PANEL } else { PANEL };
        let room = |style: TextStyle, texts: &mut dyn Iterator<Item = String>| {
            texts.map(|text| style.width(&text)).fold(0.0, f64::max)
        };
        let names = &mut panels
            .iter()
            .flat_map(|panel| panel.curves.iter().map(|it| it.name.clone()));
        let ticks = &mut panels.iter().flat_map(|panel| panel.tick_labels(height));
        let (left, right) = (room(TextStyle::NOTE, ticks), room(TextStyle::LABEL, names));
        let frame = Frame {
            left: MARGIN + left + 10.0,
            right: WIDTH - MARGIN - right - LEADER - 6.0,
            steps: Axis::counting_to((last.ceil() as usize).max(1), 6),
            height,
        };
        let bottom = HEAD + height * panels.len() as f64;
        let mut page = Svg::titled(&self.title, &self.note);
        for (index, panel) in panels.iter().enumerate() {
            panel.draw(&mut page, &frame, HEAD + height * index as f64);
        }
        frame.draw(&mut page, bottom - GAP, &self.axis);
        Some(page.finish(WIDTH, bottom + FOOT))
    }
}

/// The horizontal axis that all panels share, and the size of a panel.
struct Frame {
    left: f64,
    right: f64,
    steps: Axis,
    height: f64,
}

impl Frame {
    fn x(&self, step: f64) -> f64 {
        self.left + self.steps.fraction(step) * (self.right - self.left)
    }

    fn draw(&self, page: &mut Svg, y: f64, name: &str) {
        for &tick in &self.steps.ticks {
            let x = self.x(tick);
            page.rule((x, y), (x, y + 5.0), 1.0, MUTED);
            page.text(
                (x, y + 18.0),
                Align::Center,
                TextStyle::NOTE,
                &self.steps.label(tick),
            );
        }
        let center = ((self.left + self.right) / 2.0, y + 44.0);
        let name = TextStyle::LABEL.fit(name, self.right - self.left);
        page.text(center, Align::Center, TextStyle::LABEL, &name);
    }
}

/// The drawable part of a curve, on the panel's scale.
struct DrawnCurve {
    name: String,
    color: Color,
    points: Vec<(f64, f64)>,
    /// The value of x, and the lower and upper edge of the error band there.
    band: Vec<(f64, [f64; 2])>,
}

impl DrawnCurve {
    /// Extracts the drawable points and band edges of a curve. Returns `None` if no point can be drawn.
    fn of(curve: &Curve, scale: Scale, color: Color) -> Option<Self> {
        let errors = curve
            .errors
            .iter()
            .copied()
            .map(Some)
            .chain(std::iter::repeat(None));
        let (mut points, mut band) = (Vec::new(), Vec::new());
        for (&(x, y), error) in curve.points.iter().zip(errors) {
            let at = scale.place(y);
            if !(0.0..=f64::MAX).contains(&x) || !is_drawable(at) {
                continue;
            }
            points.push((x, at));
            let edges = error.map(|error| [y - error, y + error].map(|y| scale.place(y)));
            let edges = edges.filter(|edges| edges.iter().all(|&edge| is_drawable(edge)));
            band.extend(edges.map(|edges| (x, edges)));
        }
        let name = TextStyle::LABEL.fit(&curve.name, MAX_LABEL_WIDTH);
        (!points.is_empty()).then_some(Self {
            name,
            color,
            points,
            band,
        })
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

/// A panel with its drawable curves.
struct Drawn<'a> {
    panel: &'a Panel,
    curves: Vec<DrawnCurve>,
}

impl<'a> Drawn<'a> {
    fn of(panel: &'a Panel) -> Option<Self> {
        let colored = panel.curves.iter().zip(LINES);
        let curves: Vec<DrawnCurve> = colored
            .filter_map(|(curve, color)| DrawnCurve::of(curve, panel.scale, color))
            .collect();
        (!curves.is_empty()).then_some(Self { panel, curves })
    }

    fn points(&self) -> impl Iterator<Item = (f64, f64)> + '_ {
        self.curves.iter().flat_map(|curve| {
            let edges = curve
                .band
                .iter()
                .flat_map(|&(x, edges)| edges.map(|edge| (x, edge)));
            curve.points.iter().copied().chain(edges)
        })
    }

    fn axis(&self, height: f64) -> Axis {
        let values = self.points().map(|point| point.1);
        match self.panel.scale {
            Scale::Linear => Axis::covering(values, if height > PANEL { 8 } else { 4 }),
            Scale::Logarithmic => Axis::of_powers(values),
        }
    }

    fn tick_labels(&self, height: f64) -> impl Iterator<Item = String> {
        let axis = self.axis(height);
        let labels: Vec<String> = axis
            .ticks
            .iter()
            .map(|&tick| self.label(&axis, tick))
            .collect();
        labels.into_iter()
    }

    fn label(&self, axis: &Axis, tick: f64) -> String {
        match self.panel.scale {
            Scale::Linear => axis.label(tick),
            Scale::Logarithmic => format!("1e{tick:.0}"),
        }
    }

    fn draw(&self, page: &mut Svg, frame: &Frame, top: f64) {
        let values = self.axis(frame.height);
        let (upper, lower) = (top + TITLE, top + frame.height - GAP);
        let y = |value: f64| lower - values.fraction(value) * (lower - upper);
        let place = |(step, value): (f64, f64)| (frame.x(step), y(value));
        let title = TextStyle::LABEL.fit(&self.panel.title, WIDTH - 2.0 * MARGIN);
        page.text((MARGIN, top + 10.0), Align::Left, TextStyle::LABEL, &title);
        if let Some(shade) = &self.panel.shade {
            shade.draw(page, frame, (upper, lower));
        }
        self.draw_ticks(page, frame, &values, y);
        for curve in &self.curves {
            let edge = |index: usize| curve.band.iter().map(move |&(x, edges)| (x, edges[index]));
            let area: Vec<Point> = edge(0).chain(edge(1).rev()).map(place).collect();
            if area.len() > 3 {
                page.polygon(&area, curve.color, BAND);
            }
        }
        for curve in &self.curves {
            let points: Vec<Point> = curve.points.iter().copied().map(place).collect();
            page.line(
                &points,
                if frame.height > PANEL { 2.0 } else { 1.5 },
                curve.color,
            );
            if let [only] = points[..] {
                page.disc(only, 4.0, curve.color);
            }
        }
        let ends = self
            .curves
            .iter()
            .filter_map(|curve| curve.points.last().copied().map(place));
        self.draw_names(page, frame, &ends.collect::<Vec<_>>(), (upper, lower));
    }

    fn draw_ticks(&self, page: &mut Svg, frame: &Frame, values: &Axis, y: impl Fn(f64) -> f64) {
        for &tick in &values.ticks {
            let is_zero = tick == 0.0 && self.panel.scale == Scale::Linear;
            let (at, color) = (y(tick), if is_zero { INK } else { GRID });
            page.rule((frame.left, at), (frame.right, at), 1.0, color);
            let label = self.label(values, tick);
            page.text(
                (frame.left - 10.0, at),
                Align::Right,
                TextStyle::NOTE,
                &label,
            );
        }
    }

    /// Writes each curve's name next to its end, with a connecting line. Names that would overlap are moved apart.
    fn draw_names(&self, page: &mut Svg, frame: &Frame, ends: &[Point], (upper, lower): Point) {
        let heights: Vec<f64> = ends.iter().map(|end| end.1).collect();
        let gap = LABEL_GAP.min((lower - upper) / ends.len() as f64);
        let heights = spread(&heights, gap, (upper, lower - 4.0));
        for ((curve, &end), height) in self.curves.iter().zip(ends).zip(heights) {
            let name = frame.right + LEADER;
            let bend = (frame.right + 6.0, end.1);
            page.line(&[end, bend, (name - 6.0, height)], 1.0, curve.color);
            let style = TextStyle::LABEL.colored(blend(curve.color, INK, 0.35));
            page.text((name, height), Align::Left, style, &curve.name);
        }
    }
}

impl Shade {
    fn draw(&self, page: &mut Svg, frame: &Frame, (upper, lower): Point) {
        let drawable = |point: &&(f64, f64)| point.0.is_finite() && is_drawable(point.1);
        let points: Vec<&(f64, f64)> = self.points.iter().filter(drawable).collect();
        let most = points.iter().map(|point| point.1).fold(0.0, f64::max);
        let (Some(first), Some(last)) = (points.first(), points.last()) else {
            return;
        };
        let x = |step: f64| frame.x(step).min(frame.right);
        if most > 0.0 && points.len() > 1 {
            let height =
                |value: f64| lower - SHADE_HEIGHT * (lower - upper) * value.max(0.0) / most;
            let edge = points.iter().map(|point| (x(point.0), height(point.1)));
            let (begin, end) = ((x(first.0), lower), (x(last.0), lower));
            let area = [vec![begin], edge.collect(), vec![end]].concat();
            page.polygon(&area, SHADE, 1.0);
        }
        let (right, middle) = (WIDTH - MARGIN, 64.0);
        let left = right - TextStyle::NOTE.width(&self.name) - 8.0;
        page.rectangle((left - 14.0, middle - 7.0), (left, middle + 7.0), SHADE);
        page.text((right, middle), Align::Right, TextStyle::NOTE, &self.name);
    }
}
