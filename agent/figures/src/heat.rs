//! Heat maps: grids of probabilities as PNG files.

use crate::palette::sequential;
use ndarray::ArrayView2;
use png::{BitDepth, ColorType, Encoder, EncodingError};

/// Minimum length of an image's shorter side in pixels, unless cells would exceed [`MAX_PIXELS_PER_CELL`].
const MIN_SIDE: usize = 256;
const MAX_PIXELS_PER_CELL: usize = 16;

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Heat {
    pub height: usize,
    pub width: usize,
    pub png: Vec<u8>,
}

/// Draws probabilities `[H, W]`, light for 0 and NaN, dark for 1. The height and width of the result are in pixels.
///
/// # Errors
///
/// If the grid has no cells, or more cells than a PNG file permits.
pub fn heat(probabilities: ArrayView2<'_, f32>) -> Result<Heat, EncodingError> {
    let (height, width) = probabilities.dim();
    let side = MIN_SIDE.div_ceil(height.min(width).max(1));
    let side = side.clamp(1, MAX_PIXELS_PER_CELL);
    let (height, width) = (height * side, width * side);
    let cells = (0..height * width)
        .map(|at| probabilities[[at / width / side, at % width / side]])
        .map(sequential);
    let pixels: Vec<u8> = cells
        .flat_map(|color| [color.0, color.1, color.2])
        .collect();
    let mut png = Vec::new();
    let mut encoder = Encoder::new(&mut png, width as u32, height as u32);
    encoder.set_color(ColorType::Rgb);
    encoder.set_depth(BitDepth::Eight);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&pixels)?;
    writer.finish()?;
    Ok(Heat { height, width, png })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn certain_cells_are_dark() {
        let grid = ndarray::arr2(&[[0.0, 1.0, f32::NAN]]);
        let heat = heat(grid.view()).expect("a picture");
        assert_eq!((heat.height, heat.width), (16, 48));
        let decoder = png::Decoder::new(std::io::Cursor::new(heat.png));
        let mut reader = decoder.read_info().expect("a PNG");
        let mut pixels = vec![0; 16 * 48 * 3];
        reader.next_frame(&mut pixels).expect("pixels");
        let at = |x: usize| pixels[(15 * 48 + x) * 3];
        let [light, dark] = [0.0, 1.0].map(sequential);
        assert_eq!([at(15), at(16)], [light.0, dark.0]);
        assert!(super::heat(ndarray::Array2::zeros((0, 3)).view()).is_err());
    }
}
