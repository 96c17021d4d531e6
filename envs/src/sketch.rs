//! Lines and bars of characters, for the pictures of the control tasks.

use crate::canvas::{Canvas, Colour, Style};

/// Draws a line from one place to another, each `(row, column)` and none negative.
pub(crate) fn line(canvas: &mut Canvas, from: (f64, f64), to: (f64, f64), style: Style) {
    let (rows, columns) = (to.0 - from.0, to.1 - from.1);
    let diagonal = if (rows > 0.0) == (columns > 0.0) { "╲" } else { "╱" };
    let (steep, flat) = (columns.abs() < 0.6 * rows.abs(), rows.abs() < 0.4 * columns.abs());
    let places = rows.abs().max(columns.abs()).ceil().max(1.0) as usize;
    let place = |i: usize| {
        let along = i as f64 / places as f64;
        ((from.0 + along * rows).round() as usize, (from.1 + along * columns).round() as usize)
    };
    for i in 0..=places {
        // An upright or a level line leans only where it goes over to the next column or row.
        let (here, before) = (place(i), place(i.saturating_sub(1)));
        let symbol = if steep && here.1 == before.1 {
            "│"
        } else if flat && here.0 == before.0 {
            "─"
        } else {
            diagonal
        };
        canvas.put(here.0, here.1, symbol, style);
    }
}

/// Half the length of a bar, in characters.
const HALF: usize = 20;

/// Draws `value` as a bar from the middle of a row, full at `limit`, with its name before it and its number behind.
pub(crate) fn bar(canvas: &mut Canvas, row: usize, name: &str, value: f64, limit: f64, unit: &str) {
    const START: usize = 18;
    let middle = START + HALF;
    let length = (value.abs() / limit * HALF as f64).round().min(HALF as f64) as usize;
    canvas.put(row, 0, name, Style::PLAIN);
    canvas.put(row, START, &"·".repeat(2 * HALF + 1), Style::ink(Colour::Grey));
    let first = if value < 0.0 { middle - length } else { middle + 1 };
    canvas.put(row, first, &"█".repeat(length), Style::ink(Colour::Cyan));
    canvas.put(row, middle, "│", Style::PLAIN);
    canvas.put(row, middle + HALF + 2, &format!("{value:+.3} {unit}"), Style::PLAIN);
}
