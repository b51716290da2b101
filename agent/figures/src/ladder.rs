//! The ladder chart: one bar per row, with an error bar and one dot per world.

use crate::axis::{Axis, is_drawable};
use crate::palette::{Color, GRID, INK, PAPER, blend};
use crate::svg::{Align, MARGIN, Svg, WIDTH};
use crate::text::TextStyle;
use std::collections::BTreeSet;

const ROW: f64 = 44.0;
const BAR: f64 = 26.0;
/// Upper edge of the bars, below the title, note and legend.
const TOP: f64 = 132.0;
/// Height of the tick labels and the axis label.
const BOTTOM: f64 = 72.0;
/// Maximum widths of a row's label and of its value. Longer text is shortened.
const MAX_LABEL_WIDTH: f64 = 360.0;
const MAX_VALUE_WIDTH: f64 = 200.0;

#[derive(Debug, Clone, PartialEq)]
pub struct Ladder {
    pub title: String,
    /// A line of small print below the title.
    pub note: String,
    pub axis: String,
    /// Name and colour of each legend entry. All entries must fit on one line.
    pub legend: Vec<(&'static str, Color)>,
    pub bars: Vec<Bar>,
}

/// A row of the chart. Non-finite values are omitted: if `value` is NaN, only the dots of the worlds are drawn.
#[derive(Debug, Clone, PartialEq)]
pub struct Bar {
    pub name: String,
    /// Small print after the name. It can be empty.
    pub remark: String,
    pub label: String,
    pub color: Color,
    pub value: f64,
    /// The ends of the error bar.
    pub ends: Option<[f64; 2]>,
    /// Seed and value of each world.
    pub worlds: Vec<(u64, f64)>,
}

/// The plot area of the page, which contains the bars.
struct Plot {
    left: f64,
    right: f64,
    bottom: f64,
    axis: Axis,
    seeds: Vec<u64>,
}

impl Ladder {
    pub fn svg(&self) -> String {
        let plot = Plot::of(&self.bars);
        let mut page = Svg::titled(&self.title, &self.note);
        self.draw_legend(&mut page);
        self.draw_axis(&mut page, &plot);
        for (rank, bar) in self.bars.iter().enumerate() {
            bar.draw(&mut page, &plot, TOP + ROW * (rank as f64 + 0.5));
        }
        let zero = plot.x(0.0);
        page.rule((zero, TOP), (zero, plot.bottom), 1.0, INK);
        page.finish(WIDTH, plot.bottom + BOTTOM)
    }

    fn draw_legend(&self, page: &mut Svg) {
        let mut left = MARGIN;
        for &(name, color) in &self.legend {
            page.rectangle((left, 89.0), (left + 14.0, 103.0), color);
            page.text((left + 21.0, 96.0), Align::Left, TextStyle::LABEL, name);
            left += 21.0 + TextStyle::LABEL.width(name) + 26.0;
        }
    }

    fn draw_axis(&self, page: &mut Svg, plot: &Plot) {
        for &tick in &plot.axis.ticks {
            let x = plot.x(tick);
            page.rule((x, TOP), (x, plot.bottom), 1.0, GRID);
            let at = (x, plot.bottom + 16.0);
            page.text(at, Align::Center, TextStyle::NOTE, &plot.axis.label(tick));
        }
        let label = TextStyle::LABEL.fit(&self.axis, WIDTH - 2.0 * MARGIN);
        // Centred below the bars, unless a long label has to move left to stay on the page.
        let half = TextStyle::LABEL.width(&label) / 2.0;
        let center = ((plot.left + plot.right) / 2.0).min(WIDTH - MARGIN - half);
        let at = (center, plot.bottom + 44.0);
        page.text(at, Align::Center, TextStyle::LABEL, &label);
    }
}

impl Plot {
    fn of(bars: &[Bar]) -> Self {
        let widest = |width: &dyn Fn(&Bar) -> f64| bars.iter().map(width).fold(0.0, f64::max);
        let label =
            |bar: &Bar| TextStyle::LABEL.width(&bar.name) + TextStyle::NOTE.width(&bar.remark);
        let values = widest(&|bar| TextStyle::LABEL.width(&bar.label)).min(MAX_VALUE_WIDTH);
        let seeds = bars.iter().flat_map(|bar| &bar.worlds).map(|world| world.0);
        Self {
            left: MARGIN + widest(&label).min(MAX_LABEL_WIDTH) + 14.0,
            right: WIDTH - MARGIN - values - 24.0,
            bottom: TOP + ROW * bars.len() as f64,
            axis: Axis::covering(bars.iter().flat_map(Bar::extent), 8),
            seeds: seeds.collect::<BTreeSet<u64>>().into_iter().collect(),
        }
    }

    fn x(&self, value: f64) -> f64 {
        self.left + self.axis.fraction(value) * (self.right - self.left)
    }
}

impl Bar {
    fn extent(&self) -> impl Iterator<Item = f64> + '_ {
        let worlds = self.worlds.iter().map(|world| world.1);
        let ends = self.ends.into_iter().flatten();
        worlds.chain(ends).chain([self.value])
    }

    fn draw(&self, page: &mut Svg, plot: &Plot, middle: f64) {
        self.draw_label(page, plot, middle);
        let label = TextStyle::LABEL.fit(&self.label, MAX_VALUE_WIDTH);
        page.text(
            (WIDTH - MARGIN, middle),
            Align::Right,
            TextStyle::LABEL,
            &label,
        );
        let (upper, lower) = (middle - BAR / 2.0, middle + BAR / 2.0);
        if is_drawable(self.value) {
            let (zero, end) = (plot.x(0.0), plot.x(self.value));
            page.rectangle((zero.min(end), upper), (zero.max(end), lower), self.color);
        }
        self.draw_worlds(page, plot, upper);
        let ends = self.ends;
        if let Some(ends) = ends.filter(|ends| ends.iter().all(|&end| is_drawable(end))) {
            let [from, to] = ends.map(|value| plot.x(value));
            page.rule((from, middle), (to, middle), 2.0, INK);
            for x in [from, to] {
                page.rule((x, middle - 6.0), (x, middle + 6.0), 2.0, INK);
            }
        }
    }

    fn draw_worlds(&self, page: &mut Svg, plot: &Plot, upper: f64) {
        let dot = blend(self.color, INK, 0.55);
        // The dot of a single world is omitted, because it would coincide with the end of the bar.
        let worlds = if self.worlds.len() > 1 || !is_drawable(self.value) {
            &self.worlds[..]
        } else {
            &[]
        };
        for &(seed, value) in worlds.iter().filter(|world| is_drawable(world.1)) {
            // A world's dot is at the same height in every bar, so that its values can be compared.
            let rank = plot.seeds.binary_search(&seed).unwrap_or(0) as f64 + 0.5;
            let at = (plot.x(value), upper + BAR * rank / plot.seeds.len() as f64);
            page.disc(at, 3.5, PAPER);
            page.disc(at, 2.5, dot);
        }
    }

    fn draw_label(&self, page: &mut Svg, plot: &Plot, middle: f64) {
        let right = plot.left - 14.0;
        let remark = TextStyle::NOTE.fit(&self.remark, MAX_LABEL_WIDTH / 2.0);
        let width = TextStyle::NOTE.width(&remark);
        page.text((right, middle), Align::Right, TextStyle::NOTE, &remark);
        let name = TextStyle::LABEL.fit(&self.name, right - MARGIN - width + 1.0);
        page.text(
            (right - width, middle),
            Align::Right,
            TextStyle::LABEL,
            &name,
        );
    }
}
