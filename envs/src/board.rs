//! Pictures of square boards: cells with a space between them, letters over the columns, numbers before the rows.

use crate::canvas::{Canvas, Colour, Style};

/// Draws a board of `n` by `n` cells below the empty canvas's upper left corner. `look` says how cell `row * n + column`
/// looks; that number is also the action that the cell stands for.
pub(crate) fn draw_board(canvas: &mut Canvas, n: usize, look: impl Fn(usize) -> (char, Style)) {
    const LABEL: Style = Style::ink(Colour::Grey);
    let margin = n.to_string().len() + 1;
    for column in 0..n {
        let letter = char::from(b'A' + (column % 26) as u8);
        canvas.put(0, margin + 2 * column, letter.encode_utf8(&mut [0; 4]), LABEL);
    }
    for row in 0..n {
        canvas.put(row + 1, 0, &format!("{:>1$}", row + 1, margin - 1), LABEL);
        for column in 0..n {
            let cell = row * n + column;
            let (symbol, style) = look(cell);
            let symbol = symbol.encode_utf8(&mut [0; 4]).to_owned();
            canvas.put_action(row + 1, margin + 2 * column, &symbol, style, cell as u16);
        }
    }
}
