//! The ladder chart: one bar per row, with an error bar and one dot per world.

use super::page::{
    Area, GRID, HEAD, INK, LABEL, MARGIN, MUTED, NOTE, WIDTH, covering, darker, finish, fit,
    is_drawable, style, tick, titled, width,
};
use anyhow::Result;
use plotters::coord::combinators::{BindKeyPoints, WithKeyPoints};
use plotters::coord::types::{RangedCoordf64, RangedCoordi32};
use plotters::prelude::*;
use plotters::style::text_anchor::HPos;
use std::collections::BTreeSet;

const ROW: i32 = 60;
const BAR: i32 = 36;
/// Upper edge of the bars, below the legend.
const TOP: i32 = HEAD + 60;
/// Height of the tick labels and the axis label.
const FOOT: i32 = 110;
const MAX_NAME: i32 = 710;
const MAX_VALUE: i32 = 400;

#[derive(Debug, Clone, PartialEq)]
pub struct Ladder {
    pub title: String,
    /// A line of small print below the title.
    pub note: String,
    pub axis: String,
    pub bars: Vec<Bar>,
}

/// A row of the chart. Non-finite values are omitted: if `value` is NaN, only the dots of the worlds are drawn.
#[derive(Debug, Clone, PartialEq)]
pub struct Bar {
    pub name: String,
    /// A remark after the name. It can be empty.
    pub remark: String,
    pub label: String,
    /// The bar's entry in the legend: name and colour.
    pub kind: (&'static str, RGBColor),
    pub value: f64,
    /// The ends of the error bar.
    pub ends: Option<[f64; 2]>,
    /// Seed and value of each world.
    pub worlds: Vec<(u64, f64)>,
}

/// The area of the bars: values, and units from the top of the first row.
type Plot<'a> =
    ChartContext<'a, SVGBackend<'a>, Cartesian2d<RangedCoordf64, WithKeyPoints<RangedCoordi32>>>;

impl Ladder {
    pub fn svg(&self) -> Result<String> {
        let height = TOP + ROW * self.bars.len() as i32 + FOOT;
        let mut svg = String::new();
        self.draw(&titled(&mut svg, height, &self.title, &self.note)?)?;
        Ok(finish(&svg, height))
    }

    fn draw(&self, page: &Area<'_>) -> Result<()> {
        self.draw_legend(page)?;
        let names: Vec<String> = self.bars.iter().map(Bar::full_name).collect();
        let labels = self
            .bars
            .iter()
            .map(|bar| fit(&bar.label, LABEL, MAX_VALUE));
        let labels: Vec<String> = labels.collect();
        let widest = |texts: &[String]| texts.iter().map(|it| width(it, LABEL)).max().unwrap_or(0);
        let (left, right) = (widest(&names) + 24, widest(&labels) + 24);
        let bottom = ROW * self.bars.len() as i32;
        let middles: Vec<i32> = (ROW / 2..bottom).step_by(ROW as usize).collect();
        let values = covering(self.bars.iter().flat_map(Bar::extent));
        // Rows are measured in units from the top of the first row.
        let mut chart = ChartBuilder::on(page)
            .margin_left(MARGIN)
            .margin_right(MARGIN + right)
            .margin_top(TOP)
            .margin_bottom(MARGIN / 2)
            .x_label_area_size(FOOT - MARGIN / 2)
            .y_label_area_size(left)
            .build_cartesian_2d(values, (bottom..0).with_key_points(middles.clone()))?;
        chart
            .configure_mesh()
            .disable_y_mesh()
            .axis_style(TRANSPARENT)
            .set_all_tick_mark_size(10)
            .bold_line_style(GRID.stroke_width(2))
            .light_line_style(TRANSPARENT)
            .x_labels(9)
            .x_label_formatter(&tick)
            .x_label_style(style(NOTE, MUTED, HPos::Center))
            .y_label_formatter(&|middle| names[(middle / ROW) as usize].clone())
            .y_label_style(style(LABEL, INK, HPos::Right))
            .x_desc(fit(&self.axis, LABEL, WIDTH - 2 * MARGIN - left + right))
            .axis_desc_style(style(LABEL, INK, HPos::Center))
            .draw()?;
        let seeds = self.bars.iter().flat_map(|bar| &bar.worlds);
        let seeds: BTreeSet<u64> = seeds.map(|world| world.0).collect();
        for ((bar, label), &middle) in self.bars.iter().zip(&labels).zip(&middles) {
            bar.draw(&mut chart, middle, &seeds)?;
            let at = (WIDTH - MARGIN, TOP + middle);
            page.draw_text(label, &style(LABEL, INK, HPos::Right), at)?;
        }
        let zero = vec![(0.0, 0), (0.0, bottom)];
        chart.draw_series([PathElement::new(zero, INK.stroke_width(2))])?;
        Ok(())
    }

    fn draw_legend(&self, page: &Area<'_>) -> Result<()> {
        let mut kinds: Vec<(&str, RGBColor)> = Vec::new();
        for bar in &self.bars {
            if !kinds.contains(&bar.kind) {
                kinds.push(bar.kind);
            }
        }
        let mut left = MARGIN;
        for (name, color) in kinds {
            let square = [(left, HEAD - 3), (left + 26, HEAD + 23)];
            page.draw(&Rectangle::new(square, color.filled()))?;
            let at = (left + 38, HEAD + 10);
            page.draw_text(name, &style(NOTE, INK, HPos::Left), at)?;
            left += 38 + width(name, NOTE) + 40;
        }
        Ok(())
    }
}

impl Bar {
    fn full_name(&self) -> String {
        let remark = fit(&self.remark, LABEL, 2 * MAX_NAME / 3);
        let name = fit(&self.name, LABEL, MAX_NAME - width(&remark, LABEL));
        format!("{name}{remark}")
    }

    fn draw(&self, chart: &mut Plot<'_>, middle: i32, seeds: &BTreeSet<u64>) -> Result<()> {
        let (upper, color) = (middle - BAR / 2, self.kind.1);
        if is_drawable(self.value) {
            let area = [(0.0, upper), (self.value, upper + BAR)];
            chart.draw_series([Rectangle::new(area, color.filled())])?;
        }
        for (seed, value) in self.dots() {
            // A world's dot is at the same height in every bar, so that its values can be compared.
            let rank = 2 * seeds.range(..seed).count() as i32 + 1;
            let at = (value, upper + BAR * rank / (2 * seeds.len() as i32));
            chart.draw_series([Circle::new(at, 7, WHITE.filled())])?;
            chart.draw_series([Circle::new(at, 5, darker(darker(color)).filled())])?;
        }
        let ends = self.ends.into_iter();
        for [from, to] in ends.filter(|ends| ends.iter().all(|&it| is_drawable(it))) {
            let caps = [from, to].map(|end| vec![(end, middle - 12), (end, middle + 12)]);
            let lines = caps.into_iter().chain([vec![(from, middle), (to, middle)]]);
            chart.draw_series(lines.map(|line| PathElement::new(line, INK.stroke_width(4))))?;
        }
        Ok(())
    }

    fn extent(&self) -> impl Iterator<Item = f64> + '_ {
        let worlds = self.worlds.iter().map(|world| world.1);
        let ends = self.ends.into_iter().flatten();
        worlds.chain(ends).chain([self.value])
    }

    /// The dot of a single world would coincide with the end of the bar.
    fn dots(&self) -> impl Iterator<Item = (u64, f64)> + '_ {
        let are_apart = self.worlds.len() > 1 || !is_drawable(self.value);
        let worlds = self.worlds.iter().copied();
        worlds.filter(move |world| are_apart && is_drawable(world.1))
    }
}
