//! Rewards over time: a moving average per policy, with its standard error over worlds, over the worlds'
//! fire.

use super::axis::{Axis, spread};
use super::canvas::{Align, Canvas, Point, TextStyle, draw_page};
use super::palette::{GRID, INK, LINES, MUTED, SHADE, blend};
use super::{MARGIN, WIDTH, check_finite, short_names};
use crate::report::statistics::Estimate;
use crate::report::{Group, PolicyRun, ReportError, groups};
use plotters::style::RGBColor;
use std::collections::BTreeSet;
use std::path::Path;

/// How much a band hides of what is under it.
const BAND: f64 = 0.16;

const HEIGHT: f64 = 700.0;
const TOP: f64 = 118.0;
const BOTTOM: f64 = HEIGHT - 76.0;
/// Widest name at the end of a line; longer ones are shortened.
const LABEL_ROOM: f64 = 230.0;
/// Distance between the end of a line and its name.
const LEADER: f64 = 30.0;
const LABEL_GAP: f64 = 21.0;
/// Part of the height that the shaded fire may fill, to stay in the background.
const SHADE_HEIGHT: f64 = 0.4;
/// More points are hardly seen, but fill files.
const MAX_POINTS: usize = 500;
/// The moving average spans about this part of the steps.
const WINDOWS: usize = 40;

/// One line of the figure.
struct Line {
    name: String,
    color: RGBColor,
    /// `(step, moving average)`, means over worlds.
    points: Vec<(f64, f64)>,
    /// Their standard errors over worlds; empty for one world.
    errors: Vec<f64>,
}

/// Where steps and rewards lie on the page.
struct Plot {
    left: f64,
    right: f64,
    steps: Axis,
    rewards: Axis,
}

/// Draws the rewards of up to eight policies (those with the highest mean), means over worlds, to a PNG or
/// SVG file; `fire_cells` is the number of burning cells per step, shaded in the background.
///
/// # Errors
/// [`ReportError::Empty`] without rewards, [`ReportError::NotFinite`] names a reward that cannot be
/// drawn, [`ReportError::Write`] names the file.
pub fn draw_rewards(
    path: &Path,
    runs: &[PolicyRun],
    axis_label: &str,
    fire_cells: Option<&[f32]>,
) -> Result<(), ReportError> {
    let recorded: Vec<PolicyRun> = recorded(runs)?;
    let groups = groups(&recorded);
    let n_steps = recorded.iter().map(|run| run.rewards.len()).max();
    let n_steps = n_steps.unwrap_or(0);
    let window = window(n_steps);
    let lines = lines(&groups, window);
    let fire = fire_cells
        .map(|cells| moving_average(cells, window))
        .unwrap_or_default();
    let fire: Vec<_> = fire
        .into_iter()
        .filter(|point| point.1.is_finite())
        .collect();
    let plot = Plot::of(&lines, n_steps);
    draw_page(path, (WIDTH, HEIGHT), |canvas| {
        draw_head(canvas, &recorded, window, (lines.len(), groups.len()));
        draw_fire(canvas, &plot, &fire);
        draw_axes(canvas, &plot, axis_label);
        lines.iter().for_each(|line| draw_band(canvas, &plot, line));
        for line in &lines {
            let points: Vec<Point> = line.points.iter().map(|&at| plot.place(at)).collect();
            canvas.line(&points, 2.0, line.color);
            if let [only] = points[..] {
                canvas.disc(only, 4.0, line.color);
            }
        }
        draw_names(canvas, &plot, &lines);
    })
}

/// The runs whose rewards were kept.
fn recorded(runs: &[PolicyRun]) -> Result<Vec<PolicyRun>, ReportError> {
    let recorded = runs.iter().filter(|run| !run.rewards.is_empty());
    let recorded: Vec<PolicyRun> = recorded.cloned().collect();
    for run in &recorded {
        check_finite(run, "reward", run.rewards.iter().copied().map(f64::from))?;
    }
    match recorded.is_empty() {
        true => Err(ReportError::Empty { what: "rewards" }),
        false => Ok(recorded),
    }
}

/// The best policies' lines, from the highest mean down.
fn lines(groups: &[Group<'_>], window: usize) -> Vec<Line> {
    let mean = |group: &Group<'_>| {
        let rewards = || group.runs.iter().flat_map(|run| &run.rewards);
        rewards().copied().map(f64::from).sum::<f64>() / rewards().count() as f64
    };
    let names = short_names(groups);
    let mut ranked: Vec<(&Group<'_>, String)> = groups.iter().zip(names).collect();
    ranked.sort_by(|a, b| mean(b.0).total_cmp(&mean(a.0)));
    let colored = ranked.into_iter().zip(LINES);
    let line = |((group, name), color): ((&Group<'_>, String), RGBColor)| {
        let name = TextStyle::LABEL.fit(&name, LABEL_ROOM);
        Line::of(group, name, color, window)
    };
    colored.map(line).collect()
}

impl Line {
    /// Over the steps that all worlds made.
    fn of(group: &Group<'_>, name: String, color: RGBColor, window: usize) -> Self {
        let lengths = group.runs.iter().map(|run| run.rewards.len());
        let n_steps = lengths.min().unwrap_or(0);
        let worlds = group.runs.iter().map(|run| &run.rewards[..n_steps]);
        let worlds: Vec<_> = worlds
            .map(|rewards| moving_average(rewards, window))
            .collect();
        let estimate = |at: usize| {
            let values: Vec<f64> = worlds.iter().map(|averages| averages[at].1).collect();
            Estimate::of(&values).map(|estimate| (worlds[0][at].0, estimate))
        };
        let n_points = worlds.first().map_or(0, Vec::len);
        let points: Vec<(f64, Estimate)> = (0..n_points).filter_map(estimate).collect();
        Self {
            name,
            color,
            points: points.iter().map(|it| (it.0, it.1.mean)).collect(),
            errors: points.iter().filter_map(|it| it.1.standard_error).collect(),
        }
    }

    /// The edge of the band, so many errors from the line.
    fn edge(&self, n_errors: f64) -> impl DoubleEndedIterator<Item = (f64, f64)> + '_ {
        let points = self.points[..self.errors.len()].iter().zip(&self.errors);
        points.map(move |(point, error)| (point.0, point.1 + n_errors * error))
    }
}

/// A round number of steps, about a fortieth of all.
fn window(n_steps: usize) -> usize {
    let target = (n_steps / WINDOWS).max(1);
    let round = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000];
    round
        .into_iter()
        .rev()
        .find(|&window| window <= target)
        .unwrap_or(1)
}

/// `(step, mean of the `window` values up to and including that step)`, steps counted from 1.
fn moving_average(values: &[f32], window: usize) -> Vec<(f64, f64)> {
    let window = window.min(values.len()).max(1);
    let mut sums = vec![0.0_f64];
    for &value in values {
        sums.push(sums[sums.len() - 1] + f64::from(value));
    }
    let stride = values.len().div_ceil(MAX_POINTS).max(1);
    let last = values.len();
    // Counting back from the last step keeps it, whatever the stride.
    let mut ends: Vec<usize> = (window..=last).rev().step_by(stride).collect();
    ends.reverse();
    let average = |end: usize| (end as f64, (sums[end] - sums[end - window]) / window as f64);
    ends.into_iter().map(average).collect()
}

impl Plot {
    fn of(lines: &[Line], n_steps: usize) -> Self {
        let lines_and_bands = lines.iter().flat_map(|line| {
            let edges = line.edge(-1.0).chain(line.edge(1.0));
            line.points.iter().copied().chain(edges)
        });
        let rewards = Axis::covering(lines_and_bands.map(|point| point.1), 8);
        let widths = rewards
            .ticks
            .iter()
            .map(|&tick| TextStyle::NOTE.width(&rewards.label(tick)));
        let names = lines.iter().map(|line| TextStyle::LABEL.width(&line.name));
        Self {
            left: MARGIN + widths.fold(0.0, f64::max) + 10.0,
            right: WIDTH - MARGIN - names.fold(0.0, f64::max) - LEADER - 6.0,
            steps: Axis::counting_to(n_steps, 6),
            rewards,
        }
    }

    fn place(&self, (step, reward): (f64, f64)) -> Point {
        let x = self.left + self.steps.fraction(step) * (self.right - self.left);
        (x, BOTTOM - self.rewards.fraction(reward) * (BOTTOM - TOP))
    }
}

fn draw_head(
    canvas: &mut Canvas<'_>,
    runs: &[PolicyRun],
    window: usize,
    (shown, n_policies): (usize, usize),
) {
    let worlds: BTreeSet<u64> = runs.iter().map(|run| run.world_seed).collect();
    let title = match worlds.first() {
        Some(seed) if worlds.len() == 1 => format!("Reward over time on world {seed}"),
        _ => format!("Reward over time, mean over {} worlds", worlds.len()),
    };
    canvas.text((MARGIN, 36.0), Align::Left, TextStyle::TITLE, &title);
    let mut note = match window {
        1 => "each step".to_string(),
        window => format!("moving average over the last {window} steps"),
    };
    if worlds.len() > 1 {
        note += "; bands: ±1 standard error over worlds";
    }
    if shown < n_policies {
        note += &format!("; the best {shown} of {n_policies} policies");
    }
    canvas.text((MARGIN, 64.0), Align::Left, TextStyle::NOTE, &note);
}

fn draw_band(canvas: &mut Canvas<'_>, plot: &Plot, line: &Line) {
    let edges = line.edge(1.0).chain(line.edge(-1.0).rev());
    let area: Vec<Point> = edges.map(|at| plot.place(at)).collect();
    if area.len() > 3 {
        canvas.veil(&area, line.color, BAND);
    }
}

fn draw_fire(canvas: &mut Canvas<'_>, plot: &Plot, fire: &[(f64, f64)]) {
    let most = fire.iter().map(|point| point.1).fold(0.0, f64::max);
    let (Some(first), Some(last)) = (fire.first(), fire.last()) else {
        return;
    };
    if most > 0.0 && fire.len() > 1 {
        let height = |cells: f64| BOTTOM - SHADE_HEIGHT * (BOTTOM - TOP) * cells.max(0.0) / most;
        let x = |step: f64| plot.place((step, 0.0)).0.min(plot.right);
        let mut area: Vec<Point> = vec![(x(first.0), BOTTOM)];
        area.extend(fire.iter().map(|&(step, cells)| (x(step), height(cells))));
        area.push((x(last.0), BOTTOM));
        canvas.polygon(&area, SHADE);
    }
    let least = fire.iter().map(|point| point.1).fold(most, f64::min);
    let note = format!("shaded: burning cells of a world, {least:.0} to {most:.0}");
    let right = WIDTH - MARGIN;
    let swatch = right - TextStyle::NOTE.width(&note) - 8.0;
    canvas.rectangle((swatch - 14.0, 57.0), (swatch, 71.0), SHADE);
    canvas.text((right, 64.0), Align::Right, TextStyle::NOTE, &note);
}

fn draw_axes(canvas: &mut Canvas<'_>, plot: &Plot, label: &str) {
    let label = TextStyle::LABEL.fit(label, WIDTH - 2.0 * MARGIN);
    canvas.text((MARGIN, TOP - 22.0), Align::Left, TextStyle::LABEL, &label);
    for &tick in &plot.rewards.ticks {
        let y = plot.place((0.0, tick)).1;
        let color = if tick == 0.0 { INK } else { GRID };
        canvas.line(&[(plot.left, y), (plot.right, y)], 1.0, color);
        let at = (plot.left - 10.0, y);
        canvas.text(at, Align::Right, TextStyle::NOTE, &plot.rewards.label(tick));
    }
    for &tick in &plot.steps.ticks {
        let x = plot.place((tick, 0.0)).0;
        canvas.line(&[(x, BOTTOM), (x, BOTTOM + 5.0)], 1.0, MUTED);
        let at = (x, BOTTOM + 18.0);
        canvas.text(at, Align::Center, TextStyle::NOTE, &plot.steps.label(tick));
    }
    let center = ((plot.left + plot.right) / 2.0, BOTTOM + 46.0);
    canvas.text(center, Align::Center, TextStyle::LABEL, "step k");
}

/// Names at the lines' ends, moved apart where ends are close, with a leader to each.
fn draw_names(canvas: &mut Canvas<'_>, plot: &Plot, lines: &[Line]) {
    let ends: Vec<(&Line, Point)> = lines
        .iter()
        .filter_map(|line| Some((line, plot.place(*line.points.last()?))))
        .collect();
    let heights: Vec<f64> = ends.iter().map(|end| end.1.1).collect();
    let heights = spread(&heights, LABEL_GAP, (TOP, BOTTOM - 4.0));
    for ((line, end), height) in ends.into_iter().zip(heights) {
        let name = plot.right + LEADER;
        canvas.line(
            &[end, (plot.right + 6.0, end.1), (name - 6.0, height)],
            1.0,
            line.color,
        );
        let style = TextStyle::LABEL.colored(blend(line.color, INK, 0.35));
        canvas.text((name, height), Align::Left, style, &line.name);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moving_averages_look_back_over_the_window() {
        let values = [1.0, 3.0, 5.0, 7.0];
        assert_eq!(
            moving_average(&values, 2),
            [(2.0, 2.0), (3.0, 4.0), (4.0, 6.0)]
        );
        assert_eq!(moving_average(&values, 9), [(4.0, 4.0)]);
        assert_eq!(moving_average(&[], 3), []);
        let long = vec![1.0; 25_000];
        let points = moving_average(&long, 500);
        assert!(points.len() <= MAX_POINTS && points.last() == Some(&(25_000.0, 1.0)));
    }

    #[test]
    fn windows_are_round_and_never_zero() {
        assert_eq!([0, 1, 100, 1_500, 25_000].map(window), [1, 1, 2, 20, 500]);
    }
}
