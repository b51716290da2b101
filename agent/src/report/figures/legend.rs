//! What the colours and marks of a snapshot mean, and how the marks look.

use super::canvas::{Align, Canvas, Point, TextStyle};
use super::palette::{INK, MUTED, PAPER, unlike};
use super::{MARGIN, WIDTH};
use plotters::style::RGBColor;
use protocol::Model;
use protocol::model::parse_color;

/// Height of a line of the legend.
const LINE: f64 = 26.0;
const SWATCH: f64 = 14.0;

/// Colours of a model, and the grey for what was not observed.
pub struct Colors {
    /// By state.
    pub states: Vec<RGBColor>,
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
pub struct Entry {
    mark: Mark,
    name: String,
    at: Point,
}

impl Colors {
    /// The colours that the model's file names.
    pub fn of(model: &Model) -> Self {
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

    /// Colour of an observed value, the grey for one that is none.
    pub fn observed(&self, value: u8) -> RGBColor {
        let color = self.observations.get(usize::from(value));
        color.copied().unwrap_or(self.unobserved)
    }
}

/// Entries of the legend from `corner` on, broken into lines, and the height of those.
pub fn legend(model: &Model, colors: &Colors, corner: Point) -> (Vec<Entry>, f64) {
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
        place(&[marks.collect()], corner)
    } else {
        let states = heading("state:").chain(states.map(swatch)).collect();
        let observations = heading("observed value:").chain(observations.map(swatch));
        place(&[states, observations.chain(path).collect()], corner)
    }
}

/// Places each group of marks on lines of its own.
fn place(groups: &[Vec<(Mark, String)>], (left, top): Point) -> (Vec<Entry>, f64) {
    let mut entries = Vec::new();
    let mut middle = top;
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
    (entries, middle - top)
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

/// Draws one mark with its name.
pub fn draw_entry(canvas: &mut Canvas<'_>, entry: &Entry) {
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

/// Draws a path of straight legs, with a white rim where cells are wide enough to show beside it.
pub fn draw_path(canvas: &mut Canvas<'_>, points: &[Point], width: f64, rim: f64) {
    for (half, color) in [(width / 2.0 + rim, PAPER), (width / 2.0, INK)] {
        for ends in points.windows(2) {
            let ((x0, y0), (x1, y1)) = (ends[0], ends[1]);
            // A leg runs along a row or a column, so it is a rectangle, without blurred edges.
            let from = (x0.min(x1) - half, y0.min(y1) - half);
            canvas.rectangle(from, (x0.max(x1) + half, y0.max(y1) + half), color);
        }
    }
}

/// Draws the mark of the path's first cell.
pub fn draw_start(canvas: &mut Canvas<'_>, (x, y): Point, half: f64) {
    canvas.rectangle((x - half, y - half), (x + half, y + half), INK);
    let inner = half - 1.5;
    canvas.rectangle((x - inner, y - inner), (x + inner, y + inner), PAPER);
}

/// Draws the mark of the robot's cell.
pub fn draw_robot(canvas: &mut Canvas<'_>, center: Point, radius: f64) {
    canvas.disc(center, radius, PAPER);
    canvas.disc(center, radius - 1.0, INK);
    canvas.disc(center, radius - 2.5, PAPER);
    canvas.disc(center, (radius - 4.5).max(1.0), INK);
}
