//! Films from pictures: GIF, and PNG with one picture or many.

use std::collections::HashMap;
use std::io::Cursor;
use std::ops::Range;

use anyhow::{Result, ensure};
use color_quant::NeuQuant;

/// Colours of a GIF but for the last entry of its palette, which lets the picture before be seen.
const COLORS: usize = 255;
const UNCHANGED: u8 = COLORS as u8;
/// How well colours are chosen: 1 looks at all samples, 30 at a few.
const SAMPLING: i32 = 10;
/// Pixels from which the colours of a GIF are chosen.
const SAMPLES: usize = 400_000;
/// Bytes of a pixel: red, green, blue, opacity.
const PIXEL: usize = 4;

/// Pictures of one size.
pub(crate) struct Film {
    width: u16,
    height: u16,
    frames: Vec<Vec<u8>>,
}

impl Film {
    /// A film without pictures.
    pub(crate) fn new(width: u16, height: u16) -> Self {
        Self { width, height, frames: Vec::new() }
    }

    /// Adds a picture that a browser has made, as PNG.
    pub(crate) fn push(&mut self, picture: &[u8]) -> Result<()> {
        let mut decoder = png::Decoder::new(Cursor::new(picture));
        decoder.set_transformations(png::Transformations::normalize_to_color8());
        let mut reader = decoder.read_info()?;
        let mut bytes = vec![0; reader.output_buffer_size().unwrap_or_default()];
        let info = reader.next_frame(&mut bytes)?;
        let size = (u32::from(self.width), u32::from(self.height));
        ensure!(
            (info.width, info.height) == size,
            "the browser has made a picture of another size"
        );
        bytes.truncate(info.buffer_size());
        let bytes = match info.color_type {
            png::ColorType::Rgba => bytes,
            png::ColorType::Rgb => bytes
                .chunks_exact(3)
                .flat_map(|pixel| [pixel[0], pixel[1], pixel[2], 255])
                .collect(),
            other => anyhow::bail!("the browser has made a picture in {other:?}"),
        };
        self.frames.push(bytes);
        Ok(())
    }

    /// Number of pictures.
    pub(crate) fn len(&self) -> usize {
        self.frames.len()
    }

    /// As PNG; of more than one picture, an animated one that repeats.
    pub(crate) fn png(&self, fps: f64) -> Result<Vec<u8>> {
        let mut file = Vec::new();
        let mut encoder =
            png::Encoder::new(&mut file, u32::from(self.width), u32::from(self.height));
        encoder.set_color(png::ColorType::Rgba);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_compression(png::Compression::High);
        if self.len() > 1 {
            encoder.set_animated(self.len() as u32, 0)?;
            encoder.set_frame_delay((1000.0 / fps).round() as u16, 1000)?;
        }
        let mut writer = encoder.write_header()?;
        for frame in &self.frames {
            writer.write_image_data(frame)?;
        }
        writer.finish()?;
        Ok(file)
    }

    /// As GIF that repeats: one palette for all, and of each picture what is other than in the one before.
    pub(crate) fn gif(&self, fps: f64) -> Result<Vec<u8>> {
        let mut colors = Colors::new(&self.frames);
        let mut file = Vec::new();
        let mut encoder = gif::Encoder::new(&mut file, self.width, self.height, &colors.palette)?;
        encoder.set_repeat(gif::Repeat::Infinite)?;
        let mut before: Option<Vec<u8>> = None;
        for (index, frame) in self.frames.iter().enumerate() {
            let shown: Vec<u8> =
                frame.chunks_exact(PIXEL).map(|pixel| colors.index(pixel)).collect();
            // Delays are hundredths of a second: what rounding loses, the next one has.
            let at = |index: usize| (100.0 * index as f64 / fps).round();
            let mut picture = match &before {
                None => {
                    gif::Frame::from_indexed_pixels(self.width, self.height, shown.clone(), None)
                }
                Some(before) => self.difference(before, &shown),
            };
            picture.delay = (at(index + 1) - at(index)) as u16;
            picture.dispose = gif::DisposalMethod::Keep;
            encoder.write_frame(&picture)?;
            before = Some(shown);
        }
        drop(encoder);
        Ok(file)
    }

    /// The rectangle in which two pictures differ.
    fn difference(&self, before: &[u8], shown: &[u8]) -> gif::Frame<'static> {
        let width = usize::from(self.width);
        let row = |y: usize| y * width..(y + 1) * width;
        let changed: Vec<usize> =
            (0..usize::from(self.height)).filter(|y| before[row(*y)] != shown[row(*y)]).collect();
        let rows = match (changed.first(), changed.last()) {
            (Some(first), Some(last)) => *first..*last + 1,
            _ => 0..1,
        };
        let is_changed =
            |x: &usize| rows.clone().any(|y| before[y * width + x] != shown[y * width + x]);
        let first = (0..width).find(is_changed).unwrap_or(0);
        let end = (0..width).rfind(is_changed).map_or(1, |last| last + 1);
        let columns: Range<usize> = first..end;
        let inside = rows.clone().flat_map(|y| columns.clone().map(move |x| y * width + x));
        let pixels: Vec<u8> =
            inside.map(|at| if before[at] == shown[at] { UNCHANGED } else { shown[at] }).collect();
        gif::Frame {
            left: columns.start as u16,
            top: rows.start as u16,
            ..gif::Frame::from_indexed_pixels(
                columns.len() as u16,
                rows.len() as u16,
                pixels,
                Some(UNCHANGED),
            )
        }
    }
}

/// The colours of a GIF.
struct Colors {
    chosen: NeuQuant,
    palette: Vec<u8>,
    known: HashMap<[u8; 3], u8>,
}

impl Colors {
    fn new(frames: &[Vec<u8>]) -> Self {
        let pixels: usize = frames.iter().map(|frame| frame.len() / PIXEL).sum();
        let stride = pixels.div_ceil(SAMPLES).max(1);
        let all = frames.iter().flat_map(|frame| frame.chunks_exact(PIXEL));
        let samples: Vec<u8> = all.step_by(stride).flatten().copied().collect();
        let chosen = NeuQuant::new(SAMPLING, COLORS, &samples);
        let mut palette = chosen.color_map_rgb();
        palette.resize(3 * (COLORS + 1), 0);
        Self { chosen, palette, known: HashMap::new() }
    }

    /// The entry of the palette that is nearest to a pixel.
    fn index(&mut self, pixel: &[u8]) -> u8 {
        let color = [pixel[0], pixel[1], pixel[2]];
        let chosen = &self.chosen;
        *self
            .known
            .entry(color)
            .or_insert_with(|| chosen.index_of(&[color[0], color[1], color[2], 255]) as u8)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (u16, u16) = (64, 48);
    const BACK: [u8; 4] = [240, 240, 240, 255];
    const SPOT: [u8; 4] = [200, 30, 30, 255];
    /// Width and height of the spot, and how far it goes from one picture to the next.
    const WIDE: usize = 8;

    /// A spot that goes right.
    fn film() -> Film {
        let mut film = Film::new(SIZE.0, SIZE.1);
        let width = usize::from(SIZE.0);
        for at in 0..4 {
            let mut pixels = BACK.repeat(width * usize::from(SIZE.1));
            for y in WIDE..2 * WIDE {
                let row = PIXEL * (y * width + at * WIDE);
                pixels[row..row + PIXEL * WIDE].copy_from_slice(&SPOT.repeat(WIDE));
            }
            let mut still = Film::new(SIZE.0, SIZE.1);
            still.frames.push(pixels);
            film.push(&still.png(1.0).unwrap()).unwrap();
        }
        film
    }

    fn is_near(a: &[u8], b: &[u8]) -> bool {
        a.iter().zip(b).all(|(a, b)| a.abs_diff(*b) < 8)
    }

    #[test]
    fn a_gif_shows_the_pictures_again() {
        let film = film();
        let mut options = gif::DecodeOptions::new();
        options.set_color_output(gif::ColorOutput::RGBA);
        let mut decoder = options.read_info(Cursor::new(film.gif(30.0).unwrap())).unwrap();
        let mut screen = vec![0; film.frames[0].len()];
        let mut delays = Vec::new();
        while let Some(frame) = decoder.read_next_frame().unwrap() {
            let width = usize::from(frame.width);
            for (index, pixel) in frame.buffer.chunks_exact(PIXEL).enumerate() {
                let (x, y) = (index % width, index / width);
                let at = (y + usize::from(frame.top)) * usize::from(SIZE.0)
                    + x
                    + usize::from(frame.left);
                if pixel[3] > 0 {
                    screen[PIXEL * at..][..PIXEL].copy_from_slice(pixel);
                }
            }
            assert!(is_near(&screen, &film.frames[delays.len()]), "picture {}", delays.len());
            delays.push((frame.delay, width));
        }
        // A thirtieth of a second on the average; after the first, what has changed alone.
        assert_eq!(delays, [(3, 64), (4, 16), (3, 16), (3, 16)]);
    }

    #[test]
    fn a_png_has_all_pictures() {
        let film = film();
        let mut reader =
            png::Decoder::new(Cursor::new(film.png(20.0).unwrap())).read_info().unwrap();
        let animation = *reader.info().animation_control().unwrap();
        assert_eq!((animation.num_frames, animation.num_plays), (4, 0));
        for frame in &film.frames {
            let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
            reader.next_frame(&mut bytes).unwrap();
            assert_eq!(&bytes, frame);
        }
    }

    #[test]
    fn a_picture_of_another_size_is_refused() {
        let picture = film().png(1.0).unwrap();
        assert!(Film::new(64, 49).push(&picture).is_err());
    }
}
