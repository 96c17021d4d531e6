//! `summary.json`: what a run came to.

use std::path::PathBuf;

use super::{Observer, RunStart, Summary};
use crate::files;

/// Writes `summary.json` at the end of a run.
#[derive(Debug, Default)]
pub struct SummaryJson {
    dir: PathBuf,
}

impl SummaryJson {
    /// The file's name in the run directory.
    pub const FILE: &str = "summary.json";

    /// An observer that learns the directory when the run starts.
    pub fn new() -> Self {
        Self::default()
    }
}

impl Observer for SummaryJson {
    fn run_start(&mut self, start: &RunStart) -> anyhow::Result<()> {
        self.dir.clone_from(&start.dir);
        Ok(())
    }

    fn run_end(&mut self, summary: &Summary) -> anyhow::Result<()> {
        files::write(&self.dir.join(Self::FILE), &format!("{}\n", serde_json::to_string_pretty(summary)?))
    }
}
