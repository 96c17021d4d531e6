//! The user's commands.

use std::io::{ErrorKind, Write};

mod eval;
mod list;
mod train;

pub use eval::eval;
pub use list::list;
pub use train::{resume, train};

/// Why a command did not succeed.
#[derive(Debug)]
pub enum Failure {
    /// Bad usage or configuration: exit status 2.
    Usage(anyhow::Error),
    /// Anything else: exit status 1.
    Run(anyhow::Error),
}

impl From<anyhow::Error> for Failure {
    fn from(error: anyhow::Error) -> Self {
        Self::Run(error)
    }
}

/// Writes `text` and a line's end to standard output. That nobody reads it is no failure.
fn say(text: &str) -> anyhow::Result<()> {
    match writeln!(std::io::stdout(), "{text}") {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(error.into()),
        _ => Ok(()),
    }
}

/// The exit status of a command, or why it has none.
pub type Outcome = Result<u8, Failure>;
