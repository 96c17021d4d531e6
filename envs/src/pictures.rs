//! Parts of pictures that several games have in common.

use crate::canvas::{Canvas, Colour, Style};
use crate::deck::{Field, SUITS};

/// Where the values begin that stand behind a word.
const INDENT: usize = 12;
/// Most columns that a line of cards takes.
const LINE: usize = 52;
/// Most lines of cards still to come; what comes later is left out.
const LINES: usize = 2;

/// A card, face up, three rows high; a place for one if `class` is nothing.
pub(crate) fn card(canvas: &mut Canvas, row: usize, column: usize, field: Field, class: Option<u8>) {
    let (symbol, style) = class.map_or((" ", Style::PLAIN), |class| (field.symbol(class), field.style(class)));
    let width = width(field).max(3);
    let edge = "─".repeat(width);
    canvas.put(row, column, &format!("┌{edge}┐"), Style::PLAIN);
    canvas.put(row + 1, column, &format!("│{:width$}│", ""), Style::PLAIN);
    canvas.put(row + 1, column + 1, &format!("{symbol:^width$}"), style);
    canvas.put(row + 2, column, &format!("└{edge}┘"), Style::PLAIN);
}

/// The actions to choose from: `last` was taken last, `right` would be right now.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Choices {
    pub(crate) last: Option<u8>,
    pub(crate) right: Option<u8>,
}

impl Choices {
    /// One action; two columns wider than `text`.
    pub(crate) fn put(self, canvas: &mut Canvas, row: usize, column: usize, action: u8, text: &str, style: Style) {
        let text = if self.last == Some(action) { format!("[{text}]") } else { format!(" {text} ") };
        let style = if self.right == Some(action) { style.on(Colour::Green).bold() } else { style };
        canvas.put_action(row, column, &text, style, u16::from(action));
    }

    /// The four suits after a question.
    pub(crate) fn suits(self, canvas: &mut Canvas, row: usize, question: &str) {
        canvas.put(row, 0, question, Style::PLAIN);
        let column = question.chars().count() + 1;
        for suit in 0..SUITS as u8 {
            let (symbol, style) = (Field::Suit.symbol(suit), Field::Suit.style(suit));
            self.put(canvas, row, column + 4 * usize::from(suit), suit, symbol, style);
        }
    }
}

/// Of the longest symbol.
fn width(field: Field) -> usize {
    (0..field.classes() as u8).map(|class| field.symbol(class).chars().count()).max().unwrap_or(0)
}

/// A word, and a text behind it.
pub(crate) fn line(canvas: &mut Canvas, row: usize, word: &str, text: &str, style: Style) {
    canvas.put(row, 0, word, Style::PLAIN);
    canvas.put(row, INDENT, text, style);
}

/// A word, and behind it the class that would be the right answer now; `otherwise` if there is none.
pub(crate) fn answer(canvas: &mut Canvas, row: usize, field: Field, class: Option<u8>, otherwise: &str) {
    let (text, style) = class.map_or((otherwise, Style::PLAIN), |class| (field.symbol(class), field.style(class)));
    line(canvas, row, "answer now:", text, style);
}

/// A word, and cards behind it (nothing: a dot), as many lines of them as `lines`; gives the row below.
pub(crate) fn cards(
    canvas: &mut Canvas,
    row: usize,
    word: &str,
    field: Field,
    lines: usize,
    classes: impl IntoIterator<Item = Option<u8>>,
) -> usize {
    canvas.put(row, 0, word, Style::PLAIN);
    let width = width(field) + 1;
    let each = LINE / width;
    let mut below = row + 1;
    for (i, class) in classes.into_iter().enumerate() {
        let (row, column) = (row + i / each, INDENT + width * (i % each));
        if i == each.saturating_mul(lines) {
            canvas.put(row - 1, INDENT + width * each, "...", Style::PLAIN);
            break;
        }
        match class {
            Some(class) => canvas.put(row, column, field.symbol(class), field.style(class)),
            None => canvas.put(row, column, "·", Style::PLAIN),
        }
        below = row + 1;
    }
    below
}

/// What is still to be dealt of `classes`, a deck's cards in shuffled order; gives the row below.
pub(crate) fn to_come(canvas: &mut Canvas, row: usize, field: Field, classes: &[u8]) -> usize {
    let classes = classes.iter().rev().map(|&class| Some(class));
    cards(canvas, row, "to come:", field, LINES, classes)
}

/// A table: a column for each class of `field`, and a row for each word with its numbers; gives the row below.
pub(crate) fn counts(canvas: &mut Canvas, row: usize, field: Field, rows: &[(&str, &dyn Fn(u8) -> u16)]) -> usize {
    // Three digits are enough for a deck of hundreds of cards.
    let width = width(field).max(3);
    let at = |class: u8| INDENT + (width + 1) * usize::from(class);
    line(canvas, row, field.name(), "", Style::PLAIN);
    for class in 0..field.classes() as u8 {
        canvas.put(row, at(class), &format!("{:>width$}", field.symbol(class)), field.style(class));
        for (below, (word, number)) in (row + 1..).zip(rows) {
            canvas.put(below, 0, word, Style::PLAIN);
            canvas.put(below, at(class), &format!("{:>width$}", number(class)), Style::PLAIN);
        }
    }
    row + 1 + rows.len()
}
