//! A white page to draw on, in points from its upper left corner, saved as PNG or SVG.
//!
//! A thin layer over plotters' backends: it doubles the resolution, places text, and keeps the first
//! failure until the page is saved, so that drawing code reads as drawing.

use super::lettering::Lettering;
use super::palette::{INK, PAPER};
use super::text::{self, Weight};
use crate::report::{ReportError, replace_file};
use plotters::coord::Shift;
use plotters::element::{Drawable, PointCollection};
use plotters::prelude::*;
use std::fmt::Display;
use std::path::Path;

/// Pixels per point.
pub const SCALE: f64 = 2.0;

/// A position in points: right of the left edge, below the upper edge.
pub type Point = (f64, f64);

/// Where a text's horizontal position lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Align {
    /// At its start.
    Left,
    /// In its middle.
    Center,
    /// At its end.
    Right,
}

/// How a text looks.
#[derive(Debug, Clone, Copy)]
pub struct TextStyle {
    /// Points per em.
    pub size: f64,
    /// Weight.
    pub weight: Weight,
    /// Colour.
    pub color: RGBColor,
}

impl TextStyle {
    /// A title.
    pub const TITLE: Self = Self::new(20.0, Weight::Bold, INK);
    /// A label.
    pub const LABEL: Self = Self::new(14.0, Weight::Regular, INK);
    /// A label that stands out.
    pub const STRONG: Self = Self::new(14.0, Weight::Bold, INK);
    /// A note.
    pub const NOTE: Self = Self::new(13.0, Weight::Regular, super::palette::MUTED);

    const fn new(size: f64, weight: Weight, color: RGBColor) -> Self {
        Self {
            size,
            weight,
            color,
        }
    }

    /// Width of a text in points.
    pub fn width(self, text: &str) -> f64 {
        f64::from(text::width(text, self.pixels(), self.weight)) / SCALE
    }

    /// The text, shortened with an ellipsis where it is wider than `room` points.
    pub fn fit(self, text: &str, room: f64) -> String {
        text::fit(text, (room * SCALE) as f32, self.pixels(), self.weight)
    }

    /// The same in another colour.
    pub fn colored(self, color: RGBColor) -> Self {
        Self { color, ..self }
    }

    fn pixels(self) -> f32 {
        (self.size * SCALE) as f32
    }
}

/// The page.
pub struct Canvas<'a> {
    surface: Surface<'a>,
    failure: Option<String>,
}

/// What a page is made of.
enum Surface<'a> {
    Pixels(DrawingArea<BitMapBackend<'a>, Shift>),
    /// Texts are written by themselves, in the viewer's font.
    Shapes(DrawingArea<SVGBackend<'a>, Shift>, Lettering),
}

/// Draws a page of the given size in points and puts it at `path` when it is complete: as SVG where the
/// path ends so, else as PNG.
///
/// # Errors
/// [`ReportError::Write`] names `path`.
pub fn draw_page(
    path: &Path,
    size: Point,
    draw: impl FnOnce(&mut Canvas<'_>),
) -> Result<(), ReportError> {
    let pixels = ((size.0 * SCALE) as u32, (size.1 * SCALE) as u32);
    let is_svg = path.extension().is_some_and(|extension| extension == "svg");
    if is_svg {
        return replace_file(path, "svg", |temporary| {
            let svg = draw_shapes(pixels, draw)?;
            std::fs::write(temporary, svg).map_err(|error| error.to_string())
        });
    }
    replace_file(path, "png", |temporary| {
        let area = BitMapBackend::new(temporary, pixels).into_drawing_area();
        Canvas::of(Surface::Pixels(area)).draw(draw).map(|_| ())
    })
}

fn draw_shapes(pixels: (u32, u32), draw: impl FnOnce(&mut Canvas<'_>)) -> Result<String, String> {
    let mut shapes = String::new();
    let area = SVGBackend::with_string(&mut shapes, pixels).into_drawing_area();
    let surface = Surface::Shapes(area, Lettering::default());
    let lettering = match Canvas::of(surface).draw(draw)? {
        Surface::Shapes(_, lettering) => lettering,
        Surface::Pixels(_) => Lettering::default(),
    };
    Ok(lettering.over(&shapes))
}

impl<'a> Canvas<'a> {
    fn of(surface: Surface<'a>) -> Self {
        Self {
            surface,
            failure: None,
        }
    }

    /// Draws everything.
    fn draw(mut self, draw: impl FnOnce(&mut Self)) -> Result<Surface<'a>, String> {
        let filled = match &self.surface {
            Surface::Pixels(area) => area.fill(&PAPER).map_err(|error| error.to_string()),
            Surface::Shapes(area, _) => area.fill(&PAPER).map_err(|error| error.to_string()),
        };
        self.keep(filled);
        draw(&mut self);
        let saved = match &self.surface {
            Surface::Pixels(area) => area.present().map_err(|error| error.to_string()),
            Surface::Shapes(area, _) => area.present().map_err(|error| error.to_string()),
        };
        self.keep(saved);
        self.failure.map_or(Ok(self.surface), Err)
    }

    fn put<E>(&mut self, element: &E)
    where
        for<'b> &'b E: PointCollection<'b, (i32, i32)>,
        E: Drawable<BitMapBackend<'a>> + Drawable<SVGBackend<'a>>,
    {
        let drawn = match &self.surface {
            Surface::Pixels(area) => area.draw(element).map_err(|error| error.to_string()),
            Surface::Shapes(area, _) => area.draw(element).map_err(|error| error.to_string()),
        };
        self.keep(drawn);
    }

    /// Fills a rectangle.
    pub fn rectangle(&mut self, from: Point, to: Point, color: RGBColor) {
        let (from, to) = (pixel(from), pixel(to));
        self.pixel_rectangle(from, (to.0 - from.0, to.1 - from.1), color);
    }

    /// Fills a rectangle given by its corner and its size in pixels.
    pub fn pixel_rectangle(&mut self, at: (i32, i32), size: (i32, i32), color: RGBColor) {
        if size.0 < 1 || size.1 < 1 {
            return;
        }
        // A filled rectangle of plotters leaves out its lower right edges, unlike an outlined one.
        let corner = (at.0 + size.0, at.1 + size.1);
        self.put(&Rectangle::new([at, corner], color.filled()));
    }

    /// Outlines a rectangle, inside its bounds.
    pub fn outline(&mut self, from: Point, to: Point, width: f64, color: RGBColor) {
        self.rectangle(from, (to.0, from.1 + width), color);
        self.rectangle((from.0, to.1 - width), to, color);
        self.rectangle(from, (from.0 + width, to.1), color);
        self.rectangle((to.0 - width, from.1), to, color);
    }

    /// A line through points, with round joints.
    pub fn line(&mut self, points: &[Point], width: f64, color: RGBColor) {
        let stroke = (width * SCALE).round().max(1.0) as u32;
        if let Surface::Shapes(..) = self.surface {
            let points: Vec<(i32, i32)> = points.iter().copied().map(pixel).collect();
            return self.put(&PathElement::new(points, color.stroke_width(stroke)));
        }
        for ends in points.windows(2) {
            // One segment at a time: plotters' mitred joints grow spikes at sharp angles.
            let ends = [pixel(ends[0]), pixel(ends[1])];
            if ends[0] != ends[1] {
                self.put(&PathElement::new(ends, color.stroke_width(stroke)));
            }
        }
        if stroke > 2 && points.len() > 2 {
            for &joint in &points[1..points.len() - 1] {
                self.disc(joint, width / 2.0, color);
            }
        }
    }

    /// Fills a polygon.
    pub fn polygon(&mut self, points: &[Point], color: RGBColor) {
        self.veil(points, color, 1.0);
    }

    /// Fills a polygon through which what is under it is seen, unless `opacity` is 1.
    pub fn veil(&mut self, points: &[Point], color: RGBColor, opacity: f64) {
        let points: Vec<(i32, i32)> = points.iter().copied().map(pixel).collect();
        self.put(&Polygon::new(points, color.mix(opacity).filled()));
    }

    /// Fills a disc.
    pub fn disc(&mut self, center: Point, radius: f64, color: RGBColor) {
        let radius = (radius * SCALE).round() as i32;
        self.put(&Circle::new(pixel(center), radius, color.filled()));
    }

    /// Writes a text whose capitals are centred on the height of `at`.
    pub fn text(&mut self, at: Point, align: Align, style: TextStyle, text: &str) {
        let shift = match align {
            Align::Left => 0.0,
            Align::Center => style.width(text) / 2.0,
            Align::Right => style.width(text),
        };
        let start = (((at.0 - shift) * SCALE) as f32, (at.1 * SCALE) as f32);
        let (size, weight) = (style.pixels(), style.weight);
        let mut failure = Ok(());
        match &mut self.surface {
            Surface::Shapes(_, lettering) => lettering.add(text, start, style),
            Surface::Pixels(area) => text::rasterize(text, start, size, weight, |x, y, part| {
                let color = style.color.mix(f64::from(part.min(1.0)));
                if failure.is_ok() {
                    failure = area.draw_pixel((x, y), &color);
                }
            }),
        }
        self.keep(failure);
    }

    fn keep<E: Display>(&mut self, result: Result<(), E>) {
        if let (Err(error), None) = (result, &self.failure) {
            self.failure = Some(error.to_string());
        }
    }
}

fn pixel(point: Point) -> (i32, i32) {
    (
        (point.0 * SCALE).round() as i32,
        (point.1 * SCALE).round() as i32,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rectangles_fill_exactly_their_pixels() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("page.png");
        let drawn = draw_page(&path, (10.0, 5.0), |canvas| {
            canvas.pixel_rectangle((3, 2), (4, 1), INK);
            canvas.pixel_rectangle((19, 9), (1, 1), INK);
            canvas.pixel_rectangle((0, 0), (0, 5), INK);
        });
        assert_eq!(drawn, Ok(()));
        let file = std::io::BufReader::new(std::fs::File::open(&path).expect("a file"));
        let mut reader = png::Decoder::new(file).read_info().expect("a PNG");
        let mut pixels = vec![0; reader.output_buffer_size()];
        reader.next_frame(&mut pixels).expect("a whole PNG");
        let dark = (0..200).filter(|at| pixels[3 * at..3 * at + 3] == [INK.0, INK.1, INK.2]);
        assert_eq!(dark.collect::<Vec<_>>(), [43, 44, 45, 46, 199]);
        assert_eq!(pixels.iter().filter(|&&channel| channel != 255).count(), 15);
    }
}
