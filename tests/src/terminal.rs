//! A program on a pseudo-terminal: its screen is read, and keys are pressed.

use std::io::{Read as _, Write as _};
use std::num::NonZeroU16;
use std::process::{Child, Command, ExitStatus};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use pty_process::Size;
use pty_process::blocking::{Pts, Pty};
use rustix::process::{Pid, Signal, kill_process};
use rustix::termios::{LocalModes, tcgetattr};

use crate::until;

/// The escape sequences of the arrow keys.
pub mod keys {
    /// Left.
    pub const LEFT: &str = "\x1b[D";
    /// Right.
    pub const RIGHT: &str = "\x1b[C";
    /// Up.
    pub const UP: &str = "\x1b[A";
    /// Down.
    pub const DOWN: &str = "\x1b[B";
    /// Enter.
    pub const ENTER: &str = "\r";
    /// Escape.
    pub const ESCAPE: &str = "\x1b";
    /// Ctrl-C.
    pub const CTRL_C: &str = "\x03";
}

/// A program on a terminal of its own; it dies with this value.
pub struct Terminal {
    name: String,
    child: Child,
    pty: Arc<Pty>,
    /// The program's end of it; kept, so that its modes can be asked for after the program's end.
    pts: Option<Pts>,
    parser: Arc<Mutex<vt100::Parser>>,
    reader: Option<JoinHandle<()>>,
}

impl Terminal {
    /// Starts `command` on a terminal of so many columns and rows; `name` is for messages.
    ///
    /// # Panics
    /// If that is not possible.
    pub fn start(name: &str, command: Command, (columns, rows): (u16, u16)) -> Self {
        let (pty, pts) = pty_process::blocking::open().expect("a pseudo-terminal");
        pty.resize(Size::new(rows, columns)).expect("a size");
        // A backtrace would push what is looked for off the screen.
        let mut command = pty_process::blocking::Command::from(command)
            .env("TERM", "xterm-256color")
            .env_remove("RUST_BACKTRACE")
            .env_remove("RUST_LIB_BACKTRACE");
        let child = command.spawn_borrowed(&pts).unwrap_or_else(|error| panic!("cannot start {name}: {error}"));
        let parser = vt100::Parser::new(length(rows), length(columns), 0);
        let (pty, parser) = (Arc::new(pty), Arc::new(Mutex::new(parser)));
        let reader = {
            let (pty, parser) = (Arc::clone(&pty), Arc::clone(&parser));
            std::thread::spawn(move || {
                let mut bytes = [0; 4096];
                // Fails when nobody has the other end any more.
                while let Ok(count @ 1..) = (&*pty).read(&mut bytes) {
                    lock(&parser).process(&bytes[..count]);
                }
            })
        };
        Self { name: name.to_owned(), child, pty, pts: Some(pts), parser, reader: Some(reader) }
    }

    /// What is on the screen.
    pub fn text(&self) -> String {
        lock(&self.parser).screen().contents()
    }

    /// Whether the program has the terminal for itself: the screen beside the user's own, and no cursor.
    pub fn is_taken(&self) -> (bool, bool) {
        let parser = lock(&self.parser);
        (parser.screen().alternate_screen(), parser.screen().hide_cursor())
    }

    /// Whether what is typed is echoed, and given to the program line by line.
    ///
    /// # Panics
    /// If the terminal does not tell.
    pub fn is_cooked(&self) -> (bool, bool) {
        let pts = self.pts.as_ref().expect("kept until the end");
        let modes = tcgetattr(pts).expect("a terminal's modes").local_modes;
        (modes.contains(LocalModes::ECHO), modes.contains(LocalModes::ICANON))
    }

    /// Asserts that the program has left the terminal as it was.
    ///
    /// # Panics
    /// If it has not.
    #[track_caller]
    pub fn assert_restored(&self) {
        assert_eq!(self.is_taken(), (false, false), "{}: the other screen, no cursor", self.name);
        assert_eq!(self.is_cooked(), (true, true), "{}: echo, line by line", self.name);
    }

    /// Presses keys, as a terminal sends them.
    ///
    /// # Panics
    /// If they cannot be sent.
    pub fn press(&self, keys: &str) {
        (&*self.pty).write_all(keys.as_bytes()).expect("a terminal takes keys");
    }

    /// Waits until a whole frame is on the screen in which `poll` finds something.
    ///
    /// # Panics
    /// If the program ends before that, or past the deadline, with what is on the screen.
    #[track_caller]
    pub fn until<T>(&mut self, what: &str, mut poll: impl FnMut(&str) -> Option<T>) -> T {
        let (name, child, parser) = (&self.name, &mut self.child, &self.parser);
        let mut last = String::new();
        let found = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            until(what, || {
                // Asked first: what a process does last still counts.
                let running = matches!(child.try_wait(), Ok(None));
                let (whole, text) = {
                    let parser = lock(parser);
                    (parser.screen().cursor_position() == (0, 0), parser.screen().contents())
                };
                let value = if whole { poll(&text) } else { None };
                assert!(running || value.is_some(), "{name} has ended before {what}");
                last = text;
                value
            })
        }));
        found.unwrap_or_else(|panic| {
            eprintln!("--- on the screen of {name}:\n{last}\n---");
            std::panic::resume_unwind(panic)
        })
    }

    /// Waits for a frame that shows `text`.
    ///
    /// # Panics
    /// As [`Terminal::until`].
    #[track_caller]
    pub fn shows(&mut self, text: &str) {
        self.until(text, |screen| screen.contains(text).then_some(()));
    }

    /// Waits for a frame with a line that holds `name` and then, after blanks, a value: that value, with what follows it.
    ///
    /// # Panics
    /// As [`Terminal::until`].
    #[track_caller]
    pub fn value(&mut self, name: &str) -> String {
        self.until(name, |screen| field(screen, name))
    }

    /// Waits until the value after `name` begins with `value`.
    ///
    /// # Panics
    /// As [`Terminal::until`].
    #[track_caller]
    pub fn has(&mut self, name: &str, value: &str) {
        self.until(&format!("`{name} {value}`"), |screen| field(screen, name).filter(|found| found.starts_with(value)));
    }

    /// Gives the terminal another size.
    ///
    /// # Panics
    /// If that is not possible.
    pub fn resize(&self, columns: u16, rows: u16) {
        lock(&self.parser).set_size(length(rows), length(columns));
        self.pty.resize(Size::new(rows, columns)).expect("a size");
    }

    /// Sends a signal.
    ///
    /// # Panics
    /// If the program has ended.
    pub fn signal(&mut self, signal: Signal) {
        assert!(matches!(self.child.try_wait(), Ok(None)), "{} has ended before {signal:?}", self.name);
        kill_process(Pid::from_child(&self.child), signal).expect("a running child can be signalled");
    }

    /// Waits for its end with this exit code; gives what is on the screen then, when `last` is, too.
    ///
    /// # Panics
    /// If it ends otherwise, or past the deadline.
    #[track_caller]
    pub fn expect(&mut self, code: i32, last: &str) -> String {
        let status: ExitStatus =
            until(&format!("the end of {}", self.name), || self.child.try_wait().expect("a child"));
        assert_eq!(status.code(), Some(code), "{}: {status}, expected {code}\n{}", self.name, self.text());
        // The last that it wrote may still be on its way.
        until(&format!("`{last}` from {}", self.name), || Some(self.text()).filter(|text| text.contains(last)))
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        // Fails only for a process that has ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
        // Now nobody has the other end, and the reader ends.
        self.pts = None;
        let _ = self.reader.take().map(JoinHandle::join);
    }
}

/// What follows `name` and at least two blanks on a line of the screen.
fn field(screen: &str, name: &str) -> Option<String> {
    let value = |line: &str| line.split_once(&format!("{name}  ")).map(|(_, rest)| rest.trim().to_owned());
    screen.lines().find_map(value)
}

fn lock(parser: &Mutex<vt100::Parser>) -> MutexGuard<'_, vt100::Parser> {
    parser.lock().unwrap_or_else(PoisonError::into_inner)
}

fn length(cells: u16) -> NonZeroU16 {
    NonZeroU16::new(cells).expect("a terminal has a size")
}
