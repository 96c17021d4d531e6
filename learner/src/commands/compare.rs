//! `learner compare`: runs over one another.

use std::path::PathBuf;

use anyhow::Context as _;

use super::{Failure, Outcome, say};
use crate::files;
use crate::report::comparison::Comparison;
use crate::report::text::aligned;

/// `learner compare`.
#[derive(Debug, clap::Args)]
pub struct CompareArgs {
    /// Directories of runs, two or more
    #[arg(required = true, num_args = 2.., value_name = "RUN")]
    pub runs: Vec<PathBuf>,
    /// Where compare.svg and compare.html go
    #[arg(long, value_name = "DIR", default_value = "compare")]
    pub out: PathBuf,
}

/// Draws the runs' curves over one another, and prints a table of what they came to and when.
///
/// # Errors
/// A directory without a run that can be read; files that cannot be written.
pub fn compare(args: &CompareArgs) -> Outcome {
    let comparison = Comparison::read(&args.runs).map_err(Failure::Usage)?;
    for note in &comparison.notes {
        eprintln!("note: {note}");
    }
    let (svg, html) = (args.out.join("compare.svg"), args.out.join("compare.html"));
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot create {}", args.out.display()))?;
    files::write(&svg, &comparison.svg()?)?;
    files::write(&html, &comparison.html()?)?;
    say(&format!("{}\n\n{}\n{}", aligned(&comparison.table()), svg.display(), html.display()))?;
    Ok(0)
}
