//! popgym-rs's learner: PPO on whole episodes, the service for actors, and the user's commands.
//!
//! | module | holds |
//! |---|---|
//! | [`commands`] | `train`, `resume`, `eval`, `play`, `watch`, `compare`, `study`, `list` |
//! | [`config`], [`ppo_keys`] | the configuration: presets, file and flags merged |
//! | [`trainer`] | the epochs of a run, one after the other |
//! | [`update`] | PPO, top to bottom; [`batch`], [`gae`], [`minibatches`], [`loss`] and [`adam`] are what it uses |
//! | [`service`] | sessions with actors, leases, episodes |
//! | [`local_actors`] | actor processes on this machine |
//! | [`checkpoint`], [`run_dir`] | what a run leaves on disk to continue from |
//! | [`study`] | many runs: environments x memories x seeds |
//! | [`report`] | tables, figures and a page of many runs, beside the paper's |
//! | `chart` | what all charts share |
//! | `fail_point` | where tests have the learner die |
//! | [`statistics`] | means, quantiles, intervals, rank correlation |
//! | `screen` | environments on a terminal and as animated images: what `play` and `watch` show |
//! | [`baseline`], [`space_text`] | what acting at random scores; spaces in words |
//! | [`page`] | the run in a browser, on the metrics port |
//! | [`observer`] | what a run tells: files, progress bar, TensorBoard, Prometheus |
//!
//! A user's own `main` adds environments, memories and observers to [`Extensions`] and calls [`run`].

pub mod adam;
pub mod args;
pub mod baseline;
pub mod batch;
mod chart;
pub mod checkpoint;
pub mod commands;
pub mod config;
mod fail_point;
mod files;
pub mod gae;
pub mod interrupt;
pub mod local_actors;
pub mod loss;
pub mod manifest;
pub mod minibatches;
pub mod observer;
pub mod page;
pub mod ppo_keys;
pub mod report;
pub mod run_dir;
mod screen;
pub mod service;
pub mod session;
pub mod space_text;
pub mod statistics;
pub mod study;
pub mod trainer;
pub mod update;
pub mod waiting;

use std::ffi::OsString;
use std::io::IsTerminal;
use std::process::ExitCode;

use clap::Parser;

use crate::args::{Args, Command, StudyCommand};
use crate::commands::Failure;
use crate::observer::{Observer, Progress};

/// What a user's own program adds to popgym-rs.
pub struct Extensions {
    /// The environments that can be named.
    pub envs: popgym_envs::Registry,
    /// The memories that can be named.
    pub memories: popgym_models::memory::Registry,
    /// Observers beside those of the learner.
    pub observers: Vec<Box<dyn Observer>>,
    /// How local actors are started unless the key `service.actor_command` says it: a program and its first arguments.
    /// [`local_actors::THIS_PROGRAM`] stands for the running program. Empty: the `actor` beside it.
    pub actor_command: Vec<String>,
}

impl Default for Extensions {
    fn default() -> Self {
        Self {
            envs: popgym_envs::Registry::standard(),
            memories: popgym_models::memory::Registry::standard(),
            observers: Vec::new(),
            actor_command: Vec::new(),
        }
    }
}

/// The whole program: `arguments` as from the command line, the program's name first.
///
/// Exit status: 0 done, 1 failed, 2 bad usage or configuration, 130 interrupted. Results go to standard output, all else to
/// standard error.
pub fn run(extensions: Extensions, arguments: impl IntoIterator<Item = OsString>) -> ExitCode {
    waiting::settle();
    let args = match Args::try_parse_from(arguments) {
        Ok(args) => args,
        Err(error) => {
            return args::usage(&error);
        }
    };
    let filter = tracing_subscriber::EnvFilter::try_from_default_env().unwrap_or_else(|_| "info".into());
    // Fails only where the caller has set up logging already, which is then what it wants.
    let _ = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(Progress::log_writer)
        .with_ansi(std::io::stderr().is_terminal())
        .with_target(false)
        .try_init();
    let result = match args.command {
        Command::Train(args) => commands::train(&args, extensions),
        Command::Resume(args) => commands::resume(&args, extensions),
        Command::Eval(args) => commands::eval(&args, &extensions),
        Command::Export(args) => commands::export(&args, &extensions),
        Command::Play(args) => commands::play(&args, &extensions),
        Command::Watch(args) => commands::watch(&args, &extensions),
        Command::Study(StudyCommand::Run(args)) => commands::study_run(&args, &extensions),
        Command::Study(StudyCommand::List(args)) => commands::study_list(&args, &extensions),
        Command::Compare(args) => commands::compare(&args),
        Command::Study(StudyCommand::Report(args)) => commands::report(&args, &extensions),
        Command::List(args) => commands::list(&args, &extensions),
    };
    match result {
        Ok(status) => ExitCode::from(status),
        Err(Failure::Usage(error)) => {
            eprintln!("error: {error:#}");
            ExitCode::from(2)
        }
        Err(Failure::Run(error)) => {
            eprintln!("error: {error:#}");
            ExitCode::from(1)
        }
    }
}
