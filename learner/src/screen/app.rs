//! What happens on the screen, from the first picture to the last.

use std::time::Instant;

use popgym_envs::Canvas;

use super::key::Key;
use super::layout::{Layout, Size, too_small};
use super::panel::Panel;
use super::terminal::{Happened, Terminal};

/// What is shown at one moment.
#[derive(Clone, Debug)]
pub(crate) struct Shown {
    /// Pictures.
    pub pictures: Vec<Canvas>,
    /// The text beside them.
    pub panel: Panel,
}

impl Shown {
    /// Pictures, and all of the panel last.
    pub(crate) fn blocks(&self) -> Vec<&Canvas> {
        self.pictures.iter().chain([self.panel.canvas()]).collect()
    }
}

/// Something that is shown on a terminal, and reacts to keys and to time.
pub(crate) trait App {
    /// What it shows now.
    fn shown(&mut self) -> Shown;

    /// A key was pressed; not one of those that leave.
    fn press(&mut self, key: Key) -> anyhow::Result<()>;

    /// When [`App::pass`] is to be called.
    fn due(&self) -> Option<Instant> {
        None
    }

    /// It is time.
    fn pass(&mut self) -> anyhow::Result<()> {
        Ok(())
    }

    /// Whether the person has seen enough.
    fn is_left(&self) -> bool;
}

/// How a person left.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Ending {
    /// By a key.
    Left,
    /// By Ctrl-C or a signal.
    Interrupted,
}

/// Shows `app` on the terminal until the person leaves.
///
/// # Errors
/// A terminal that fails, or whatever `app` fails with. The terminal is restored before.
pub(crate) fn run(app: &mut impl App) -> anyhow::Result<Ending> {
    let mut terminal = Terminal::take()?;
    let mut layouts = Default::default();
    while !app.is_left() {
        terminal.show(&frame(&app.shown(), &mut layouts, Terminal::size()))?;
        match terminal.wait(app.due())? {
            Happened::EndAsked | Happened::Key(Key::Interrupt) => return Ok(Ending::Interrupted),
            Happened::Key(key) if key.leaves() => return Ok(Ending::Left),
            Happened::Key(key) => app.press(key)?,
            Happened::Resized => {}
            Happened::Due => app.pass()?,
        }
    }
    Ok(Ending::Left)
}

/// All that is shown, or else what is needed, or else how large the terminal must be.
pub(crate) fn frame(shown: &Shown, [full, short]: &mut [Layout; 2], room: Size) -> Canvas {
    full.fit(&shown.blocks(), room).unwrap_or_else(|_| {
        let brief = shown.panel.brief();
        let blocks: Vec<&Canvas> = shown.pictures.iter().chain([&brief]).collect();
        short.fit(&blocks, room).unwrap_or_else(|needed| too_small(room, needed))
    })
}
