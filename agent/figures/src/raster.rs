//! Pixels: an SVG text as a PNG file, and a grid of probabilities as one.

use crate::palette::sequential;
use crate::text::OPTIONS;
use ndarray::ArrayView2;
use resvg::tiny_skia::{Pixmap, PremultipliedColorU8, Transform};
use resvg::usvg::Tree;
use thiserror::Error;

const SCALE: f32 = 2.0;

/// Shorter side that a small grid's picture has at least, pixels, where cells of up to sixteen give it.
const LEAST_SIDE: usize = 256;
const MOST_PIXELS_PER_CELL: usize = 16;

#[derive(Debug, Error, PartialEq, Eq)]
#[error("PNG: {0}")]
pub struct PngError(String);

/// Turns a page into a PNG file of two pixels a point.
pub fn png(svg: &str) -> Result<Vec<u8>, PngError> {
    let tree = Tree::from_str(svg, &OPTIONS).map_err(|error| PngError(error.to_string()))?;
    let size = tree.size().to_int_size().scale_by(SCALE);
    let mut pixels = size
        .and_then(|size| Pixmap::new(size.width(), size.height()))
        .ok_or_else(|| PngError("too large".into()))?;
    resvg::render(
        &tree,
        Transform::from_scale(SCALE, SCALE),
        &mut pixels.as_mut(),
    );
    pixels
        .encode_png()
        .map_err(|error| PngError(error.to_string()))
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Heat {
    pub height: usize,
    pub width: usize,
    pub png: Vec<u8>,
}

/// Turns probabilities into a PNG file, light for 0, dark for 1.
pub fn heat(probabilities: ArrayView2<'_, f32>) -> Result<Heat, PngError> {
    let (height, width) = probabilities.dim();
    let side = LEAST_SIDE.div_ceil(height.min(width).max(1));
    let side = side.clamp(1, MOST_PIXELS_PER_CELL);
    let (height, width) = (height * side, width * side);
    let mut pixels = Pixmap::new(width as u32, height as u32)
        .ok_or_else(|| PngError("too large, or empty".into()))?;
    for (at, pixel) in pixels.pixels_mut().iter_mut().enumerate() {
        let color = sequential(probabilities[[at / width / side, at % width / side]]);
        let opaque = PremultipliedColorU8::from_rgba(color.0, color.1, color.2, u8::MAX);
        *pixel = opaque.expect("invariant: no channel is above an opaque alpha");
    }
    let png = pixels
        .encode_png()
        .map_err(|error| PngError(error.to_string()))?;
    Ok(Heat { height, width, png })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::svg::Svg;

    #[test]
    fn a_page_has_two_pixels_a_point() {
        let mut page = Svg::new();
        let ink = crate::palette::INK;
        page.rectangle((1.5, 1.0), (3.5, 1.5), ink);
        let file = png(&page.finish(10.0, 5.0)).expect("a PNG");
        let pixels = Pixmap::decode_png(&file).expect("a PNG");
        assert_eq!((pixels.width(), pixels.height()), (20, 10));
        let dark = pixels.pixels().iter().enumerate();
        let dark = dark.filter(|(_, pixel)| (pixel.red(), pixel.alpha()) == (ink.0, 255));
        assert_eq!(dark.map(|it| it.0).collect::<Vec<_>>(), [43, 44, 45, 46]);
        assert!(png("<svg").is_err());
        let root = "<svg xmlns=\"http://www.w3.org/2000/svg\"";
        assert!(png(&format!("{root} width=\"1e9\" height=\"1e9\"/>")).is_err());
    }

    #[test]
    fn a_grid_is_dark_where_it_is_certain() {
        let grid = ndarray::arr2(&[[0.0, 1.0, f32::NAN]]);
        let heat = heat(grid.view()).expect("a picture");
        assert_eq!((heat.height, heat.width), (16, 48));
        let pixels = Pixmap::decode_png(&heat.png).expect("a PNG");
        let at = |x| pixels.pixel(x, 15).expect("a pixel");
        let [light, dark] = [0.0, 1.0].map(sequential);
        assert_eq!([at(15).red(), at(16).red()], [light.0, dark.0]);
        assert!(super::heat(ndarray::Array2::zeros((0, 3)).view()).is_err());
    }
}
