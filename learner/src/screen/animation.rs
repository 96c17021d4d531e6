//! Animated GIFs of what a terminal would show.

use std::io::Write;
use std::time::Duration;

use anyhow::{Context as _, ensure};
use gif::{DisposalMethod, Encoder, Frame, Repeat};
use popgym_envs::canvas::Glyph;
use popgym_envs::{Canvas, Colour, Style};

use super::font::{CELL, FULL, Font};
use super::layout::Size;

/// Pixels around everything.
const MARGIN: usize = 10;

/// Viewers take shorter delays for longer ones. Hundredths of a second.
const SHORTEST: u64 = 2;

/// The colours of a terminal: what is behind characters first, and their own usual colour.
const COLOURS: [[u8; 3]; 11] = [
    [18, 20, 26],
    [216, 219, 226],
    [0, 0, 0],
    [224, 72, 72],
    [92, 190, 92],
    [230, 190, 70],
    [84, 140, 240],
    [200, 110, 210],
    [80, 190, 200],
    [240, 240, 240],
    [120, 124, 134],
];

/// Index of a colour in [`COLOURS`]; `usual`: that of the terminal's own colour.
fn colour(colour: Colour, usual: usize) -> usize {
    match colour {
        Colour::Default => usual,
        Colour::Black => 2,
        Colour::Red => 3,
        Colour::Green => 4,
        Colour::Yellow => 5,
        Colour::Blue => 6,
        Colour::Magenta => 7,
        Colour::Cyan => 8,
        Colour::White => 9,
        Colour::Grey => 10,
    }
}

/// Place in the palette of what is `level` of the way from `paper` to `ink`. The colours come first, then, pair by pair, what
/// is between them.
fn shade(paper: usize, ink: usize, level: u8) -> u8 {
    let (low, high) = (paper.min(ink), paper.max(ink));
    let level = if paper <= ink { level } else { FULL - level };
    let index = match level {
        0 => low,
        FULL => high,
        // Pairs are in the order (0, 1), (0, 2), (1, 2), (0, 3), and so on.
        _ if low != high => {
            COLOURS.len() + (high * (high - 1) / 2 + low) * usize::from(FULL - 1) + usize::from(level) - 1
        }
        _ => low,
    };
    index as u8
}

/// Place in the palette of what stays as it was.
const UNCHANGED: u8 = 231;

/// All that [`shade`] can give, in red, green and blue bytes: 231 colours. One more stands for what stays as it was.
fn palette() -> Vec<u8> {
    let mut palette = COLOURS.as_flattened().to_vec();
    for (i, high) in COLOURS.iter().enumerate() {
        for (low, level) in COLOURS[..i].iter().flat_map(|low| (1..FULL).map(move |level| (low, level))) {
            let mix = |(&a, &b): (&u8, &u8)| {
                let (a, b, level, full) = (u16::from(a), u16::from(b), u16::from(level), u16::from(FULL));
                ((a * (full - level) + b * level + full / 2) / full) as u8
            };
            palette.extend(low.iter().zip(high).map(mix));
        }
    }
    palette.extend([0; 3]);
    palette
}

/// A GIF that is being written. It repeats for ever, and each frame holds only what has changed.
pub(crate) struct Animation<W: Write> {
    encoder: Encoder<W>,
    font: Font,
    size: Size,
    /// What the last frame showed, row by row.
    shown: Vec<(char, Style)>,
    frames: u64,
}

impl<W: Write> Animation<W> {
    /// An animation of frames that are at most `size`, written to `out`.
    ///
    /// # Errors
    /// A size that no GIF can have, or `out` cannot be written.
    pub(crate) fn new(out: W, size: Size) -> anyhow::Result<Self> {
        let pixels = |cells: usize, cell: usize| u16::try_from(cells * cell + 2 * MARGIN);
        let (Ok(width), Ok(height)) = (pixels(size.columns, CELL.0), pixels(size.rows, CELL.1)) else {
            anyhow::bail!("a picture of {} x {} characters is too large for a GIF", size.columns, size.rows);
        };
        let mut encoder = Encoder::new(out, width, height, &palette()).context(WRITE)?;
        encoder.set_repeat(Repeat::Infinite).context(WRITE)?;
        let shown = vec![cell(None); size.columns * size.rows];
        Ok(Self { encoder, font: Font::new()?, size, shown, frames: 0 })
    }

    /// Adds a frame that stays for `duration`.
    ///
    /// # Errors
    /// A frame that is larger than was said, or `out` cannot be written.
    pub(crate) fn add(&mut self, frame: &Canvas, duration: Duration) -> anyhow::Result<()> {
        let size = Size::of(frame);
        ensure!(size.max(self.size) == self.size, "a frame of {size:?} in an animation of {:?}", self.size);
        let cells = self.cells(frame);
        let mut image = if self.frames == 0 { self.whole() } else { Image::default() };
        if let Some((first, last)) = self.changed(&cells) {
            let part = self.paint(&cells, first, last);
            if self.frames == 0 { image.insert(&part) } else { image = part }
        }
        self.shown = cells;
        self.frames += 1;
        let hundredths = (duration.as_millis() as u64 / 10).clamp(SHORTEST, u64::from(u16::MAX));
        let frame = Frame {
            delay: hundredths as u16,
            dispose: DisposalMethod::Keep,
            transparent: Some(UNCHANGED),
            left: image.left as u16,
            top: image.top as u16,
            width: image.width as u16,
            height: (image.pixels.len() / image.width) as u16,
            buffer: image.pixels.into(),
            ..Frame::default()
        };
        self.encoder.write_frame(&frame).context(WRITE)
    }

    /// Writes the end, and gives back `out`.
    ///
    /// # Errors
    /// It cannot be written.
    pub(crate) fn finish(self) -> anyhow::Result<W> {
        self.encoder.into_inner().context(WRITE)
    }

    fn cells(&self, frame: &Canvas) -> Vec<(char, Style)> {
        let places = (0..self.size.rows).flat_map(|row| (0..self.size.columns).map(move |column| (row, column)));
        places.map(|(row, column)| cell(frame.rows().get(row).and_then(|row| row.get(column)))).collect()
    }

    /// Rows and columns of the first and the last corner of what is not as it was.
    fn changed(&self, cells: &[(char, Style)]) -> Option<((usize, usize), (usize, usize))> {
        let indices = || (0..cells.len()).filter(|&i| cells[i] != self.shown[i]);
        let rows = || indices().map(|i| i / self.size.columns);
        let columns = || indices().map(|i| i % self.size.columns);
        Some(((rows().min()?, columns().min()?), (rows().max()?, columns().max()?)))
    }

    /// The whole image, empty.
    fn whole(&self) -> Image {
        let (width, height) = (self.size.columns * CELL.0 + 2 * MARGIN, self.size.rows * CELL.1 + 2 * MARGIN);
        Image { left: 0, top: 0, width, pixels: vec![0; width * height] }
    }

    /// The cells from `first` to `last`, both with them, as far as they have changed.
    fn paint(&mut self, cells: &[(char, Style)], first: (usize, usize), last: (usize, usize)) -> Image {
        let (rows, columns) = (last.0 - first.0 + 1, last.1 - first.1 + 1);
        let width = columns * CELL.0;
        let mut pixels = vec![UNCHANGED; width * rows * CELL.1];
        for (i, j) in (0..rows).flat_map(|i| (0..columns).map(move |j| (i, j))) {
            let place = (first.0 + i) * self.size.columns + first.1 + j;
            if cells[place] == self.shown[place] {
                continue;
            }
            let (symbol, style) = cells[place];
            let (paper, ink) = (colour(style.paper, 0), colour(style.ink, 1));
            let mask = self.font.mask(symbol, style.bold);
            for (y, row) in mask.chunks_exact(CELL.0).enumerate() {
                let at = (i * CELL.1 + y) * width + j * CELL.0;
                pixels[at..at + CELL.0].iter_mut().zip(row).for_each(|(out, &level)| *out = shade(paper, ink, level));
            }
        }
        Image { left: MARGIN + first.1 * CELL.0, top: MARGIN + first.0 * CELL.1, width, pixels }
    }
}

const WRITE: &str = "the animation cannot be written";

/// A rectangle of pixels, places in the palette.
struct Image {
    left: usize,
    top: usize,
    width: usize,
    pixels: Vec<u8>,
}

impl Default for Image {
    /// One pixel of the margin: the least that a frame can hold.
    fn default() -> Self {
        Self { left: 0, top: 0, width: 1, pixels: vec![0] }
    }
}

impl Image {
    fn insert(&mut self, part: &Self) {
        for (y, row) in part.pixels.chunks_exact(part.width).enumerate() {
            let at = (part.top + y) * self.width + part.left;
            let changed = self.pixels[at..at + part.width].iter_mut().zip(row).filter(|(_, new)| **new != UNCHANGED);
            changed.for_each(|(old, &new)| *old = new);
        }
    }
}

/// How a place looks.
fn cell(glyph: Option<&Glyph>) -> (char, Style) {
    glyph.map_or((' ', Style::PLAIN), |glyph| (glyph.symbol, glyph.style))
}

#[cfg(test)]
mod tests {
    use gif::DecodeOptions;
    use popgym_envs::canvas::SYMBOLS;

    use super::*;

    const STEP: Duration = Duration::from_millis(250);

    fn canvas(text: &str, style: Style) -> Canvas {
        let mut canvas = Canvas::new();
        text.lines().enumerate().for_each(|(row, line)| canvas.put(row, 0, line, style));
        canvas
    }

    fn film(size: Size, frames: &[Canvas]) -> Vec<u8> {
        let mut animation = Animation::new(Vec::new(), size).unwrap();
        for frame in frames {
            animation.add(frame, STEP).unwrap();
        }
        animation.finish().unwrap()
    }

    /// Width, height, repeats, and each frame: its delay, the number of its pixels, and the whole image after it.
    struct Decoded {
        size: (u16, u16),
        repeat: Repeat,
        frames: Vec<(u16, usize, Vec<[u8; 3]>)>,
    }

    impl Decoded {
        fn of(bytes: &[u8]) -> Self {
            let mut decoder = DecodeOptions::new().read_info(bytes).unwrap();
            let palette = decoder.global_palette().unwrap().to_vec();
            let size = (decoder.width(), decoder.height());
            let mut image = vec![[0xff, 0, 0xff]; usize::from(size.0) * usize::from(size.1)];
            let mut frames = Vec::new();
            while let Some(frame) = decoder.read_next_frame().unwrap() {
                assert!(frame.palette.is_none() && frame.dispose == DisposalMethod::Keep);
                let shown = frame.buffer.iter().enumerate().filter(|(_, index)| Some(**index) != frame.transparent);
                for (i, &index) in shown {
                    let (x, y) = (i % usize::from(frame.width), i / usize::from(frame.width));
                    let at = (usize::from(frame.top) + y) * usize::from(size.0) + usize::from(frame.left) + x;
                    image[at] = palette[3 * usize::from(index)..][..3].try_into().unwrap();
                }
                frames.push((frame.delay, frame.buffer.len(), image.clone()));
            }
            Self { size, repeat: decoder.repeat(), frames }
        }

        /// The pixels of a cell in the image after frame `frame`.
        fn cell(&self, frame: usize, row: usize, column: usize) -> Vec<[u8; 3]> {
            let (x, y) = (MARGIN + column * CELL.0, MARGIN + row * CELL.1);
            let pixels = (y..y + CELL.1).flat_map(|y| (x..x + CELL.0).map(move |x| (x, y)));
            pixels.map(|(x, y)| self.frames[frame].2[y * usize::from(self.size.0) + x]).collect()
        }
    }

    #[test]
    fn what_was_put_in_comes_out() {
        let (size, red) = (Size { columns: 4, rows: 2 }, Style::ink(Colour::Red));
        let frames = [canvas("ab\n█", red), canvas("ab\n██", red), canvas("ab\n██", red), canvas("", red)];
        let found = Decoded::of(&film(size, &frames));
        assert_eq!(found.size, (4 * 10 + 20, 2 * 20 + 20));
        assert_eq!(found.repeat, Repeat::Infinite);
        assert_eq!(found.frames.iter().map(|frame| frame.0).collect::<Vec<_>>(), [25; 4]);
        assert!(found.frames[0].2.iter().all(|pixel| *pixel != [0xff, 0, 0xff]), "the first frame is whole");
        // All; one cell; the same again; all that was there.
        assert_eq!(found.frames.iter().map(|frame| frame.1).collect::<Vec<_>>(), [60 * 60, 200, 1, 4 * 200]);
        assert!(found.cell(0, 1, 0).iter().all(|&pixel| pixel == COLOURS[3]), "a block is red all over");
        assert!(found.cell(0, 1, 1).iter().all(|&pixel| pixel == COLOURS[0]), "nothing there yet");
        assert!(found.cell(1, 1, 1).iter().all(|&pixel| pixel == COLOURS[3]));
        assert!(found.cell(0, 0, 0).contains(&COLOURS[3]) && found.cell(0, 0, 0).contains(&COLOURS[0]), "a letter");
        assert_ne!(found.cell(0, 0, 0), found.cell(0, 0, 1));
        assert!(found.frames[3].2.iter().all(|&pixel| pixel == COLOURS[0]), "empty again");
    }

    #[test]
    fn every_character_in_every_style() {
        let text = (' '..='~').chain(SYMBOLS.chars()).collect::<String>();
        let colours = [
            Colour::Default,
            Colour::Black,
            Colour::Red,
            Colour::Green,
            Colour::Yellow,
            Colour::Blue,
            Colour::Magenta,
            Colour::Cyan,
            Colour::White,
            Colour::Grey,
        ];
        let size = Size { columns: text.chars().count(), rows: 1 };
        for paper in colours {
            let frames = colours.map(|ink| canvas(&text, Style::ink(ink).on(paper).bold()));
            let found = Decoded::of(&film(size, &frames));
            for (frame, ink) in colours.into_iter().enumerate() {
                let (paper, ink) = (COLOURS[colour(paper, 0)], COLOURS[colour(ink, 1)]);
                let pixels = found.cell(frame, 0, usize::from(b'H' - b' '));
                assert!(pixels.contains(&paper) && pixels.contains(&ink), "{paper:?} {ink:?}");
                let within =
                    |pixel: &[u8; 3]| (0..3).all(|i| (paper[i].min(ink[i])..=paper[i].max(ink[i])).contains(&pixel[i]));
                assert!(pixels.iter().all(within), "a colour that is not between the two");
            }
        }
    }

    #[test]
    fn delays_that_a_gif_can_have() {
        let mut animation = Animation::new(Vec::new(), Size { columns: 1, rows: 1 }).unwrap();
        for seconds in [0.0, 0.001, 2.0, 1e6] {
            animation.add(&canvas("x", Style::PLAIN), Duration::from_secs_f64(seconds)).unwrap();
        }
        let found = Decoded::of(&animation.finish().unwrap());
        assert_eq!(found.frames.iter().map(|frame| frame.0).collect::<Vec<_>>(), [2, 2, 200, u16::MAX]);
    }

    #[test]
    fn frames_that_are_too_large() {
        let mut animation = Animation::new(Vec::new(), Size { columns: 2, rows: 1 }).unwrap();
        assert!(animation.add(&canvas("abc", Style::PLAIN), STEP).is_err());
        assert!(Animation::new(Vec::new(), Size { columns: 7000, rows: 1 }).is_err());
    }
}
