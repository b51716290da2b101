//! The legend of a snapshot, and the marks that it explains.

use crate::palette::{Color, INK, MUTED, PAPER};
use crate::svg::{Align, MARGIN, Point, Svg, WIDTH};
use crate::text::TextStyle;

/// The name and colour of a state or of an observation.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Named {
    pub name: String,
    pub color: Color,
}

const LINE: f64 = 26.0;
const SWATCH: f64 = 14.0;

#[derive(Debug, Clone, Copy)]
enum Mark {
    /// No mark, only the heading of a group.
    Heading,
    Color(Color),
    Path,
    Start,
    Robot,
}

/// Draws the legend at `corner`. Each group of marks begins on a new line. If states and observations have the same
/// names and colours, they form one group. Returns the height of the legend.
pub fn draw_legend(
    page: &mut Svg,
    states: &[Named],
    observations: &[Named],
    unobserved: Color,
    corner: Point,
) -> f64 {
    let (left, top) = corner;
    let mut middle = top;
    for group in groups(states, observations, unobserved) {
        let mut x = left;
        for (mark, name) in group {
            let name = TextStyle::LABEL.fit(&name, WIDTH - left - MARGIN - 30.0);
            let width = mark.width() + TextStyle::LABEL.width(&name);
            if x > left && x + width > WIDTH - MARGIN {
                (x, middle) = (left, middle + LINE);
            }
            mark.draw(page, (x, middle));
            let at = (x + mark.width(), middle);
            page.text(at, Align::Left, mark.style(), &name);
            x += width + if mark.width() > 0.0 { 24.0 } else { 12.0 };
        }
        middle += LINE;
    }
    middle - top
}

/// Returns the marks and their names, grouped.
fn groups(states: &[Named], observations: &[Named], unobserved: Color) -> Vec<Vec<(Mark, String)>> {
    let group = |heading: &str, named: &[Named]| {
        let heading = (Mark::Heading, heading.to_owned());
        let marks = named
            .iter()
            .map(|it| (Mark::Color(it.color), it.name.clone()));
        std::iter::once(heading).chain(marks).collect::<Vec<_>>()
    };
    let mut groups = if states == observations {
        vec![group("state, observed value:", states)]
    } else {
        vec![
            group("state:", states),
            group("observed value:", observations),
        ]
    };
    if let Some(last) = groups.last_mut() {
        last.push((Mark::Color(unobserved), "not observed".into()));
        last.extend([(Mark::Path, "path".into()), (Mark::Start, "start".into())]);
        last.push((Mark::Robot, "robot".into()));
    }
    groups
}

impl Mark {
    /// Returns the width of the mark and the space after it.
    fn width(self) -> f64 {
        match self {
            Self::Heading => 0.0,
            Self::Path => SWATCH + 16.0,
            Self::Color(_) | Self::Start | Self::Robot => SWATCH + 7.0,
        }
    }

    fn style(self) -> TextStyle {
        match self {
            Self::Heading => TextStyle::LABEL.colored(MUTED),
            _ => TextStyle::LABEL,
        }
    }

    fn draw(self, page: &mut Svg, (x, y): Point) {
        let middle = (x + SWATCH / 2.0, y);
        match self {
            Self::Heading => {}
            Self::Color(color) => {
                let (from, to) = ((x, y - SWATCH / 2.0), (x + SWATCH, y + SWATCH / 2.0));
                page.rectangle(from, to, color);
                page.outline(from, to, 0.5, MUTED);
            }
            Self::Path => draw_path(page, &[(x + 2.0, y), (x + SWATCH + 7.0, y)], 2.0, 0.0),
            Self::Start => draw_start(page, middle, 4.5),
            Self::Robot => draw_robot(page, middle, 6.5),
        }
    }
}

/// Draws a path of horizontal and vertical segments. `rim` is the width of its white rim, in points.
pub fn draw_path(page: &mut Svg, points: &[Point], width: f64, rim: f64) {
    for (half, color) in [(width / 2.0 + rim, PAPER), (width / 2.0, INK)] {
        for ends in points.windows(2) {
            let ((x0, y0), (x1, y1)) = (ends[0], ends[1]);
            // Segments run along rows or columns, so they are drawn as rectangles, whose edges are sharp.
            let from = (x0.min(x1) - half, y0.min(y1) - half);
            page.rectangle(from, (x0.max(x1) + half, y0.max(y1) + half), color);
        }
    }
}

/// Draws the mark of the path's first cell.
pub fn draw_start(page: &mut Svg, (x, y): Point, half: f64) {
    page.rectangle((x - half, y - half), (x + half, y + half), INK);
    let inner = half - 1.5;
    page.rectangle((x - inner, y - inner), (x + inner, y + inner), PAPER);
}

pub fn draw_robot(page: &mut Svg, center: Point, radius: f64) {
    page.disc(center, radius, PAPER);
    page.disc(center, radius - 1.0, INK);
    page.disc(center, radius - 2.5, PAPER);
    page.disc(center, (radius - 4.5).max(1.0), INK);
}
