//! Panels of curves over a common axis, with error bands, and names at the ends of the curves.

use super::page::{
    Area, GRID, HEAD, INK, LABEL, MARGIN, MUTED, NOTE, WIDTH, begin, covering, darker, finish, fit,
    is_drawable, style, tick, width,
};
use anyhow::{Result, ensure};
use plotters::coord::combinators::BindKeyPoints;
use plotters::coord::ranged1d::{AsRangedCoord, Ranged, ValueFormatter};
use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

/// Colours of curves in order of use: Okabe and Ito (2008), but with brown instead of yellow, which is too light for a
/// line on white.
const COLORS: [RGBColor; MAX_CURVES] = [
    RGBColor(0x00, 0x72, 0xb2),
    RGBColor(0xd5, 0x5e, 0x00),
    RGBColor(0x00, 0x9e, 0x73),
    RGBColor(0xcc, 0x79, 0xa7),
    RGBColor(0xe6, 0x9f, 0x00),
    RGBColor(0x56, 0xb4, 0xe9),
    RGBColor(0x33, 0x33, 0x33),
    RGBColor(0x8c, 0x51, 0x0a),
];

/// Maximum number of curves per panel: the number of colours.
pub const MAX_CURVES: usize = 8;

/// Colour of the shaded area behind curves.
const SHADE: RGBColor = RGBColor(0xf7, 0xe6, 0xd8);

/// Heights of a panel with its title: if there are several panels, and if there is only one.
const PANEL: i32 = 326;
const ONLY_PANEL: i32 = 900;
/// Heights of a panel's title, of the gap below its plot, and of the axis below the last plot.
const TITLE: i32 = 52;
const GAP: i32 = 34;
const FOOT: i32 = 84;
/// Length of the line from a curve's end to its name, and minimum distance between names.
const LEADER: i32 = 46;
const NAME_GAP: i32 = 34;
/// Maximum widths of a curve's name and of a tick's label.
const MAX_NAME: i32 = 430;
const MAX_TICK: i32 = 110;

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
    pub points: Vec<Point>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    pub x: f64,
    pub y: f64,
    /// Half the height of the error band, 0 if there is no band.
    pub error: f64,
}

/// A shaded area above the axis, with a separate scale.
#[derive(Debug, Clone, PartialEq)]
pub struct Shade {
    pub name: String,
    pub points: Vec<(f64, f64)>,
}

impl Point {
    /// Creates a point without an error band.
    pub fn new(x: f64, y: f64) -> Self {
        Self { x, y, error: 0.0 }
    }
}

impl Lines {
    /// # Errors
    /// If there are no points.
    pub fn svg(&self) -> Result<String> {
        let panels = self.panels.iter().map(Panel::drawable);
        let panels: Vec<Panel> = panels.filter(|panel| !panel.curves.is_empty()).collect();
        ensure!(
            !panels.is_empty(),
            "{}: expected points, got none",
            self.title
        );
        let height = HEAD + panel_height(panels.len()) * panels.len() as i32 + FOOT;
        let mut svg = String::new();
        self.draw(&panels, &begin(&mut svg, height, &self.title, &self.note)?)?;
        Ok(finish(&svg, height))
    }

    fn draw(&self, panels: &[Panel], page: &Area<'_>) -> Result<()> {
        let curves = || panels.iter().flat_map(|panel| &panel.curves);
        let last = curves().flat_map(|curve| &curve.points);
        let last = last.map(|point| point.x.ceil()).fold(1.0, f64::max);
        let names = curves().map(|curve| width(&curve.name, LABEL)).max();
        let height = panel_height(panels.len());
        for (index, panel) in panels.iter().enumerate() {
            let is_last = index + 1 == panels.len();
            let frame = Frame {
                top: HEAD + height * index as i32,
                height: height + if is_last { FOOT } else { 0 },
                right: MARGIN + LEADER + names.unwrap_or(0),
                last,
                n_ticks: if panels.len() == 1 { 9 } else { 5 },
                axis: is_last.then_some(&self.axis),
            };
            let values = || panel.values();
            match panel.scale {
                Scale::Linear => panel.draw(page, &frame, covering(values()))?,
                Scale::Logarithmic => {
                    let least = values().fold(f64::MAX, f64::min).log10().floor() as i32;
                    let most = values().fold(0.0, f64::max).log10().ceil() as i32;
                    let most = most.max(least + 1);
                    let step = ((most - least) as usize).div_ceil(frame.n_ticks);
                    let powers = (least..=most).step_by(step);
                    let powers = powers.map(|power| 10_f64.powi(power)).collect();
                    let range = (10_f64.powi(least)..10_f64.powi(most)).log_scale();
                    panel.draw(page, &frame, range.with_key_points(powers))?;
                }
            }
        }
        Ok(())
    }
}

fn panel_height(n_panels: usize) -> i32 {
    if n_panels == 1 { ONLY_PANEL } else { PANEL }
}

/// The position of a panel, and the axis that all panels share.
struct Frame<'a> {
    top: i32,
    height: i32,
    /// Width of the margin with the names of curves.
    right: i32,
    /// The last value of the horizontal axis.
    last: f64,
    /// Maximum number of ticks of the vertical axis.
    n_ticks: usize,
    /// The label of the horizontal axis, if it is drawn.
    axis: Option<&'a String>,
}

impl Panel {
    /// Returns the panel with only what can be drawn.
    fn drawable(&self) -> Self {
        let fits = |y: f64| is_drawable(y) && (self.scale == Scale::Linear || y > 0.0);
        let drawable = |point: &&Point| (0.0..1e15).contains(&point.x) && fits(point.y);
        let curve = |curve: &Curve| Curve {
            name: fit(&curve.name, LABEL, MAX_NAME),
            points: curve.points.iter().filter(drawable).copied().collect(),
        };
        let curves = self.curves.iter().take(MAX_CURVES).map(curve);
        Self {
            curves: curves.filter(|curve| !curve.points.is_empty()).collect(),
            ..self.clone()
        }
    }

    /// Returns the edges of a curve's error band, the lower edge first. Omits points where an edge cannot be drawn.
    fn band(&self, curve: &Curve) -> Vec<(f64, [f64; 2])> {
        let edges = |point: &Point| (point.x, [point.y - point.error, point.y + point.error]);
        let fits = |edge: &f64| is_drawable(*edge) && (self.scale == Scale::Linear || *edge > 0.0);
        let band = curve.points.iter().filter(|point| point.error > 0.0);
        band.map(edges)
            .filter(|(_, edges)| edges.iter().all(fits))
            .collect()
    }

    fn values(&self) -> impl Iterator<Item = f64> + '_ {
        self.curves.iter().flat_map(|curve| {
            let edges = self.band(curve).into_iter().flat_map(|it| it.1);
            curve.points.iter().map(|point| point.y).chain(edges)
        })
    }

    fn draw<Y>(&self, page: &Area<'_>, frame: &Frame<'_>, values: Y) -> Result<()>
    where
        Y: AsRangedCoord<Value = f64>,
        Y::CoordDescType: Ranged<ValueType = f64> + ValueFormatter<f64>,
    {
        let area = page.clone().shrink((0, frame.top), (WIDTH, frame.height));
        let shade = self.shade.iter().flat_map(|shade| &shade.points);
        let shade = shade.filter(|point| point.0 <= frame.last && is_drawable(point.1));
        let shade: Vec<(f64, f64)> = shade.map(|&(x, y)| (x, y.max(0.0))).collect();
        let most = shade.iter().map(|point| point.1);
        let most = most.fold(f64::MIN_POSITIVE, f64::max);
        let mut chart = ChartBuilder::on(&area)
            .margin_top(TITLE)
            .margin_left(MARGIN)
            .margin_right(frame.right)
            .margin_bottom(if frame.axis.is_some() { 16 } else { GAP })
            .x_label_area_size(if frame.axis.is_some() {
                FOOT + GAP - 16
            } else {
                0
            })
            .y_label_area_size(MAX_TICK)
            .build_cartesian_2d(0.0..frame.last, values)?
            // The highest part of the shaded area reaches 40 % of the plot's height.
            .set_secondary_coord(0.0..frame.last, 0.0..most / 0.4);
        chart.draw_secondary_series(AreaSeries::new(shade, 0.0, SHADE))?;
        chart
            .configure_mesh()
            .disable_x_mesh()
            .axis_style(TRANSPARENT)
            .set_all_tick_mark_size(10)
            .bold_line_style(GRID.stroke_width(2))
            .light_line_style(TRANSPARENT)
            .x_labels((frame.last as usize + 1).min(9))
            .x_label_formatter(&tick)
            .x_label_style(style(NOTE, MUTED, HPos::Center))
            .y_labels(frame.n_ticks)
            .y_label_formatter(&tick)
            .y_label_style(style(NOTE, MUTED, HPos::Right))
            .x_desc(
                frame
                    .axis
                    .map_or(String::new(), |axis| fit(axis, LABEL, 1000)),
            )
            .axis_desc_style(style(LABEL, INK, HPos::Center))
            .draw()?;
        if self.scale == Scale::Linear {
            let zero = vec![(0.0, 0.0), (frame.last, 0.0)];
            chart.draw_series([PathElement::new(zero, INK.stroke_width(2))])?;
        }
        for (curve, color) in self.curves.iter().zip(COLORS) {
            let band = self.band(curve);
            let lower = band.iter().map(|&(x, edges)| (x, edges[0]));
            let upper = band.iter().rev().map(|&(x, edges)| (x, edges[1]));
            let area: Vec<(f64, f64)> = lower.chain(upper).collect();
            if area.len() > 2 {
                chart.draw_series([Polygon::new(area, color.mix(0.18))])?;
            }
        }
        let mut ends = Vec::new();
        for (curve, color) in self.curves.iter().zip(COLORS) {
            let points = curve.points.iter().map(|point| (point.x, point.y));
            let points: Vec<(f64, f64)> = points.collect();
            let end = points[points.len() - 1];
            ends.push(chart.backend_coord(&end));
            if points.len() == 1 {
                chart.draw_series([Circle::new(end, 8, color.filled())])?;
            }
            chart.draw_series(LineSeries::new(points, color.stroke_width(3)))?;
        }
        self.draw_names(page, frame, &ends)?;
        self.draw_title(page, frame)
    }

    /// Writes each curve's name next to its end, with a connecting line.
    fn draw_names(&self, page: &Area<'_>, frame: &Frame<'_>, ends: &[(i32, i32)]) -> Result<()> {
        let top = frame.top + TITLE;
        let bottom = frame.top + frame.height - GAP - if frame.axis.is_some() { FOOT } else { 0 };
        let heights: Vec<i32> = ends.iter().map(|end| end.1).collect();
        let heights = spread(&heights, top, bottom);
        let right = WIDTH - frame.right;
        for (((curve, color), &end), height) in
            self.curves.iter().zip(COLORS).zip(ends).zip(heights)
        {
            let line = vec![end, (right + 8, end.1), (right + LEADER - 10, height)];
            page.draw(&PathElement::new(line, color.stroke_width(2)))?;
            let at = (right + LEADER, height);
            page.draw_text(&curve.name, &style(LABEL, darker(color), HPos::Left), at)?;
        }
        Ok(())
    }

    fn draw_title(&self, page: &Area<'_>, frame: &Frame<'_>) -> Result<()> {
        let middle = frame.top + 18;
        let note = self.shade.as_ref().map_or("", |shade| &shade.name);
        let note = fit(note, NOTE, WIDTH / 2);
        let left = WIDTH - MARGIN - width(&note, NOTE);
        let title = fit(&self.title, LABEL, left - 2 * MARGIN);
        page.draw_text(&title, &style(LABEL, INK, HPos::Left), (MARGIN, middle))?;
        if self.shade.is_some() {
            let square = [(left - 38, middle - 13), (left - 12, middle + 13)];
            page.draw(&Rectangle::new(square, SHADE.filled()))?;
            page.draw_text(&note, &style(NOTE, MUTED, HPos::Left), (left, middle))?;
        }
        Ok(())
    }
}

/// Moves names apart so that they do not overlap. Names stay between `top` and `bottom`, and keep their order.
fn spread(heights: &[i32], top: i32, bottom: i32) -> Vec<i32> {
    let gap = NAME_GAP.min((bottom - top) / heights.len() as i32);
    let mut order: Vec<usize> = (0..heights.len()).collect();
    order.sort_by_key(|&index| heights[index]);
    let mut placed = heights.to_vec();
    let mut free = top;
    for &index in &order {
        placed[index] = placed[index].max(free);
        free = placed[index] + gap;
    }
    let mut free = bottom;
    for &index in order.iter().rev() {
        placed[index] = placed[index].min(free);
        free = placed[index] - gap;
    }
    placed
}
