//! `learner study run` and `learner study list`.

use std::fmt::Write as _;
use std::net::SocketAddr;
use std::path::PathBuf;

use anyhow::anyhow;
use popgym_proto::transport::metrics_address;
use serde_json::json;

use super::{Failure, Outcome, say};
use crate::Extensions;
use crate::interrupt::{EXIT_INTERRUPTED, Interrupt};
use crate::study::dir::{AnotherStudy, Standing, StudyDir};
use crate::study::plan::{self, Trial};
use crate::study::runner::{Runner, Tally};

/// `learner study run`.
#[derive(Debug, clap::Args)]
#[command(after_long_help = STUDY_FILE)]
pub struct StudyRunArgs {
    /// Study file (TOML); `--help` shows one
    pub study: PathBuf,
    /// Directory of the study
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Trials at a time [default: one a core]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=256))]
    pub jobs: Option<u32>,
    /// Run this trial only (`learner study list`), as a task of a Slurm array or an indexed job does; exits 0 only if it is done
    #[arg(long, value_name = "K", conflicts_with = "jobs")]
    pub index: Option<usize>,
    /// Address of a trial for Prometheus: PORT, for this machine alone, or IP:PORT; of those at a time, each has the port after
    /// the other's [default: none]
    #[arg(long, value_name = "ADDR")]
    pub metrics_listen: Option<String>,
    /// Try those again, too, that have failed three times
    #[arg(long)]
    pub retry_failed: bool,
}

/// What `learner study run --help` ends with.
const STUDY_FILE: &str = r#"A study file:

  [run]                                 # keys of every trial's configuration (config.toml of a run shows all)
  preset = "quick"
  steps = 300_000
  stop_at_mmer = 0.95

  [[product]]                           # every combination is a trial
  envs = ["all"]                        # ids, games (RepeatFirst), difficulties (Easy), groups (control), or all
  memories = ["mlp", "gru"]             # names, or all
  seeds = [0, 1, 2]

  [[override]]                          # keys for some of the trials
  envs = ["navigation"]
  run = { steps = 1_000_000 }

  [[override]]
  memories = ["lmu"]
  run = { memory = { theta = 128.0 } }"#;

/// `learner study list`.
#[derive(Debug, clap::Args)]
pub struct StudyListArgs {
    /// Study file (TOML)
    pub study: PathBuf,
    /// Directory of the study, to show how its trials stand
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// Runs the trials of a study that are not done yet.
///
/// # Errors
/// A bad study file, a directory of another study, or a trial that does not exist; a directory that cannot be written.
pub fn study_run(args: &StudyRunArgs, extensions: &Extensions) -> Outcome {
    let (text, trials) = plan::read(&args.study, extensions).map_err(Failure::Usage)?;
    let wanted = match args.index {
        None => &trials[..],
        Some(index) if index < trials.len() => &trials[index..=index],
        Some(index) => {
            let allowed = trials.len() - 1;
            return Err(Failure::Usage(anyhow!("--index is {index}, allowed is 0 to {allowed}: the study's trials")));
        }
    };
    let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let jobs = args.jobs.map_or(cores, |jobs| jobs as usize).min(wanted.len());
    let metrics = args.metrics_listen.as_deref().map(|address| metrics_addresses(address, jobs)).transpose();
    let metrics = metrics.map_err(Failure::Usage)?;
    let dir = StudyDir::open(&args.out, &text, &trials, extensions)
        .map_err(|error| if error.is::<AnotherStudy>() { Failure::Usage(error) } else { Failure::Run(error) })?;
    if args.retry_failed {
        wanted.iter().try_for_each(|trial| dir.forget_failures(trial))?;
    }
    let interrupt = Interrupt::listen(None)?;
    let tally = Runner::new(&dir, wanted, &interrupt, metrics).run(jobs)?;
    say(&describe(tally, wanted, &dir))?;
    // A task of an array has not done its work while another process is at it.
    let missing = tally.failed > 0 || (args.index.is_some() && tally.elsewhere > 0);
    Ok(if tally.left > 0 { EXIT_INTERRUPTED } else { u8::from(missing) })
}

/// The first of as many addresses as there are trials at a time.
fn metrics_addresses(text: &str, jobs: usize) -> anyhow::Result<SocketAddr> {
    let first = metrics_address(text).map_err(anyhow::Error::msg)?;
    let last = usize::from(first.port()) + jobs.saturating_sub(1);
    anyhow::ensure!(
        first.port() != 0 && u16::try_from(last).is_ok(),
        "--metrics-listen is `{text}`, allowed is a port of 1 to 65535 with room above it for {jobs} trials at a time"
    );
    Ok(first)
}

fn describe(tally: Tally, trials: &[Trial], dir: &StudyDir) -> String {
    let Tally { done, failed, elsewhere, left } = tally;
    let mut text = format!("{done} of {} trials done", trials.len());
    for (count, what) in [(failed, "failed"), (elsewhere, "run by other processes"), (left, "left")] {
        if count > 0 {
            let _ = write!(text, ", {count} {what}");
        }
    }
    for trial in trials.iter().filter(|trial| dir.standing(trial) == Standing::Failed) {
        let error = dir.failures(trial).pop().map_or_else(String::new, |failure| failure.error);
        let _ = write!(text, "\n{} failed: {error} (all it said: {})", trial.name, dir.log(trial).display());
    }
    text
}

/// Prints the trials of a study.
///
/// # Errors
/// A bad study file.
pub fn study_list(args: &StudyListArgs, extensions: &Extensions) -> Outcome {
    let (_, trials) = plan::read(&args.study, extensions).map_err(Failure::Usage)?;
    let dir = args.out.as_deref().map(StudyDir::at);
    let standing = |trial: &Trial| dir.as_ref().map(|dir| standing_text(dir.standing(trial)));
    let text = if args.json {
        let trial = |trial: &Trial| {
            let config = &trial.config;
            json!({
                "index": trial.number,
                "name": trial.name,
                "env": config.env,
                "memory": config.memory_name(),
                "seed": config.seed,
                "preset": config.preset,
                "steps": config.steps,
                "stop_at_mmer": config.stop_at_mmer,
                "standing": standing(trial),
            })
        };
        serde_json::to_string_pretty(&trials.iter().map(trial).collect::<Vec<_>>()).map_err(anyhow::Error::from)?
    } else {
        let lines = trials.iter().map(|trial| {
            let Trial { number, env, config, .. } = trial;
            let (memory, seed, steps) = (config.memory_name(), config.seed, config.steps);
            let standing = standing(trial).unwrap_or_default();
            format!("{number:>5}  {env:<32} {memory:<12} seed {seed:<6} {steps:>9} steps  {standing}")
                .trim_end()
                .to_owned()
        });
        lines.collect::<Vec<_>>().join("\n")
    };
    say(&text)?;
    Ok(0)
}

fn standing_text(standing: Standing) -> &'static str {
    match standing {
        Standing::Done => "done",
        Standing::Failed => "failed",
        Standing::Begun => "begun",
        Standing::Fresh => "",
    }
}
