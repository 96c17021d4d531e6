//! Characters as pixels, all of one size.

use std::collections::HashMap;

use ab_glyph::{Font as _, FontRef, PxScale, point};
use anyhow::Context as _;

/// Width and height of a character, in pixels.
pub(crate) const CELL: (usize, usize) = (10, 20);

/// Full coverage of a pixel.
pub(crate) const FULL: u8 = 5;

/// How much of each pixel of a cell a character covers, 0 to [`FULL`], row by row.
pub(crate) type Mask = [u8; CELL.0 * CELL.1];

/// DejaVu Sans Mono, regular and bold.
pub(crate) struct Font {
    faces: [FontRef<'static>; 2],
    masks: HashMap<(char, bool), Mask>,
}

impl Font {
    /// The font, which is part of the program.
    ///
    /// # Errors
    /// None that can be caused from outside.
    pub(crate) fn new() -> anyhow::Result<Self> {
        let face = |bytes| FontRef::try_from_slice(bytes).context("the embedded font is damaged");
        let faces = [face(dejavu::sans_mono::regular())?, face(dejavu::sans_mono::bold())?];
        Ok(Self { faces, masks: HashMap::new() })
    }

    /// The pixels of a character; of one that the font does not have, an empty box.
    pub(crate) fn mask(&mut self, symbol: char, bold: bool) -> &Mask {
        let face = &self.faces[usize::from(bold)];
        self.masks.entry((symbol, bold)).or_insert_with(|| block(symbol).unwrap_or_else(|| draw(face, symbol)))
    }
}

fn draw(face: &FontRef<'_>, symbol: char) -> Mask {
    let mut mask = [0; CELL.0 * CELL.1];
    let id = face.glyph_id(symbol);
    let height = face.height_unscaled();
    // Of a font whose characters are all as wide as any one of them.
    let width = face.h_advance_unscaled(face.glyph_id('0'));
    let scale = PxScale { x: CELL.0 as f32 * height / width, y: CELL.1 as f32 };
    let baseline = CELL.1 as f32 * face.ascent_unscaled() / height;
    let Some(outline) = face.outline_glyph(id.with_scale_and_position(scale, point(0.0, baseline))) else {
        return mask;
    };
    let corner = outline.px_bounds().min;
    outline.draw(|x, y, coverage| {
        let (x, y) = (corner.x as i32 + x as i32, corner.y as i32 + y as i32);
        if (0..CELL.0 as i32).contains(&x) && (0..CELL.1 as i32).contains(&y) {
            mask[y as usize * CELL.0 + x as usize] = (coverage.clamp(0.0, 1.0) * f32::from(FULL)).round() as u8;
        }
    });
    mask
}

/// Blocks and shades fill their cells to the edge, so that they leave no seams.
fn block(symbol: char) -> Option<Mask> {
    let (left, right, top, bottom, level) = match symbol {
        '█' => (0, CELL.0, 0, CELL.1, FULL),
        '▓' => (0, CELL.0, 0, CELL.1, 4),
        '▒' => (0, CELL.0, 0, CELL.1, 2),
        '░' => (0, CELL.0, 0, CELL.1, 1),
        '▀' => (0, CELL.0, 0, CELL.1 / 2, FULL),
        '▄' => (0, CELL.0, CELL.1 / 2, CELL.1, FULL),
        '▌' => (0, CELL.0 / 2, 0, CELL.1, FULL),
        '▐' => (CELL.0 / 2, CELL.0, 0, CELL.1, FULL),
        _ => return None,
    };
    let inside = |i: usize| (left..right).contains(&(i % CELL.0)) && (top..bottom).contains(&(i / CELL.0));
    Some(std::array::from_fn(|i| if inside(i) { level } else { 0 }))
}

#[cfg(test)]
mod tests {
    use popgym_envs::canvas::SYMBOLS;

    use super::*;

    #[test]
    fn every_character_of_pictures_has_a_shape_of_its_own() {
        let mut font = Font::new().unwrap();
        for bold in [false, true] {
            // What the font draws in place of a character that it does not have.
            let missing = *font.mask('\u{e000}', bold);
            let mut seen: HashMap<Mask, char> = HashMap::new();
            for symbol in (' '..='~').chain(SYMBOLS.chars()) {
                let mask = *font.mask(symbol, bold);
                assert_eq!(mask.iter().all(|&level| level == 0), symbol == ' ', "`{symbol}` {bold}");
                assert_ne!(mask, missing, "`{symbol}` {bold}");
                let other = seen.insert(mask, symbol);
                assert_eq!(other, None, "`{symbol}` {bold}");
                assert!(block(symbol).is_some() || font.faces[usize::from(bold)].glyph_id(symbol).0 != 0, "`{symbol}`");
            }
        }
    }

    #[test]
    fn lines_meet_at_the_edges() {
        let mut font = Font::new().unwrap();
        let inked = |mask: &Mask, x: usize, y: usize| mask[y * CELL.0 + x] > 0;
        for (symbol, left, right, top, bottom) in [
            ('─', true, true, false, false),
            ('│', false, false, true, true),
            ('┌', false, true, false, true),
            ('┼', true, true, true, true),
            ('╝', true, false, true, false),
        ] {
            let mask = *font.mask(symbol, false);
            let column = |x| (0..CELL.1).any(|y| inked(&mask, x, y));
            let row = |y| (0..CELL.0).any(|x| inked(&mask, x, y));
            let found = (column(0), column(CELL.0 - 1), row(0), row(CELL.1 - 1));
            assert_eq!(found, (left, right, top, bottom), "`{symbol}`");
        }
    }

    #[test]
    fn letters_stand_on_one_line() {
        let mut font = Font::new().unwrap();
        let mut lowest = |symbol| {
            let mask = font.mask(symbol, false);
            mask.iter().rposition(|&level| level >= 3).unwrap() / CELL.0
        };
        assert_eq!(lowest('x'), lowest('H'));
        assert!(lowest('g') > lowest('x'));
    }
}
