//! The ladder: mean reward per policy as bars, with standard errors and every single world.

use super::axis::Axis;
use super::canvas::{Align, Canvas, TextStyle, draw_page};
use super::palette::{GRID, INK, MUTED, PAPER, blend};
use super::{MARGIN, WIDTH, check_finite, readable};
use crate::report::number::{decimals, with_error};
use crate::report::statistics::Estimate;
use crate::report::{Group, PolicyRun, ReportError, groups};
use plotters::style::RGBColor;
use std::collections::BTreeSet;
use std::path::Path;

const ROW: f64 = 44.0;
const BAR: f64 = 26.0;
/// Upper edge of the bars, below title, subtitle and legend.
const TOP: f64 = 132.0;
/// Room for tick labels and the axis label.
const BOTTOM: f64 = 72.0;
/// Widest label of a row; longer ones are shortened.
const LABEL_ROOM: f64 = 360.0;

/// What feeds a policy's plans: the colour of its bar.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Family {
    NoBelief,
    Shooting,
    Beam,
    Learned,
    TruthFed,
}

/// One bar.
struct Row<'a> {
    group: &'a Group<'a>,
    family: Family,
    reward: Estimate,
    /// `(world seed, mean reward)`.
    worlds: Vec<(u64, f64)>,
}

/// Where rows and values lie on the page.
struct Plot {
    left: f64,
    right: f64,
    bottom: f64,
    axis: Axis,
    /// Of the value labels.
    decimals: usize,
    seeds: Vec<u64>,
}

/// Draws mean reward per policy, the best at the top, to a PNG file.
///
/// `axis_label` says what the reward counts, see [`super::FIRE_CELLS_PER_STEP`].
///
/// # Errors
/// [`ReportError::Empty`] without runs, [`ReportError::NotFinite`] names a reward that cannot be
/// drawn, [`ReportError::Write`] names the file.
pub fn draw_ladder(path: &Path, runs: &[PolicyRun], axis_label: &str) -> Result<(), ReportError> {
    if runs.is_empty() {
        return Err(ReportError::Empty { what: "ladder" });
    }
    for run in runs {
        check_finite(run, "mean reward", std::iter::once(run.mean_reward))?;
    }
    let groups = groups(runs);
    let rows = rows(&groups);
    let plot = Plot::of(&rows);
    draw_page(path, (WIDTH, plot.bottom + BOTTOM), |canvas| {
        draw_head(canvas, &rows, runs, plot.seeds.len());
        draw_axis(canvas, &plot, axis_label);
        for (rank, row) in rows.iter().enumerate() {
            draw_row(canvas, &plot, row, TOP + ROW * (rank as f64 + 0.5));
        }
        let zero = plot.x(0.0);
        canvas.line(&[(zero, TOP), (zero, plot.bottom)], 1.0, INK);
    })
}

fn rows<'a>(groups: &'a [Group<'a>]) -> Vec<Row<'a>> {
    let row = |group: &'a Group<'a>| {
        let pair = |run: &&PolicyRun| (run.world_seed, run.mean_reward);
        Row {
            group,
            family: Family::of(group),
            reward: Estimate::of(&group.values(|run| run.mean_reward))
                .expect("invariant: a group has a run"),
            worlds: group.runs.iter().map(pair).collect(),
        }
    };
    let mut rows: Vec<Row<'a>> = groups.iter().map(row).collect();
    rows.sort_by(|a, b| b.reward.mean.total_cmp(&a.reward.mean));
    rows
}

impl Family {
    const ALL: [Self; 5] = [
        Self::NoBelief,
        Self::Shooting,
        Self::Beam,
        Self::Learned,
        Self::TruthFed,
    ];

    fn of(group: &Group<'_>) -> Self {
        let policy = group.policy.to_lowercase();
        match group.estimator {
            "truth" | "next_truth" => Self::TruthFed,
            "none" => Self::NoBelief,
            "known_model" if policy.contains("beam") => Self::Beam,
            "known_model" if !policy.contains("learn") => Self::Shooting,
            _ => Self::Learned,
        }
    }

    fn color(self) -> RGBColor {
        match self {
            Self::NoBelief => RGBColor(0xa3, 0xa3, 0xa3),
            Self::Shooting => RGBColor(0x56, 0xb4, 0xe9),
            Self::Beam => RGBColor(0x00, 0x72, 0xb2),
            Self::Learned => RGBColor(0x00, 0x9e, 0x73),
            Self::TruthFed => RGBColor(0xe6, 0x9f, 0x00),
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::NoBelief => "no belief",
            Self::Shooting => "shooting, known model",
            Self::Beam => "beam search, known model",
            Self::Learned => "learned",
            Self::TruthFed => "fed with the truth",
        }
    }
}

impl Row<'_> {
    fn value_label(&self, decimals: usize) -> String {
        with_error(Some(self.reward), decimals)
    }

    fn estimator_label(&self) -> String {
        match self.group.estimator {
            "none" => String::new(),
            estimator => format!(" ({})", readable(estimator)),
        }
    }

    fn extent(&self) -> impl Iterator<Item = f64> + '_ {
        let error = self.reward.standard_error.unwrap_or(0.0);
        let worlds = self.worlds.iter().map(|world| world.1);
        worlds.chain([self.reward.mean - error, self.reward.mean + error])
    }
}

impl Plot {
    fn of(rows: &[Row<'_>]) -> Self {
        let widest = |width: &dyn Fn(&Row<'_>) -> f64| rows.iter().map(width).fold(0.0, f64::max);
        let label = |row: &Row<'_>| {
            let policy = TextStyle::LABEL.width(&readable(row.group.policy));
            policy + TextStyle::NOTE.width(&row.estimator_label())
        };
        let decimals = decimals(rows.iter().map(|row| row.reward.mean));
        let values = widest(&|row| TextStyle::LABEL.width(&row.value_label(decimals)));
        let seeds: BTreeSet<u64> = rows
            .iter()
            .flat_map(|row| &row.worlds)
            .map(|w| w.0)
            .collect();
        Self {
            left: MARGIN + widest(&label).min(LABEL_ROOM) + 14.0,
            right: WIDTH - MARGIN - values - 24.0,
            bottom: TOP + ROW * rows.len() as f64,
            axis: Axis::covering(rows.iter().flat_map(Row::extent), 8),
            decimals,
            seeds: seeds.into_iter().collect(),
        }
    }

    fn x(&self, value: f64) -> f64 {
        self.left + self.axis.fraction(value) * (self.right - self.left)
    }
}

fn draw_head(canvas: &mut Canvas<'_>, rows: &[Row<'_>], runs: &[PolicyRun], n_worlds: usize) {
    canvas.text(
        (MARGIN, 36.0),
        Align::Left,
        TextStyle::TITLE,
        "Reward of each policy on the same worlds",
    );
    let steps = runs.iter().map(|run| run.steps).max().unwrap_or(0);
    let note = match n_worlds {
        1 => format!(
            "1 world, {steps} steps: bars are means over steps; one world gives no standard error"
        ),
        n => format!(
            "{n} worlds, {steps} steps each: bars are means over worlds, whiskers ±1 standard error, dots single worlds"
        ),
    };
    canvas.text((MARGIN, 64.0), Align::Left, TextStyle::NOTE, &note);
    let mut left = MARGIN;
    for family in Family::ALL {
        if rows.iter().any(|row| row.family == family) {
            canvas.rectangle((left, 89.0), (left + 14.0, 103.0), family.color());
            canvas.text(
                (left + 21.0, 96.0),
                Align::Left,
                TextStyle::LABEL,
                family.name(),
            );
            left += 21.0 + TextStyle::LABEL.width(family.name()) + 26.0;
        }
    }
}

fn draw_axis(canvas: &mut Canvas<'_>, plot: &Plot, label: &str) {
    for &tick in &plot.axis.ticks {
        let x = plot.x(tick);
        canvas.line(&[(x, TOP), (x, plot.bottom)], 1.0, GRID);
        let at = (x, plot.bottom + 16.0);
        canvas.text(at, Align::Center, TextStyle::NOTE, &plot.axis.label(tick));
    }
    let label = TextStyle::LABEL.fit(label, WIDTH - 2.0 * MARGIN);
    // Centred below the bars, unless a long label has to move left to stay on the page.
    let half = TextStyle::LABEL.width(&label) / 2.0;
    let center = ((plot.left + plot.right) / 2.0).min(WIDTH - MARGIN - half);
    canvas.text(
        (center, plot.bottom + 44.0),
        Align::Center,
        TextStyle::LABEL,
        &label,
    );
}

fn draw_row(canvas: &mut Canvas<'_>, plot: &Plot, row: &Row<'_>, middle: f64) {
    draw_label(canvas, plot, row, middle);
    let (zero, end) = (plot.x(0.0), plot.x(row.reward.mean));
    let (upper, lower) = (middle - BAR / 2.0, middle + BAR / 2.0);
    canvas.rectangle(
        (zero.min(end), upper),
        (zero.max(end), lower),
        row.family.color(),
    );
    let dot = blend(row.family.color(), INK, 0.55);
    if row.worlds.len() > 1 {
        for &(seed, reward) in &row.worlds {
            // One height per world, so that a world can be followed from bar to bar.
            let rank = plot.seeds.binary_search(&seed).unwrap_or(0) as f64 + 0.5;
            let y = upper + BAR * rank / plot.seeds.len() as f64;
            canvas.disc((plot.x(reward), y), 3.5, PAPER);
            canvas.disc((plot.x(reward), y), 2.5, dot);
        }
    }
    if let Some(error) = row.reward.standard_error {
        let ends = (
            plot.x(row.reward.mean - error),
            plot.x(row.reward.mean + error),
        );
        canvas.line(&[(ends.0, middle), (ends.1, middle)], 2.0, INK);
        for x in [ends.0, ends.1] {
            canvas.line(&[(x, middle - 6.0), (x, middle + 6.0)], 2.0, INK);
        }
    }
    let at = (WIDTH - MARGIN, middle);
    canvas.text(
        at,
        Align::Right,
        TextStyle::LABEL,
        &row.value_label(plot.decimals),
    );
}

fn draw_label(canvas: &mut Canvas<'_>, plot: &Plot, row: &Row<'_>, middle: f64) {
    let right = plot.left - 14.0;
    let estimator = TextStyle::NOTE.fit(&row.estimator_label(), LABEL_ROOM / 2.0);
    let estimator_width = TextStyle::NOTE.width(&estimator);
    let style = TextStyle::NOTE.colored(MUTED);
    canvas.text((right, middle), Align::Right, style, &estimator);
    let room = right - MARGIN - estimator_width + 1.0;
    let policy = TextStyle::LABEL.fit(&readable(row.group.policy), room);
    let at = (right - estimator_width, middle);
    canvas.text(at, Align::Right, TextStyle::LABEL, &policy);
}
