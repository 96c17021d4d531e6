//! `learner study report`: what any set of runs came to, beside the paper.

use std::path::PathBuf;

use super::{Failure, Outcome, say};
use crate::Extensions;
use crate::report::collect::{by_text, collect};
use crate::report::figures::Throughput;
use crate::report::{self, FILES};

/// Directories that one note names on the terminal; the report names all.
const SHOWN: usize = 3;

/// `learner study report`.
#[derive(Debug, clap::Args)]
pub struct ReportArgs {
    /// Directories of runs, or with runs at any depth below them
    #[arg(required = true, value_name = "DIR")]
    pub dirs: Vec<PathBuf>,
    /// Where the report goes [default: report below the first DIR]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Show the memories' speed, too: what `cargo bench -p popgym-models -- --json FILE` has written
    #[arg(long, value_name = "FILE")]
    pub throughput: Option<PathBuf>,
}

/// Writes the report of all runs in and below some directories, and prints where its files are.
///
/// # Errors
/// A directory without a run; no run that can be read; a file of throughput that is none; files that cannot be written.
pub fn report(args: &ReportArgs, extensions: &Extensions) -> Outcome {
    let collection = collect(&args.dirs, &extensions.envs, &extensions.memories).map_err(Failure::Usage)?;
    for (text, dirs) in by_text(&collection.notes) {
        let shown: Vec<String> = dirs.iter().take(SHOWN).map(|dir| dir.display().to_string()).collect();
        let more = dirs.len().saturating_sub(SHOWN);
        let more = if more > 0 { format!(" and {more} more") } else { String::new() };
        eprintln!("note: {}{more}: {text}", shown.join(", "));
    }
    if collection.runs.is_empty() {
        let dirs: Vec<String> = args.dirs.iter().map(|dir| dir.display().to_string()).collect();
        return Err(Failure::Usage(anyhow::anyhow!("no run in {} can be reported", dirs.join(", "))));
    }
    let throughput = args.throughput.as_deref().map(Throughput::read).transpose().map_err(Failure::Usage)?;
    let out = args.out.clone().unwrap_or_else(|| args.dirs[0].join("report"));
    report::write(collection, throughput.as_ref(), &out)?;
    let paths: Vec<String> = FILES.iter().map(|name| out.join(name).display().to_string()).collect();
    say(&paths.join("\n"))?;
    Ok(0)
}
