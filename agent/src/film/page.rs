//! A scene as a picture: truth, path, belief and entropy side by side, with what they mean.

use super::colors::{BACKGROUND, Colors, FRAME, PEN, Tone, UNKNOWN, shade};
use super::legend::{Entry, LINE, Mark, place};
use super::pen::{Point, TEXT, TITLE, disc, fit, write, write_bold};
use super::scenes::Scene;
use crate::belief::EntropyKind;
use crate::report::figures::text::{self, Weight};
use crate::report::picture::Picture;
use protocol::{Cell, Grid, Model, Shape};

/// Empty rim.
const MARGIN: usize = 14;
/// Between panels.
const GAP: usize = 16;
/// Upper edge of the panels, below step and titles.
const TOP: usize = MARGIN + 54;
/// Narrowest room of a panel, for the sake of its title and legend.
const LEAST_ROOM: usize = 150;
/// The longer side of a panel where no scale is given, with cells of at most [`MOST_SCALE`] pixels.
const SIDE: usize = 200;
const MOST_SCALE: usize = 20;

/// How every scene of a film is laid out.
pub struct Page<'a> {
    model: &'a Model,
    shape: Shape,
    world: u32,
    colors: Colors,
    /// Pixels of a cell's side.
    scale: usize,
    panels: Vec<Panel>,
    /// What all scenes share.
    base: Picture,
    /// Middle of the line of small print.
    foot: usize,
}

/// What a panel shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Panel {
    Truth,
    Path,
    Belief,
    Entropy,
}

impl<'a> Page<'a> {
    /// The layout for a model's worlds. `scale`: pixels of a cell's side, unless told otherwise so many
    /// that a panel is about 200 pixels wide; `has_truth`: whether any hidden states are recorded.
    pub fn new(
        model: &'a Model,
        shape: Shape,
        world: u32,
        scale: Option<usize>,
        has_truth: bool,
    ) -> Self {
        let longer = shape.height().max(shape.width());
        let mut panels = vec![Panel::Truth, Panel::Path, Panel::Belief, Panel::Entropy];
        panels.retain(|&panel| has_truth || panel != Panel::Truth);
        let mut page = Self {
            model,
            shape,
            world,
            colors: Colors::of(model),
            scale: scale.unwrap_or((SIDE / longer).clamp(1, MOST_SCALE)),
            panels,
            base: Picture::new(0, 0, BACKGROUND),
            foot: 0,
        };
        page.lay_out();
        page
    }

    /// Width and height of every picture.
    pub fn size(&self) -> (usize, usize) {
        (self.base.width, self.base.height)
    }

    /// The colours of every picture.
    pub fn colors(&self) -> &Colors {
        &self.colors
    }

    /// Draws a scene.
    pub fn picture(&self, scene: &Scene) -> Picture {
        let mut picture = self.base.clone();
        self.head(&mut picture, scene);
        for (index, &panel) in self.panels.iter().enumerate() {
            let corner = self.corner(index);
            self.fill(&mut picture, corner, scene, panel);
            match panel {
                Panel::Path => self.flight(&mut picture, corner, &scene.path),
                Panel::Truth | Panel::Belief | Panel::Entropy => {}
            }
            if let Some(&robot) = scene.path.last() {
                self.robot(&mut picture, corner, robot);
            }
        }
        let (tone, note) = small_print(scene);
        let room = picture.width - 2 * MARGIN;
        write(
            &mut picture,
            (MARGIN, self.foot),
            (TEXT, tone),
            &fit(&note, room),
        );
        picture
    }

    fn lay_out(&mut self) {
        let n = self.panels.len();
        let width = 2 * MARGIN + n * self.room() + (n - 1) * GAP;
        let legends = self.panels.iter().map(|&panel| self.legend(panel));
        let legends: Vec<Vec<Entry>> = legends.collect();
        let n_lines = legends.iter().flatten().map(|entry| entry.at.1 / LINE + 1);
        let bottom = TOP + self.shape.height() * self.scale;
        let legend_top = bottom + 6;
        self.foot = legend_top + n_lines.max().unwrap_or(1) * LINE + LINE / 2;
        self.base = Picture::new(self.foot + LINE / 2 + MARGIN / 2, width, BACKGROUND);
        for (index, legend) in legends.into_iter().enumerate() {
            let (left, top) = self.corner(index);
            let title = fit(&self.title(self.panels[index]), self.room());
            let base = &mut self.base;
            write(base, (left, top - 13), (TEXT, Tone::Plain), &title);
            for entry in legend {
                let at = (left + entry.at.0, legend_top + entry.at.1 + LINE / 2);
                entry.draw(base, at);
            }
        }
    }

    fn title(&self, panel: Panel) -> String {
        let states = &self.model.file().states;
        match panel {
            Panel::Truth => "truth (hidden)".into(),
            Panel::Path => "seen on this path".into(),
            Panel::Belief => format!("belief: {}", states[self.model.target_state()].name),
            Panel::Entropy => "entropy of the belief".into(),
        }
    }

    /// Width of a panel's place.
    fn room(&self) -> usize {
        LEAST_ROOM.max(self.shape.width() * self.scale)
    }

    fn corner(&self, index: usize) -> Point {
        (MARGIN + index * (self.room() + GAP), TOP)
    }

    fn head(&self, picture: &mut Picture, scene: &Scene) {
        let middle = MARGIN + 8;
        let reward = match scene.reward {
            Some(reward) => format!("reward {}, mean {:.1}", plain(reward), scene.past.mean()),
            None => String::new(),
        };
        let width = text::width(&reward, TITLE, Weight::Bold).ceil() as usize;
        let right = (picture.width - MARGIN).saturating_sub(width);
        let step = format!("step k = {}", scene.step);
        let end = write_bold(picture, (MARGIN, middle), &step);
        let (world, seed) = (self.world, scene.seed);
        let mut place = format!("{}, world {world}, seed {seed}", self.model.name());
        if scene.episode > 0 {
            place += &format!(", episode {}", scene.episode);
        }
        let room = right.saturating_sub(end + 2 * GAP);
        let at = (end + GAP, middle);
        write(picture, at, (TEXT, Tone::Plain), &fit(&place, room));
        write_bold(picture, (right, middle), &reward);
    }

    fn fill(&self, picture: &mut Picture, corner: Point, scene: &Scene, panel: Panel) {
        let (height, width) = self.shape.dim();
        let frame = (corner.0 - 1, corner.1 - 1);
        let size = (width * self.scale + 2, height * self.scale + 2);
        picture.fill(frame, size, FRAME);
        let states = |states: &Grid<u8>| states.mapv(|state| self.colors.state(state));
        let colors = match panel {
            Panel::Truth => scene.truth.as_ref().map(states),
            Panel::Path => {
                let seen = scene.frame.as_ref();
                seen.map(|frame| frame.values().mapv(|value| self.colors.observed(value)))
            }
            Panel::Belief => {
                let target = self.model.target_state();
                Some(scene.belief.probability(target).mapv(shade))
            }
            Panel::Entropy => {
                let most = self.most_entropy();
                let entropy = scene.belief.entropy(EntropyKind::Sum);
                Some(entropy.mapv(|entropy| shade(entropy / most)))
            }
        };
        match colors {
            Some(colors) => self.cells(picture, corner, &colors),
            None => self.lack(picture, corner),
        }
    }

    fn cells(&self, picture: &mut Picture, corner: Point, colors: &Grid<u8>) {
        for ((row, col), &color) in colors.indexed_iter() {
            let at = (corner.0 + col * self.scale, corner.1 + row * self.scale);
            picture.fill(at, (self.scale, self.scale), color);
        }
    }

    /// A panel of what is not recorded.
    fn lack(&self, picture: &mut Picture, corner: Point) {
        let (height, width) = self.shape.dim();
        let size = (width * self.scale, height * self.scale);
        picture.fill(corner, size, UNKNOWN);
        let note = "not recorded";
        let room = text::width(note, TEXT, Weight::Regular).ceil() as usize + 12;
        if room < size.0 && LINE < size.1 {
            let (left, middle) = (corner.0 + (size.0 - room) / 2, corner.1 + size.1 / 2);
            picture.fill((left, middle - LINE / 2), (room, LINE), BACKGROUND);
            write(picture, (left + 6, middle), (TEXT, Tone::Warning), note);
        }
    }

    fn flight(&self, picture: &mut Picture, corner: Point, path: &[Cell]) {
        // Thin against the cells, whose colours it must not hide.
        let width = (self.scale / 4).max(1);
        for leg in path.windows(2) {
            let [from, to] = [self.center(corner, leg[0]), self.center(corner, leg[1])];
            let at = (from.0.min(to.0), from.1.min(to.1));
            let size = (from.0.abs_diff(to.0) + width, from.1.abs_diff(to.1) + width);
            let half = (width - 1) / 2;
            picture.fill((at.0 - half, at.1 - half), size, PEN);
        }
    }

    fn robot(&self, picture: &mut Picture, corner: Point, robot: Cell) {
        let center = self.center(corner, robot);
        let radius = (self.scale / 2).clamp(4, 8) as isize;
        disc(picture, center, radius, BACKGROUND);
        disc(picture, center, radius - 1, PEN);
        disc(picture, center, radius - 3, BACKGROUND);
    }

    fn center(&self, corner: Point, cell: Cell) -> Point {
        let middle = |cell: usize| cell * self.scale + self.scale / 2;
        (corner.0 + middle(cell.col), corner.1 + middle(cell.row))
    }

    /// Of a cell about which nothing is known, in nats.
    fn most_entropy(&self) -> f32 {
        (self.model.n_states() as f32).ln().max(f32::MIN_POSITIVE)
    }

    /// What the colours of a panel mean, from its left lower corner on.
    fn legend(&self, panel: Panel) -> Vec<Entry> {
        let file = self.model.file();
        let states = file.states.iter().map(|state| state.name.as_str());
        let values = file.observations.iter().map(|seen| seen.name.as_str());
        let colors = &self.colors;
        let color = |(index, name): (usize, &str), of: &dyn Fn(u8) -> u8| {
            (Mark::Color(of(index as u8)), name.to_owned())
        };
        let marks = match panel {
            Panel::Truth => states
                .enumerate()
                .map(|it| color(it, &|n| colors.state(n)))
                .collect(),
            Panel::Path => {
                let values = values
                    .enumerate()
                    .map(|it| color(it, &|n| colors.observed(n)));
                // Those of the truth say it already.
                let said = colors.is_plain && self.panels.contains(&Panel::Truth);
                let values = values.filter(|_| !said);
                let rest = [
                    (Mark::Color(UNKNOWN), "not seen".to_owned()),
                    (Mark::Robot, "robot".into()),
                ];
                values.chain(rest).collect()
            }
            Panel::Belief => vec![(Mark::Scale, "1".into())],
            Panel::Entropy => vec![(Mark::Scale, format!("{:.2} nats", self.most_entropy()))],
        };
        place(marks, self.room())
    }
}

/// What a scene must not hide, and whether it warns.
fn small_print(scene: &Scene) -> (Tone, String) {
    let past = &scene.past;
    if scene.n_lost > 0 {
        let first = scene.step + 1 - scene.n_lost;
        let what = match scene.n_lost {
            1 => format!("step {first} is"),
            _ => format!("steps {first} to {} are", scene.step),
        };
        return (
            Tone::Warning,
            format!("{what} not recorded: the belief is only predicted"),
        );
    }
    let mut parts = Vec::new();
    if past.since > 0 {
        parts.push(format!("the belief begins at step {}", past.since));
    }
    if past.n_lost > 0 {
        parts.push(format!(
            "{} steps before this one are not recorded",
            past.n_lost
        ));
    }
    (Tone::Plain, parts.join("; "))
}

fn plain(reward: f64) -> String {
    match reward.fract() {
        0.0 => format!("{reward:.0}"),
        _ => format!("{reward:.1}"),
    }
}
