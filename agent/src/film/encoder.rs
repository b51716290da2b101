//! Pictures into GIF and animated PNG: of each only what changed, so that files stay small.

use super::colors::CLEAR;
use crate::report::picture::{Picture, channels};
use plotters::style::RGBColor;
use std::borrow::Cow;
use thiserror::Error;

/// A kind of film.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// GIF.
    Gif,
    /// Animated PNG.
    Apng,
}

/// Most pixels of a side: what a GIF can tell.
pub const MOST_PIXELS: usize = 65_535;

/// A picture, and how long it is shown.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Shot {
    /// The picture.
    pub picture: Picture,
    /// Hundredths of a second.
    pub centis: u16,
}

/// A picture that no file holds.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// GIF.
    #[error("GIF: {0}")]
    Gif(#[from] gif::EncodingError),
    /// PNG.
    #[error("PNG: {0}")]
    Png(#[from] png::EncodingError),
}

/// The bytes of a file that shows exactly `n_shots` again and again, all of one size in pixels (width,
/// height).
///
/// # Errors
/// [`EncodeError`], and what a shot fails with.
pub fn encode<E: From<EncodeError>>(
    format: Format,
    size: (usize, usize),
    palette: &[RGBColor],
    (n_shots, shots): (u32, impl Iterator<Item = Result<Shot, E>>),
) -> Result<Vec<u8>, E> {
    match format {
        Format::Gif => gif(size, palette, shots),
        Format::Apng => apng(size, palette, n_shots, shots),
    }
}

fn gif<E: From<EncodeError>>(
    (width, height): (usize, usize),
    palette: &[RGBColor],
    shots: impl Iterator<Item = Result<Shot, E>>,
) -> Result<Vec<u8>, E> {
    let wrong = |error: gif::EncodingError| E::from(error.into());
    let [width, height] = [width, height].map(short);
    let encoder = gif::Encoder::new(Vec::new(), width, height, &channels(palette));
    let mut encoder = encoder.map_err(wrong)?;
    encoder.set_repeat(gif::Repeat::Infinite).map_err(wrong)?;
    let mut before = None;
    for shot in shots {
        let Shot { picture, centis } = shot?;
        let patch = Patch::between(before.as_ref(), &picture);
        let frame = gif::Frame {
            delay: centis,
            dispose: gif::DisposalMethod::Keep,
            transparent: Some(CLEAR),
            left: short(patch.left),
            top: short(patch.top),
            width: short(patch.picture.width),
            height: short(patch.picture.height),
            buffer: Cow::Owned(patch.picture.pixels),
            ..gif::Frame::default()
        };
        encoder.write_frame(&frame).map_err(wrong)?;
        before = Some(picture);
    }
    encoder.into_inner().map_err(wrong)
}

fn apng<E: From<EncodeError>>(
    (width, height): (usize, usize),
    palette: &[RGBColor],
    n_shots: u32,
    shots: impl Iterator<Item = Result<Shot, E>>,
) -> Result<Vec<u8>, E> {
    let wrong = |error: png::EncodingError| E::from(error.into());
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, width as u32, height as u32);
    encoder.set_color(png::ColorType::Indexed);
    encoder.set_palette(channels(palette));
    // Of the palette's colours the first alone is transparent.
    encoder.set_trns(vec![0]);
    encoder.set_animated(n_shots, 0).map_err(wrong)?;
    encoder.set_blend_op(png::BlendOp::Over).map_err(wrong)?;
    let mut writer = encoder.write_header().map_err(wrong)?;
    let mut before = None;
    for shot in shots {
        let Shot { picture, centis } = shot?;
        let patch = Patch::between(before.as_ref(), &picture);
        patch.write(&mut writer, centis).map_err(wrong)?;
        before = Some(picture);
    }
    writer.finish().map_err(wrong)?;
    Ok(file)
}

/// What differs between two pictures.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Patch {
    left: usize,
    top: usize,
    picture: Picture,
}

impl Patch {
    /// The least rectangle that holds what changed, clear where nothing did; at least a pixel.
    fn between(before: Option<&Picture>, after: &Picture) -> Self {
        let Some(before) = before else {
            return Self {
                left: 0,
                top: 0,
                picture: after.clone(),
            };
        };
        let (width, changed) = (after.width, changes(before, after));
        let rows = changed.iter().map(|at| at / width);
        let columns = changed.iter().map(|at| at % width);
        let (left, top) = (
            columns.clone().min().unwrap_or(0),
            rows.clone().min().unwrap_or(0),
        );
        let right = columns.max().unwrap_or(left);
        let bottom = rows.max().unwrap_or(top);
        let mut picture = Picture::new(bottom + 1 - top, right + 1 - left, CLEAR);
        for at in changed {
            let (row, column) = (at / width - top, at % width - left);
            picture.pixels[row * picture.width + column] = after.pixels[at];
        }
        Self { left, top, picture }
    }

    fn write<W: std::io::Write>(
        &self,
        writer: &mut png::Writer<W>,
        centis: u16,
    ) -> Result<(), png::EncodingError> {
        let Picture {
            height,
            width,
            pixels,
        } = &self.picture;
        writer.set_frame_delay(centis, 100)?;
        writer.reset_frame_position()?;
        writer.set_frame_dimension(*width as u32, *height as u32)?;
        writer.set_frame_position(self.left as u32, self.top as u32)?;
        writer.write_image_data(pixels)
    }
}

/// Where two pictures differ.
fn changes(before: &Picture, after: &Picture) -> Vec<usize> {
    let pixels = before.pixels.iter().zip(&after.pixels).enumerate();
    let changed = pixels.filter(|(_, (before, after))| before != after);
    changed.map(|(at, _)| at).collect()
}

fn short(pixels: usize) -> u16 {
    u16::try_from(pixels).expect("invariant: sides are at most MOST_PIXELS")
}

#[cfg(test)]
mod tests {
    use super::*;

    const PALETTE: [RGBColor; 3] = [
        RGBColor(0, 0, 0),
        RGBColor(255, 255, 255),
        RGBColor(200, 0, 0),
    ];

    fn picture(pixels: [u8; 6]) -> Picture {
        let (height, width) = (2, 3);
        Picture {
            height,
            width,
            pixels: pixels.to_vec(),
        }
    }

    fn pictures() -> [Picture; 3] {
        [
            picture([1, 1, 2, 1, 1, 1]),
            picture([1, 1, 2, 1, 2, 2]),
            picture([1, 1, 2, 1, 2, 2]),
        ]
    }

    fn encoded(format: Format) -> Vec<u8> {
        let shot = |picture| Ok(Shot { picture, centis: 7 });
        let shots = pictures().map(shot).into_iter();
        encode::<EncodeError>(format, (3, 2), &PALETTE, (3, shots)).expect("encoded")
    }

    /// Shows a patch over what was shown before.
    fn lay(shown: &mut [u8], patch: (usize, usize, usize), indices: &[u8]) {
        let (left, top, width) = patch;
        for (at, &index) in indices.iter().enumerate().filter(|it| *it.1 != CLEAR) {
            shown[(top + at / width) * 3 + left + at % width] = index;
        }
    }

    #[test]
    fn patches_hold_what_changed() {
        let [first, second, third] = pictures();
        let whole = Patch::between(None, &first);
        assert_eq!(
            (whole.left, whole.top, whole.picture),
            (0, 0, first.clone())
        );
        let patch = Patch::between(Some(&first), &second);
        assert_eq!(
            (patch.left, patch.top, patch.picture.pixels),
            (1, 1, vec![2, 2])
        );
        let none = Patch::between(Some(&second), &third);
        assert_eq!(none.picture, Picture::new(1, 1, CLEAR));
    }

    #[test]
    fn a_gif_shows_the_pictures() {
        let bytes = encoded(Format::Gif);
        let mut options = gif::DecodeOptions::new();
        options.set_color_output(gif::ColorOutput::Indexed);
        let mut decoder = options.read_info(&bytes[..]).expect("a GIF");
        let palette = decoder.global_palette().expect("a palette").to_vec();
        assert_eq!(palette[..9], channels(&PALETTE));
        let mut shown = vec![9; 6];
        for expected in pictures() {
            let frame = decoder
                .read_next_frame()
                .expect("whole")
                .expect("a picture");
            assert_eq!(frame.delay, 7);
            let [left, top, width] = [frame.left, frame.top, frame.width].map(usize::from);
            lay(&mut shown, (left, top, width), &frame.buffer);
            assert_eq!(shown, expected.pixels);
        }
        assert!(decoder.read_next_frame().expect("an end").is_none());
    }

    #[test]
    fn an_animated_png_shows_the_pictures() {
        let bytes = encoded(Format::Apng);
        let mut decoder = png::Decoder::new(&bytes[..]);
        decoder.set_transformations(png::Transformations::IDENTITY);
        let mut reader = decoder.read_info().expect("a PNG");
        let control = reader.info().animation_control.expect("animated");
        assert_eq!((control.num_frames, control.num_plays), (3, 0));
        let mut shown = vec![9; 6];
        for expected in pictures() {
            let mut indices = vec![0; reader.output_buffer_size()];
            let info = reader.next_frame(&mut indices).expect("a picture");
            let frame = *reader.info().frame_control().expect("its place");
            assert_eq!((frame.delay_num, frame.delay_den), (7, 100));
            let [left, top, width] = [frame.x_offset, frame.y_offset, frame.width];
            let patch = (left as usize, top as usize, width as usize);
            lay(&mut shown, patch, &indices[..info.buffer_size()]);
            assert_eq!(shown, expected.pixels);
        }
    }
}
