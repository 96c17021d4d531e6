//! Where pictures and panel stand on a screen.

use popgym_envs::{Canvas, Colour, Style};

use super::panel::wrap;

/// Empty columns between what stands side by side.
const GAP: usize = 3;

/// Columns and rows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Size {
    /// Columns.
    pub columns: usize,
    /// Rows.
    pub rows: usize,
}

impl Size {
    /// Of a canvas.
    pub(crate) fn of(canvas: &Canvas) -> Self {
        Self { columns: canvas.width(), rows: canvas.height() }
    }

    /// Large enough for both.
    #[must_use]
    pub(crate) fn max(self, other: Self) -> Self {
        Self { columns: self.columns.max(other.columns), rows: self.rows.max(other.rows) }
    }

    fn fits(self, room: Self) -> bool {
        self.columns <= room.columns && self.rows <= room.rows
    }

    /// How much of it has no room.
    fn excess(self, room: Self) -> usize {
        self.columns.saturating_sub(room.columns) + 2 * self.rows.saturating_sub(room.rows)
    }
}

/// How blocks follow one another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Way {
    Across,
    Down,
}

impl Way {
    /// Row and column of each block in a line of blocks, and the size of the line.
    fn line(self, blocks: &[Size]) -> (Vec<(usize, usize)>, Size) {
        let (mut places, mut whole) = (Vec::new(), Size::default());
        for block in blocks {
            // No gap beside nothing.
            let gap = |gap: usize, before: usize, after: usize| if before == 0 || after == 0 { 0 } else { gap };
            let place = match self {
                Self::Across => (0, whole.columns + gap(GAP, whole.columns, block.columns)),
                Self::Down => (whole.rows + gap(1, whole.rows, block.rows), 0),
            };
            whole = whole.max(Size { columns: place.1 + block.columns, rows: place.0 + block.rows });
            places.push(place);
        }
        (places, whole)
    }
}

/// Puts together what is shown. It remembers the largest sizes, so that nothing jumps about when a picture shrinks.
#[derive(Clone, Debug, Default)]
pub(crate) struct Layout {
    /// Of each block.
    sizes: Vec<Size>,
}

impl Layout {
    /// One canvas of blocks: pictures, and the panel last. All stand side by side if `room` has place for that, else one or
    /// the other is below.
    ///
    /// # Errors
    /// The size that is needed, if `room` is too small for any of these.
    pub(crate) fn fit(&mut self, blocks: &[&Canvas], room: Size) -> Result<Canvas, Size> {
        self.remember(blocks);
        let mut needed: Option<Size> = None;
        for panel in [Way::Across, Way::Down] {
            for pictures in [Way::Across, Way::Down] {
                let (places, size) = self.arranged(pictures, panel);
                if size.fits(room) {
                    return Ok(pasted(blocks, &places));
                }
                needed = Some(needed.filter(|other| other.excess(room) <= size.excess(room)).unwrap_or(size));
            }
        }
        Err(needed.unwrap_or_default())
    }

    /// One canvas of blocks, side by side.
    pub(crate) fn side_by_side(&mut self, blocks: &[&Canvas]) -> Canvas {
        self.remember(blocks);
        pasted(blocks, &self.arranged(Way::Across, Way::Across).0)
    }

    /// The largest canvas of [`Layout::side_by_side`], from now on, of blocks such as there were.
    pub(crate) fn size(&self) -> Size {
        self.arranged(Way::Across, Way::Across).1
    }

    fn remember(&mut self, blocks: &[&Canvas]) {
        self.sizes.resize(blocks.len(), Size::default());
        for (size, block) in self.sizes.iter_mut().zip(blocks) {
            *size = size.max(Size::of(block));
        }
    }

    /// The places of pictures that follow one another in one way, and of the panel that follows them in another; and the
    /// size of the whole.
    fn arranged(&self, pictures: Way, panel: Way) -> (Vec<(usize, usize)>, Size) {
        let Some((last, others)) = self.sizes.split_last() else { return (Vec::new(), Size::default()) };
        let (mut places, size) = pictures.line(others);
        let (both, whole) = panel.line(&[size, *last]);
        places.push(both[1]);
        (places, whole)
    }
}

/// A picture below its title; an empty picture has none.
pub(crate) fn titled(title: &str, picture: &Canvas) -> Canvas {
    let mut whole = Canvas::new();
    if picture.height() > 0 {
        whole.put(0, 0, title, Style::ink(Colour::Cyan));
        paste(&mut whole, picture, 2, 0);
    }
    whole
}

/// The blocks at their places.
fn pasted(blocks: &[&Canvas], places: &[(usize, usize)]) -> Canvas {
    let mut whole = Canvas::new();
    blocks.iter().zip(places).for_each(|(block, &(row, column))| paste(&mut whole, block, row, column));
    whole
}

/// Copies `block` to a place of `whole`.
fn paste(whole: &mut Canvas, block: &Canvas, row: usize, column: usize) {
    for (i, glyphs) in block.rows().iter().enumerate() {
        // Also a row without characters is there.
        whole.put(row + i, column, "", Style::PLAIN);
        for (j, glyph) in glyphs.iter().enumerate() {
            // A character that moves the terminal's own cursor would tear the picture.
            let symbol = if glyph.symbol.is_control() { ' ' } else { glyph.symbol };
            whole.put(row + i, column + j, symbol.encode_utf8(&mut [0; 4]), glyph.style);
        }
    }
}

/// What is shown where there is not enough room.
pub(crate) fn too_small(room: Size, needed: Size) -> Canvas {
    let text = format!(
        "The terminal is {} x {}, this needs {} x {} (columns x rows). q quits.",
        room.columns, room.rows, needed.columns, needed.rows
    );
    let mut canvas = Canvas::new();
    for (row, line) in wrap(&text, room.columns.max(1)).iter().enumerate().take(room.rows) {
        canvas.put(row, 0, line, Style::PLAIN);
    }
    canvas
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A block filled with one character.
    fn block(symbol: &str, columns: usize, rows: usize) -> Canvas {
        let mut canvas = Canvas::new();
        (0..rows).for_each(|row| canvas.put(row, 0, &symbol.repeat(columns), Style::PLAIN));
        canvas
    }

    fn room(columns: usize, rows: usize) -> Size {
        Size { columns, rows }
    }

    #[test]
    fn side_by_side_or_below() {
        let (a, b, panel) = (block("a", 4, 2), block("b", 3, 1), block("p", 5, 3));
        let blocks = [&a, &b, &panel];
        let fit = |room| Layout::default().fit(&blocks, room).map(|canvas| canvas.to_text());
        let wide = "aaaa   bbb   ppppp\naaaa         ppppp\n             ppppp\n";
        assert_eq!(fit(room(18, 3)).unwrap(), wide);
        assert_eq!(fit(room(17, 6)).unwrap(), "aaaa   ppppp\naaaa   ppppp\n       ppppp\nbbb\n");
        assert_eq!(fit(room(11, 6)).unwrap(), "aaaa   bbb\naaaa\n\nppppp\nppppp\nppppp\n");
        assert_eq!(fit(room(9, 8)).unwrap(), "aaaa\naaaa\n\nbbb\n\nppppp\nppppp\nppppp\n");
        // Of all, what is nearest to fitting.
        assert_eq!(fit(room(18, 2)), Err(room(18, 3)));
        assert_eq!(fit(room(5, 7)), Err(room(5, 8)));
        let mut layout = Layout::default();
        assert_eq!(layout.side_by_side(&blocks).to_text(), wide);
        assert_eq!(layout.size(), room(18, 3));
    }

    #[test]
    fn without_a_picture_the_panel_alone() {
        let panel = block("p", 5, 1);
        for blocks in [&[&panel][..], &[&Canvas::new(), &panel], &[&Canvas::new(), &Canvas::new(), &panel]] {
            assert_eq!(Layout::default().fit(blocks, room(5, 1)).unwrap().to_text(), "ppppp\n");
        }
    }

    #[test]
    fn titles() {
        assert_eq!(titled("title", &block("a", 2, 1)).to_text(), "title\n\naa\n");
        assert_eq!(titled("title", &Canvas::new()), Canvas::new());
    }

    #[test]
    fn nothing_jumps_when_a_picture_shrinks() {
        let mut layout = Layout::default();
        let panel = block("p", 2, 1);
        layout.side_by_side(&[&block("a", 6, 2), &panel]);
        assert_eq!(layout.side_by_side(&[&block("a", 1, 1), &panel]).to_text(), "a        pp\n");
        assert_eq!(layout.size(), room(11, 2));
    }

    #[test]
    fn characters_that_would_tear_the_screen_are_left_out() {
        let mut layout = Layout::default();
        assert_eq!(layout.side_by_side(&[&block("\x1b", 2, 1), &block("p", 1, 1)]).to_text(), "     p\n");
    }

    #[test]
    fn too_small_says_so_within_the_room() {
        let canvas = too_small(Size { columns: 12, rows: 3 }, Size { columns: 80, rows: 24 });
        assert_eq!(Size::of(&canvas), Size { columns: 12, rows: 3 });
        let wide = too_small(Size { columns: 79, rows: 3 }, Size { columns: 80, rows: 24 }).to_text();
        assert!(wide.contains("79 x 3") && wide.contains("80 x 24"), "{wide}");
        too_small(Size::default(), Size { columns: 80, rows: 24 });
    }
}
