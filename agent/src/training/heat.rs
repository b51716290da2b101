//! Heat maps: grids of probabilities as PNG files, because TensorBoard cannot show SVG.

use emberwatch_protocol::Grid;
use plotters::prelude::ViridisRGB;
use png::{BitDepth, ColorType, Encoder, EncodingError};

/// Minimum length of an image's shorter side in pixels, unless cells would exceed [`MAX_PIXELS_PER_CELL`].
const MIN_SIDE: usize = 256;
const MAX_PIXELS_PER_CELL: usize = 16;

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
pub fn heat(probabilities: &Grid<f32>) -> Result<Heat, EncodingError> {
    let (height, width) = probabilities.dim();
    let side = MIN_SIDE.div_ceil(height.min(width).max(1));
    let side = side.clamp(1, MAX_PIXELS_PER_CELL);
    let (height, width) = (height * side, width * side);
    let mut pixels = Vec::new();
    for at in 0..height * width {
        // The maximum of NaN and 0 is 0.
        let probability = probabilities[[at / width / side, at % width / side]].max(0.0);
        let color = ViridisRGB::get_color(1.0 - probability.min(1.0));
        pixels.extend([color.0, color.1, color.2]);
    }
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
        let grid = Grid::from_shape_vec((1, 3), vec![0.0, 1.0, f32::NAN]).expect("a grid");
        let heat = heat(&grid).expect("a picture");
        assert_eq!((heat.height, heat.width), (16, 48));
        let decoder = png::Decoder::new(std::io::Cursor::new(heat.png));
        let mut reader = decoder.read_info().expect("a PNG");
        let mut pixels = vec![0; 16 * 48 * 3];
        reader.next_frame(&mut pixels).expect("pixels");
        let red = [15, 16, 47].map(|x| pixels[(15 * 48 + x) * 3]);
        assert!(red[0] > 200 && red[1] < 100 && red[2] == red[0], "{red:?}");
        assert!(super::heat(&Grid::zeros((0, 3))).is_err());
    }
}
