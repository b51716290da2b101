//! Tensors whose planes are channels of frames, all of them or those that dropout keeps.

use crate::dropout::Mask;

/// The numbers of `[planes, rows, cols]`, frame by frame.
pub(super) struct Planes<'a> {
    numbers: &'a [f32],
    area: usize,
    mask: &'a Mask,
    /// Whether there are planes of lost channels, too.
    has_all: bool,
}

impl<'a> Planes<'a> {
    pub(super) fn new(numbers: &'a [f32], area: usize, mask: &'a Mask) -> Self {
        let has_all = numbers.len() == mask.n_frames() * mask.channels() * area;
        assert!(
            has_all || numbers.len() == mask.start(mask.n_frames()) * area,
            "planes of a mask"
        );
        Self {
            numbers,
            area,
            mask,
            has_all,
        }
    }

    pub(super) fn len(&self) -> usize {
        self.numbers.len()
    }

    pub(super) fn mask(&self) -> &Mask {
        self.mask
    }

    /// Where a frame's planes begin.
    pub(super) fn start(&self, frame: usize) -> usize {
        self.area
            * match self.has_all {
                true => frame * self.mask.channels(),
                false => self.mask.start(frame),
            }
    }

    /// Where the plane of a frame's kept channel begins in that frame.
    #[inline(always)]
    pub(super) fn place(&self, frame: usize, index: usize) -> usize {
        self.area
            * match self.has_all {
                true => self.mask.kept(frame)[index],
                false => index,
            }
    }

    /// A frame's kept channels and their planes.
    #[inline(always)]
    pub(super) fn kept(&self, frame: usize) -> impl Iterator<Item = (usize, &'a [f32])> {
        let (start, channels) = (self.start(frame), self.mask.kept(frame).iter().enumerate());
        channels.map(move |(index, channel)| {
            let first = start + self.place(frame, index);
            (*channel, &self.numbers[first..][..self.area])
        })
    }
}
