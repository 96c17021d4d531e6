//! The terminal: taken as a whole, and given back as it was, however the program ends.

use std::io::{self, IsTerminal as _, Write as _};
use std::sync::Once;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use crossterm::cursor::{Hide, MoveTo, Show};
use crossterm::event::{self, Event};
use crossterm::style::{Print, ResetColor};
use crossterm::terminal::{Clear, ClearType, EnterAlternateScreen, LeaveAlternateScreen};
use crossterm::{execute, queue};
use popgym_envs::Canvas;

use super::key::Key;
use super::layout::Size;
use super::signals::EndAsked;

/// How often a wait looks whether a signal has come.
const SIGNAL_INTERVAL: Duration = Duration::from_millis(50);

/// What a terminal is taken for that does not know its size.
const USUAL: Size = Size { columns: 80, rows: 24 };

/// Whether the terminal is ours now.
static TAKEN: AtomicBool = AtomicBool::new(false);

/// What ended a wait.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Happened {
    /// A key was pressed.
    Key(Key),
    /// The terminal has another size.
    Resized,
    /// A signal asks to end.
    EndAsked,
    /// It is time.
    Due,
}

/// The terminal, taken: without echo, without the user's own screen and cursor. Dropped, it is as before.
pub(crate) struct Terminal {
    end_asked: EndAsked,
    /// The rows that it shows, with their escape sequences.
    shown: Vec<String>,
}

impl Terminal {
    /// Checks that there is a terminal to read keys from and to draw on. `command` is for the message.
    ///
    /// # Errors
    /// Which of the two there is not.
    pub(crate) fn check(command: &str) -> anyhow::Result<()> {
        let ends = [("input", io::stdin().is_terminal()), ("output", io::stdout().is_terminal())];
        match ends.iter().find(|(_, is_terminal)| !is_terminal) {
            Some((end, _)) => anyhow::bail!("`learner {command}` needs a terminal, and standard {end} is none"),
            None => Ok(()),
        }
    }

    /// Takes the terminal.
    ///
    /// # Errors
    /// It cannot be had.
    pub(crate) fn take() -> anyhow::Result<Self> {
        let end_asked = EndAsked::listen()?;
        restore_before_panics();
        // Set first: what follows may get halfway.
        TAKEN.store(true, Ordering::SeqCst);
        let terminal = Self { end_asked, shown: Vec::new() };
        crossterm::terminal::enable_raw_mode().context("the terminal cannot be put into raw mode")?;
        execute!(io::stdout(), EnterAlternateScreen, Hide, Clear(ClearType::All)).context(WRITE)?;
        Ok(terminal)
    }

    /// Its present size.
    pub(crate) fn size() -> Size {
        let (columns, rows) = crossterm::terminal::size().unwrap_or_default();
        if columns == 0 || rows == 0 { USUAL } else { Size { columns: columns.into(), rows: rows.into() } }
    }

    /// Shows `frame`, which is not larger than the terminal; only rows that have changed are written. The hidden cursor is put
    /// into the corner last: when it is there, the frame is whole.
    ///
    /// # Errors
    /// The terminal cannot be written to.
    pub(crate) fn show(&mut self, frame: &Canvas) -> anyhow::Result<()> {
        let rows: Vec<String> = frame.to_ansi().lines().map(str::to_owned).collect();
        let mut out = Vec::new();
        for i in 0..rows.len().max(self.shown.len()) {
            let row = rows.get(i).map_or("", String::as_str);
            if self.shown.get(i).is_none_or(|shown| shown != row) {
                queue!(out, MoveTo(0, i as u16), Clear(ClearType::CurrentLine), Print(row)).context(WRITE)?;
            }
        }
        queue!(out, MoveTo(0, 0)).context(WRITE)?;
        let mut terminal = io::stdout().lock();
        terminal.write_all(&out).and_then(|()| terminal.flush()).context(WRITE)?;
        self.shown = rows;
        Ok(())
    }

    /// Waits until something happens, or until `due`.
    ///
    /// # Errors
    /// The terminal cannot be read.
    pub(crate) fn wait(&mut self, due: Option<Instant>) -> anyhow::Result<Happened> {
        loop {
            if self.end_asked.is_set() {
                return Ok(Happened::EndAsked);
            }
            let left = due.map_or(SIGNAL_INTERVAL, |due| due.saturating_duration_since(Instant::now()));
            if event::poll(left.min(SIGNAL_INTERVAL)).context(READ)? {
                match event::read().context(READ)? {
                    Event::Key(event) => {
                        if let Some(key) = Key::of(event) {
                            return Ok(Happened::Key(key));
                        }
                    }
                    Event::Resize(..) => {
                        self.forget()?;
                        return Ok(Happened::Resized);
                    }
                    _ => {}
                }
            } else if due.is_some_and(|due| due <= Instant::now()) {
                return Ok(Happened::Due);
            }
        }
    }

    /// Empties the screen: a terminal of another size may have moved what it showed.
    fn forget(&mut self) -> anyhow::Result<()> {
        self.shown.clear();
        execute!(io::stdout(), Clear(ClearType::All)).context(WRITE)
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        restore();
    }
}

const WRITE: &str = "the terminal cannot be written to";
const READ: &str = "the terminal cannot be read";

/// Gives the terminal back, if it is ours.
pub(crate) fn restore() {
    if TAKEN.swap(false, Ordering::SeqCst) {
        // Nothing better to do where this fails: the terminal has gone.
        let _ = crossterm::terminal::disable_raw_mode();
        let _ = execute!(io::stdout(), ResetColor, Show, LeaveAlternateScreen);
    }
}

/// What a panic says is to be read on the user's own screen.
fn restore_before_panics() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let before = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            restore();
            before(panic);
        }));
    });
}
