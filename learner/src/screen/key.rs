//! What a person pressed.

use crossterm::event::{KeyCode, KeyEvent, KeyEventKind, KeyModifiers};

/// The four ways of an arrow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Direction {
    /// To smaller columns.
    Left,
    /// To larger columns.
    Right,
    /// To smaller rows.
    Up,
    /// To larger rows.
    Down,
}

impl Direction {
    /// All four.
    pub(crate) const ALL: [Self; 4] = [Self::Left, Self::Right, Self::Up, Self::Down];

    /// Words for it.
    pub(crate) fn words(self) -> &'static [&'static str] {
        match self {
            Self::Left => &["left"],
            Self::Right => &["right"],
            Self::Up => &["up", "forward"],
            Self::Down => &["down", "back", "backward"],
        }
    }
}

/// A key that means something here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Key {
    /// An arrow.
    Arrow(Direction),
    /// The end of an entry.
    Enter,
    /// Takes back a character.
    Backspace,
    /// Leaves.
    Escape,
    /// Ctrl-C: a terminal in raw mode sends it as a key.
    Interrupt,
    /// A printable character; letters are small.
    Char(char),
}

impl Key {
    /// Whether it always means to leave.
    pub(crate) fn leaves(self) -> bool {
        matches!(self, Self::Escape | Self::Char('q'))
    }

    /// The key of a terminal's event; none for keys that mean nothing here, and for the release of one.
    pub(crate) fn of(event: KeyEvent) -> Option<Self> {
        if event.kind == KeyEventKind::Release {
            return None;
        }
        if event.modifiers.intersects(KeyModifiers::CONTROL | KeyModifiers::ALT) {
            let interrupt = event.code == KeyCode::Char('c') && event.modifiers.contains(KeyModifiers::CONTROL);
            return interrupt.then_some(Self::Interrupt);
        }
        match event.code {
            KeyCode::Left => Some(Self::Arrow(Direction::Left)),
            KeyCode::Right => Some(Self::Arrow(Direction::Right)),
            KeyCode::Up => Some(Self::Arrow(Direction::Up)),
            KeyCode::Down => Some(Self::Arrow(Direction::Down)),
            KeyCode::Enter => Some(Self::Enter),
            KeyCode::Backspace => Some(Self::Backspace),
            KeyCode::Esc => Some(Self::Escape),
            KeyCode::Char(symbol) => Some(Self::Char(symbol.to_ascii_lowercase())),
            _ => None,
        }
    }
}

impl std::fmt::Display for Key {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Arrow(Direction::Left) => f.write_str("←"),
            Self::Arrow(Direction::Right) => f.write_str("→"),
            Self::Arrow(Direction::Up) => f.write_str("↑"),
            Self::Arrow(Direction::Down) => f.write_str("↓"),
            Self::Enter => f.write_str("Enter"),
            Self::Backspace => f.write_str("Backspace"),
            Self::Escape => f.write_str("Esc"),
            Self::Interrupt => f.write_str("Ctrl-C"),
            Self::Char(' ') => f.write_str("Space"),
            Self::Char(symbol) => write!(f, "{symbol}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_events() {
        let plain = |code| Key::of(KeyEvent::new(code, KeyModifiers::NONE));
        assert_eq!(plain(KeyCode::Up), Some(Key::Arrow(Direction::Up)));
        assert_eq!(plain(KeyCode::Char('7')), Some(Key::Char('7')));
        assert_eq!(plain(KeyCode::F(1)), None);
        let with = |code, modifiers| Key::of(KeyEvent::new(code, modifiers));
        assert_eq!(with(KeyCode::Char('c'), KeyModifiers::CONTROL), Some(Key::Interrupt));
        assert_eq!(with(KeyCode::Char('q'), KeyModifiers::CONTROL), None);
        // Caps lock is no reason not to quit.
        assert_eq!(with(KeyCode::Char('Q'), KeyModifiers::SHIFT), Some(Key::Char('q')));
        let released = KeyEvent::new_with_kind(KeyCode::Enter, KeyModifiers::NONE, KeyEventKind::Release);
        assert_eq!(Key::of(released), None);
    }
}
