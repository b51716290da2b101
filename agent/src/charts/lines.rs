//! Panels of curves over a common axis, with error bands, and names at the ends of the curves.

use super::page::{
    Area, GRID, HEAD, INK, LABEL, MARGIN, MAX_VALUE, MUTED, NOTE, WIDTH, covering, darker, finish,
    fit, is_drawable, style, tick, titled, width,
};
use anyhow::{Result, ensure};
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

/// Heights of a panel with its title: if there are several panels, and if there is only one.
const PANEL: i32 = 326;
const ONLY_PANEL: i32 = 900;
/// Heights of a panel's title, of the ticks below its plot, and of the axis label below the last panel.
const TITLE: i32 = 52;
const TICKS: i32 = 44;
const FOOT: i32 = 82;
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
        let of_panel = if panels.len() == 1 { ONLY_PANEL } else { PANEL };
        let height = HEAD + of_panel * panels.len() as i32 + FOOT;
        let mut svg = String::new();
        self.draw(&panels, &titled(&mut svg, height, &self.title, &self.note)?)?;
        Ok(finish(&svg, height))
    }

    fn draw(&self, panels: &[Panel], page: &Area<'_>) -> Result<()> {
        let curves = || panels.iter().flat_map(|panel| &panel.curves);
        let last = curves().flat_map(|curve| &curve.points);
        let last = last.map(|point| point.x.ceil()).fold(1.0, f64::max);
        let names = curves().map(|curve| width(&curve.name, LABEL)).max();
        let mut frame = Frame {
            right: WIDTH - MARGIN - names.unwrap_or(0) - LEADER,
            last,
            n_ticks: [0, if panels.len() == 1 { 9 } else { 5 }],
        };
        let areas = page.clone().margin(HEAD, FOOT, 0, 0);
        let areas = areas.split_evenly((panels.len(), 1));
        for (index, (panel, area)) in panels.iter().zip(areas).enumerate() {
            if index + 1 == panels.len() {
                frame.n_ticks[0] = (last as usize + 1).min(9);
            }
            let values = || panel.values();
            match panel.scale {
                Scale::Linear => panel.draw(&area, &frame, covering(values()))?,
                Scale::Logarithmic => {
                    let least = values().fold(f64::MAX, f64::min).log10().floor();
                    let most = values().fold(0.0, f64::max).log10().ceil().max(least + 1.0);
                    // Slightly more than the powers of ten, because plotters rounds their ticks.
                    let range = 0.999 * 10_f64.powf(least)..1.001 * 10_f64.powf(most);
                    panel.draw(&area, &frame, range.log_scale())?;
                }
            }
        }
        let left = MARGIN + MAX_TICK;
        let axis = fit(&self.axis, LABEL, frame.right - left);
        let at = ((left + frame.right) / 2, page.dim_in_pixel().1 as i32 - 46);
        Ok(page.draw_text(&axis, &style(LABEL, INK, HPos::Center), at)?)
    }
}

struct Frame {
    right: i32,
    last: f64,
    n_ticks: [usize; 2],
}

impl Panel {
    /// Returns the panel with only what can be drawn. Points whose error band cannot be drawn get none.
    fn drawable(&self) -> Self {
        let is_linear = self.scale == Scale::Linear;
        let fits = |y: f64| is_drawable(y) && (is_linear || y >= 1.0 / MAX_VALUE);
        let drawable = |point: &&Point| (0.0..1e15).contains(&point.x) && fits(point.y);
        let point = |&Point { x, y, error }: &Point| {
            let has_band = fits(y - error) && fits(y + error);
            let error = if has_band { error } else { 0.0 };
            Point { x, y, error }
        };
        let curve = |curve: &Curve| Curve {
            name: fit(&curve.name, LABEL, MAX_NAME),
            points: curve.points.iter().filter(drawable).map(point).collect(),
        };
        let curves = self.curves.iter().take(MAX_CURVES).map(curve);
        Self {
            curves: curves.filter(|curve| !curve.points.is_empty()).collect(),
            ..self.clone()
        }
    }

    fn values(&self) -> impl Iterator<Item = f64> + '_ {
        let points = self.curves.iter().flat_map(|curve| &curve.points);
        points.flat_map(|point| [point.y - point.error, point.y + point.error])
    }

    fn draw<Y>(&self, area: &Area<'_>, frame: &Frame, values: Y) -> Result<()>
    where
        Y: AsRangedCoord<Value = f64>,
        Y::CoordDescType: Ranged<ValueType = f64> + ValueFormatter<f64>,
    {
        let mut chart = ChartBuilder::on(area)
            .margin_top(TITLE)
            .margin_left(MARGIN)
            .margin_right(WIDTH - frame.right)
            .x_label_area_size(TICKS)
            .y_label_area_size(MAX_TICK)
            .build_cartesian_2d(0.0..frame.last, values)?;
        chart
            .configure_mesh()
            .disable_x_mesh()
            .axis_style(TRANSPARENT)
            .set_all_tick_mark_size(10)
            .bold_line_style(GRID.stroke_width(2))
            .light_line_style(TRANSPARENT)
            .x_labels(frame.n_ticks[0])
            .x_label_formatter(&tick)
            .x_label_style(style(NOTE, MUTED, HPos::Center))
            .y_labels(frame.n_ticks[1])
            .y_label_formatter(&tick)
            .y_label_style(style(NOTE, MUTED, HPos::Right))
            .draw()?;
        if self.scale == Scale::Linear {
            let zero = vec![(0.0, 0.0), (frame.last, 0.0)];
            chart.draw_series([PathElement::new(zero, INK.stroke_width(2))])?;
        }
        for (curve, color) in self.curves.iter().zip(COLORS) {
            // A band ends where a point has none.
            let bands = curve.points.chunk_by(|a, b| a.error > 0.0 && b.error > 0.0);
            for band in bands.filter(|band| band.len() > 1) {
                let lower = band.iter().map(|point| (point.x, point.y - point.error));
                let upper = band.iter().rev();
                let upper = upper.map(|point| (point.x, point.y + point.error));
                let edge: Vec<(f64, f64)> = lower.chain(upper).collect();
                chart.draw_series([Polygon::new(edge, color.mix(0.18))])?;
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
        self.draw_names(area, frame.right, &ends)?;
        let title = fit(&self.title, LABEL, WIDTH - 2 * MARGIN);
        Ok(area.draw_text(&title, &style(LABEL, INK, HPos::Left), (MARGIN, 18))?)
    }

    fn draw_names(&self, area: &Area<'_>, right: i32, ends: &[(i32, i32)]) -> Result<()> {
        let top = area.get_base_pixel().1;
        let heights: Vec<i32> = ends.iter().map(|end| end.1 - top).collect();
        let bottom = area.dim_in_pixel().1 as i32 - TICKS;
        let names = spread(&heights, TITLE, bottom);
        for (index, curve) in self.curves.iter().enumerate() {
            let (color, height, name) = (COLORS[index], heights[index], names[index]);
            let line = [
                (ends[index].0, height),
                (right + 8, height),
                (right + LEADER - 10, name),
            ];
            area.draw(&PathElement::new(line, color.stroke_width(2)))?;
            let style = style(LABEL, darker(color), HPos::Left);
            area.draw_text(&curve.name, &style, (right + LEADER, name))?;
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
