//! The text beside a picture.

use popgym_envs::{Canvas, Colour, Style};

/// Columns of a panel.
pub(crate) const WIDTH: usize = 46;

/// Columns of the names of values.
const NAME: usize = 13;

/// Rows of one value at most.
const VALUE_ROWS: usize = 8;

/// Columns of a bar.
const BAR: usize = 20;

/// Names of values.
const QUIET: Style = Style::ink(Colour::Cyan);

/// Lines of text, from the top.
#[derive(Clone, Debug, Default)]
pub(crate) struct Panel {
    canvas: Canvas,
    /// The rows that can be left out where there is little room.
    optional: Vec<usize>,
}

impl Panel {
    /// An empty panel.
    pub(crate) fn new() -> Self {
        Self::default()
    }

    /// What was written.
    pub(crate) fn canvas(&self) -> &Canvas {
        &self.canvas
    }

    /// What was written, without the lines that can be left out.
    pub(crate) fn brief(&self) -> Canvas {
        let mut canvas = Canvas::new();
        for (i, glyphs) in self.canvas.rows().iter().enumerate().filter(|(i, _)| !self.optional.contains(i)) {
            canvas.put_row(i - self.optional.iter().filter(|&&row| row < i).count(), glyphs);
        }
        canvas
    }

    /// An empty line.
    pub(crate) fn blank(&mut self) -> &mut Self {
        self.line(&[]).left_out()
    }

    /// Text that can be left out.
    pub(crate) fn aside(&mut self, text: &str) -> &mut Self {
        for line in wrap(text, WIDTH) {
            self.line(&[(0, &line, Style::PLAIN)]).left_out();
        }
        self
    }

    /// A heading.
    pub(crate) fn title(&mut self, text: &str) -> &mut Self {
        self.text(text, Style::PLAIN.bold())
    }

    /// Text, on as many lines as it needs.
    pub(crate) fn text(&mut self, text: &str, style: Style) -> &mut Self {
        for line in wrap(text, WIDTH) {
            self.line(&[(0, &line, style)]);
        }
        self
    }

    /// A name and its value.
    pub(crate) fn field(&mut self, name: &str, value: &str) -> &mut Self {
        self.styled_field(name, value, Style::PLAIN)
    }

    /// A name and its value, which looks like this.
    pub(crate) fn styled_field(&mut self, name: &str, value: &str, style: Style) -> &mut Self {
        let mut lines = wrap(value, WIDTH - NAME);
        if lines.len() > VALUE_ROWS {
            lines.truncate(VALUE_ROWS - 1);
            lines.push("...".to_owned());
        }
        for (i, line) in lines.iter().enumerate() {
            self.line(&[(0, if i == 0 { name } else { "" }, QUIET), (NAME, line, style)]);
            if i > 0 {
                self.left_out();
            }
        }
        self
    }

    /// Keys and what they do.
    pub(crate) fn keys(&mut self, keys: &[(String, String)]) -> &mut Self {
        keys.iter().fold(self, |panel, (keys, what)| panel.field(keys, what))
    }

    /// A name, a bar as long as the probability, and the probability.
    pub(crate) fn bar(&mut self, name: &str, probability: f64, style: Style) -> &mut Self {
        let name: String = name.chars().take(NAME).collect();
        let halves = (probability.clamp(0.0, 1.0) * 2.0 * BAR as f64).round() as usize;
        let bar = "█".repeat(halves / 2) + if halves % 2 == 1 { "▌" } else { "" };
        let at = NAME + 1;
        self.line(&[(0, &name, style), (at, &bar, style), (at + BAR + 1, &format!("{probability:.3}"), style)])
    }

    /// The last line can be left out.
    fn left_out(&mut self) -> &mut Self {
        self.optional.push(self.canvas.height() - 1);
        self
    }

    fn line(&mut self, parts: &[(usize, &str, Style)]) -> &mut Self {
        let row = self.canvas.height();
        // An empty line is a line, too.
        self.canvas.put(row, 0, "", Style::PLAIN);
        for &(column, text, style) in parts {
            self.canvas.put(row, column, text, style);
        }
        self
    }
}

/// Lines of at most `width` characters, broken at blanks where there are any. At least one line.
pub(crate) fn wrap(text: &str, width: usize) -> Vec<String> {
    let mut lines = vec![String::new()];
    let mut length = 0;
    for word in text.split_whitespace() {
        let mut word: Vec<char> = word.chars().collect();
        if length > 0 && length + 1 + word.len() > width {
            lines.push(String::new());
            length = 0;
        }
        while word.len() > width {
            let rest = word.split_off(width);
            lines.last_mut().into_iter().for_each(|line| line.extend(&word));
            lines.push(String::new());
            word = rest;
        }
        if let Some(line) = lines.last_mut() {
            if length > 0 {
                line.push(' ');
                length += 1;
            }
            line.extend(&word);
            length += word.len();
        }
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrapped_at_blanks() {
        assert_eq!(wrap("a bc def", 4), ["a bc", "def"]);
        assert_eq!(wrap("a bcdefghij k", 4), ["a", "bcde", "fghi", "j k"]);
        assert_eq!(wrap("", 4), [""]);
        assert_eq!(wrap("abcd efgh", 4), ["abcd", "efgh"]);
        assert!(wrap(&"12 ".repeat(100), 10).iter().all(|line| line.len() <= 10));
    }

    #[test]
    fn fields_and_their_rows() {
        let mut panel = Panel::new();
        panel.title("Title").blank().field("score", "0.5").field("observation", &"12345 ".repeat(100));
        let text = panel.canvas().to_text();
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines[..3], ["Title", "", "score        0.5"]);
        assert_eq!(lines[3], "observation  12345 12345 12345 12345 12345");
        assert_eq!(lines.len(), 3 + VALUE_ROWS);
        assert_eq!(lines.last(), Some(&"             ..."));
        assert!(panel.canvas().width() <= WIDTH);
        panel.aside("not needed").field("last", "1");
        assert_eq!(panel.brief().to_text(), format!("Title\nscore        0.5\n{}\nlast         1\n", lines[3]));
    }

    #[test]
    fn bars_are_as_long_as_probabilities() {
        let mut panel = Panel::new();
        for probability in [0.0, 0.025, 0.5, 1.0] {
            panel.bar("a name that is too long", probability, Style::PLAIN);
        }
        let text = panel.canvas().to_text();
        let lengths: Vec<(usize, usize)> =
            text.lines().map(|line| (line.matches('█').count(), line.matches('▌').count())).collect();
        assert_eq!(lengths, [(0, 0), (0, 1), (10, 0), (20, 0)]);
        assert!(text.lines().next_back().unwrap().ends_with(" 1.000"));
        assert!(panel.canvas().width() <= WIDTH);
    }
}
