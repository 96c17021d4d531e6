//! The user's commands.

use std::io::{ErrorKind, Write};
use std::path::Path;

use crate::args::Which;
use crate::checkpoint::{self, Checkpoint};

mod compare;
mod eval;
mod export;
mod list;
mod play;
mod report;
mod study;
mod train;
mod watch;

pub use compare::{CompareArgs, compare};
pub use eval::eval;
pub use export::export;
pub use list::list;
pub use play::play;
pub use report::{ReportArgs, report};
pub use study::{StudyListArgs, StudyRunArgs, study_list, study_run};
pub use train::{resume, train};
pub use watch::watch;

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

/// The checkpoint of the run in `dir` that the user has asked for, if there is any; its optimiser has `parameters` numbers.
fn choose_checkpoint(dir: &Path, which: Which, parameters: i64) -> anyhow::Result<Option<Checkpoint>> {
    let checkpoints = dir.join("checkpoints");
    match which {
        Which::Last => Checkpoint::latest(&checkpoints, parameters, u64::MAX),
        Which::Best => {
            let best = checkpoint::best(&checkpoints)?;
            best.map(|path| Checkpoint::load(&path, parameters)).transpose()
        }
    }
}

/// The exit status of a command, or why it has none.
pub type Outcome = Result<u8, Failure>;
