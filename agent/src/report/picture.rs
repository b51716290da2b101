//! Pictures of few colours: a byte a pixel, the number of a colour in a palette.

use super::figures::palette::sequential;
use crate::belief::Belief;
use plotters::style::RGBColor;

/// Shorter side that a small grid's picture has at least, pixels, where cells of up to sixteen give it.
const LEAST_SIDE: usize = 256;
const MOST_PIXELS_PER_CELL: usize = 16;

/// A picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Picture {
    /// Height in pixels.
    pub height: usize,
    /// Width in pixels.
    pub width: usize,
    /// The colours' numbers, row by row.
    pub pixels: Vec<u8>,
}

impl Picture {
    /// One colour everywhere.
    pub fn new(height: usize, width: usize, color: u8) -> Self {
        let pixels = vec![color; height * width];
        Self {
            height,
            width,
            pixels,
        }
    }

    /// Fills a rectangle given by its left upper corner and its size, as far as it is in the picture.
    pub fn fill(&mut self, (left, top): (usize, usize), size: (usize, usize), color: u8) {
        let right = self.width.min(left + size.0);
        for row in top..self.height.min(top + size.1) {
            if left < right {
                self.pixels[row * self.width..][left..right].fill(color);
            }
        }
    }

    /// The picture as a PNG file with a palette.
    ///
    /// # Errors
    /// What the encoder says.
    pub fn png(&self, palette: &[RGBColor]) -> Result<Vec<u8>, png::EncodingError> {
        let mut file = Vec::new();
        let mut encoder = png::Encoder::new(&mut file, self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Indexed);
        encoder.set_palette(channels(palette));
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&self.pixels)?;
        writer.finish()?;
        Ok(file)
    }
}

/// A palette as encoders want it.
pub fn channels(palette: &[RGBColor]) -> Vec<u8> {
    let channels = palette.iter().flat_map(|color| [color.0, color.1, color.2]);
    channels.collect()
}

/// The probability of a state in every cell, light for 0, dark for 1; and the same as a PNG file.
pub fn belief_picture(belief: &Belief, state: usize) -> (Picture, Vec<u8>) {
    let probability = belief.probability(state);
    let (height, width) = probability.dim();
    let side = LEAST_SIDE.div_ceil(height.min(width));
    let side = side.clamp(1, MOST_PIXELS_PER_CELL);
    let mut picture = Picture::new(height * side, width * side, 0);
    for ((row, col), &p) in probability.indexed_iter() {
        let level = (p.clamp(0.0, 1.0) * 255.0).round() as u8;
        picture.fill((col * side, row * side), (side, side), level);
    }
    let palette: Vec<RGBColor> = (0..=255_u8)
        .map(|level| sequential(f32::from(level) / 255.0))
        .collect();
    let file = picture.png(&palette);
    let file = file.expect("invariant: a picture of a grid fits a PNG in memory");
    (picture, file)
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::{Grid, Shape};

    #[test]
    fn rectangles_end_at_the_edge() {
        let mut picture = Picture::new(2, 3, 0);
        picture.fill((2, 1), (9, 9), 1);
        picture.fill((3, 0), (1, 1), 2);
        picture.fill((0, 0), (1, 1), 3);
        assert_eq!(picture.pixels, [3, 0, 0, 0, 0, 1]);
    }

    #[test]
    fn a_belief_is_dark_where_it_is_certain() {
        let shape = Shape::new(1, 2).expect("test shape");
        let states = Grid::from_shape_vec(shape.dim(), vec![0, 1]).expect("test grid");
        let belief = Belief::from_states(&states, 2).expect("test states");
        let (picture, file) = belief_picture(&belief, 1);
        assert_eq!((picture.height, picture.width), (16, 32));
        assert_eq!([picture.pixels[15], picture.pixels[16]], [0, 255]);
        let mut decoder = png::Decoder::new(&file[..]);
        decoder.set_transformations(png::Transformations::EXPAND);
        let mut reader = decoder.read_info().expect("a PNG");
        let mut pixels = vec![0; reader.output_buffer_size()];
        reader.next_frame(&mut pixels).expect("a whole PNG");
        let colors = [0.0, 1.0].map(sequential);
        assert_eq!(
            [&pixels[45..48], &pixels[48..51]].concat(),
            channels(&colors)
        );
    }
}
