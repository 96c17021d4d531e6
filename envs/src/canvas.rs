//! Pictures of environments: a grid of coloured characters, for terminals and for animated images.

use std::fmt::Write as _;

/// Characters beside printable ASCII that a picture may hold: all that an embedded font must be able to draw.
pub const SYMBOLS: &str = "·•○●×←→↑↓♠♥♦♣█▓▒░▀▄▌▐─│┌┐└┘├┤┬┴┼═║╔╗╚╝╱╲";

/// How much a picture shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum View {
    /// What the agent sees at this moment: the present observation and its own last action, nothing remembered.
    Observed,
    /// Everything, the hidden state too.
    Revealed,
}

/// The colours of a terminal.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Colour {
    /// Whatever the terminal has.
    #[default]
    Default,
    /// Black.
    Black,
    /// Red.
    Red,
    /// Green.
    Green,
    /// Yellow.
    Yellow,
    /// Blue.
    Blue,
    /// Magenta.
    Magenta,
    /// Cyan.
    Cyan,
    /// Light grey.
    White,
    /// Dark grey.
    Grey,
}

impl Colour {
    /// The number of SGR (ECMA-48) that chooses this colour for characters; ten more is for what is behind them.
    fn sgr(self) -> u8 {
        match self {
            Self::Default => 39,
            Self::Black => 30,
            Self::Red => 31,
            Self::Green => 32,
            Self::Yellow => 33,
            Self::Blue => 34,
            Self::Magenta => 35,
            Self::Cyan => 36,
            Self::White => 37,
            Self::Grey => 90,
        }
    }
}

/// How a character looks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Style {
    /// The character's colour.
    pub ink: Colour,
    /// The colour behind it.
    pub paper: Colour,
    /// Whether it is bold.
    pub bold: bool,
}

impl Style {
    /// Terminal colours, not bold.
    pub const PLAIN: Self = Self { ink: Colour::Default, paper: Colour::Default, bold: false };

    /// Characters of this colour.
    pub const fn ink(ink: Colour) -> Self {
        Self { ink, ..Self::PLAIN }
    }

    /// The same on this colour.
    #[must_use]
    pub const fn on(self, paper: Colour) -> Self {
        Self { paper, ..self }
    }

    /// The same in bold.
    #[must_use]
    pub const fn bold(self) -> Self {
        Self { bold: true, ..self }
    }
}

/// One place of a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Glyph {
    /// The character.
    pub symbol: char,
    /// How it looks.
    pub style: Style,
    /// The action that this place stands for, so that a player can point at it and probabilities can be shown there:
    /// its class, or for two components `a * n1 + b`.
    pub action: Option<u16>,
}

impl Default for Glyph {
    fn default() -> Self {
        Self { symbol: ' ', style: Style::PLAIN, action: None }
    }
}

/// A picture. It grows as it is drawn on.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Canvas {
    rows: Vec<Vec<Glyph>>,
}

impl Canvas {
    /// An empty picture.
    pub fn new() -> Self {
        Self::default()
    }

    /// Makes it empty again.
    pub fn clear(&mut self) {
        self.rows.clear();
    }

    /// Number of rows.
    pub fn height(&self) -> usize {
        self.rows.len()
    }

    /// Length of the longest row.
    pub fn width(&self) -> usize {
        self.rows.iter().map(Vec::len).max().unwrap_or(0)
    }

    /// The rows, from the top; they may differ in length.
    pub fn rows(&self) -> &[Vec<Glyph>] {
        &self.rows
    }

    /// The rows, to be changed.
    pub fn rows_mut(&mut self) -> &mut [Vec<Glyph>] {
        &mut self.rows
    }

    /// Writes `text` rightwards from (`row`, `column`).
    pub fn put(&mut self, row: usize, column: usize, text: &str, style: Style) {
        self.write(row, column, text, style, None);
    }

    /// Writes `text` rightwards from (`row`, `column`), as the place that stands for `action`.
    pub fn put_action(&mut self, row: usize, column: usize, text: &str, style: Style, action: u16) {
        self.write(row, column, text, style, Some(action));
    }

    /// Puts `glyphs` in the place of row `row`.
    pub fn put_row(&mut self, row: usize, glyphs: &[Glyph]) {
        self.put(row, 0, "", Style::PLAIN);
        self.rows[row] = glyphs.to_vec();
    }

    fn write(&mut self, row: usize, column: usize, text: &str, style: Style, action: Option<u16>) {
        if self.rows.len() <= row {
            self.rows.resize_with(row + 1, Vec::new);
        }
        let cells = &mut self.rows[row];
        for (at, symbol) in (column..).zip(text.chars()) {
            if cells.len() <= at {
                cells.resize(at + 1, Glyph::default());
            }
            cells[at] = Glyph { symbol, style, action };
        }
    }

    /// The characters alone, a line a row.
    pub fn to_text(&self) -> String {
        let mut text = String::new();
        for row in &self.rows {
            let line: String = row.iter().map(|glyph| glyph.symbol).collect();
            // Writing to a string cannot fail.
            let _ = writeln!(text, "{}", line.trim_end());
        }
        text
    }

    /// The characters with the escape sequences that colour them on a terminal, a line a row.
    pub fn to_ansi(&self) -> String {
        let mut text = String::new();
        for row in &self.rows {
            let mut present = Style::PLAIN;
            for glyph in row {
                if glyph.style != present {
                    present = glyph.style;
                    let bold = if present.bold { ";1" } else { "" };
                    let (ink, paper) = (present.ink.sgr(), present.paper.sgr() + 10);
                    let _ = write!(text, "\x1b[0{bold};{ink};{paper}m");
                }
                text.push(glyph.symbol);
            }
            if present != Style::PLAIN {
                text.push_str("\x1b[0m");
            }
            text.push('\n');
        }
        text
    }
}
