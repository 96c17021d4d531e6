//! The command line.

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use clap::error::ErrorKind;
use clap::{Parser, Subcommand, ValueEnum};
use serde::Serialize;
use toml::{Table, Value};

use crate::commands::{CompareArgs, ReportArgs, StudyListArgs, StudyRunArgs};
use crate::ppo_keys::PpoFlags;

/// Trains agents that must remember: PPO on whole episodes, sampled by actors.
#[derive(Debug, Parser)]
#[command(name = "learner", version)]
pub struct Args {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// What to do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Train an agent; without flags, GRU on RepeatPreviousEasy into a new directory below runs/
    Train(Box<TrainArgs>),
    /// Continue a run from its last checkpoint
    Resume(ResumeArgs),
    /// Play episodes with a trained agent, never those it was trained on
    Eval(EvalArgs),
    /// Play an environment yourself, in the terminal
    Play(PlayArgs),
    /// Watch a trained agent play, in the terminal or as an animated GIF
    Watch(WatchArgs),
    /// Write a trained agent as a file that other programs run
    Export(ExportArgs),
    /// Draw runs over one another, by steps and by wall time
    Compare(CompareArgs),
    /// Many runs: environments x memories x seeds
    #[command(subcommand)]
    Study(StudyCommand),
    /// Show what can be named
    List(ListArgs),
}

/// `learner study`.
#[derive(Debug, Subcommand)]
pub enum StudyCommand {
    /// Run the trials of a study that are not done yet; each is a run directory
    Run(StudyRunArgs),
    /// Show the trials of a study
    List(StudyListArgs),
    /// Tables and figures of any runs, beside the paper's
    Report(ReportArgs),
}

/// `learner train`.
#[derive(Debug, clap::Args)]
pub struct TrainArgs {
    /// Configuration file (TOML); flags win over it
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Directory of the run [default: a new one below runs/]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Resume if DIR holds a run of the same configuration, start if it is empty
    #[arg(long = "continue", requires = "out")]
    pub continue_run: bool,
    /// Memory (`learner list memories`) [default: gru]
    #[arg(long, value_name = "NAME")]
    pub memory: Option<String>,
    /// Stop, as after Ctrl-C, when standard input ends
    #[arg(long, hide = true)]
    pub with_parent: bool,
    /// How it ends when it is asked to.
    #[command(flatten)]
    pub stop: StopFlags,
    /// Keys of the run.
    #[command(flatten)]
    pub run: RunFlags,
    /// Keys of `[service]`.
    #[command(flatten)]
    pub service: ServiceFlags,
    /// Keys of `[policy]`.
    #[command(flatten)]
    pub policy: PolicyFlags,
    /// Keys of `[ppo]`.
    #[command(flatten)]
    pub ppo: PpoFlags,
}

/// How a run ends when it is asked to.
#[derive(Debug, clap::Args)]
pub struct StopFlags {
    /// After SIGTERM the run is saved and ends within as many seconds, 1 to 3600
    #[arg(long, value_name = "SECONDS", default_value_t = 30, value_parser = clap::value_parser!(u64).range(1..=3600))]
    pub grace: u64,
    /// Exit status after SIGTERM while the run is not complete, 0 to 255: for schedulers to whom 0 is the end of the work
    #[arg(long, value_name = "STATUS", default_value_t = 0)]
    pub sigterm_status: u8,
}

impl StopFlags {
    /// The time between SIGTERM and the end.
    pub fn grace(&self) -> Duration {
        Duration::from_secs(self.grace)
    }
}

/// Keys at the top of the configuration.
#[derive(Debug, Default, clap::Args, Serialize)]
pub struct RunFlags {
    /// Environment (`learner list envs`) [default: RepeatPreviousEasy]
    #[arg(long, value_name = "ID")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub env: Option<String>,
    /// What the agent is shown: partial, full (the hidden state), full-and-partial, or full-in-info (as partial) [default: partial]
    #[arg(long, value_name = "LEVEL")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub observability: Option<String>,
    /// Where defaults come from (`learner list presets`) [default: quick]
    #[arg(long, value_name = "NAME")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub preset: Option<String>,
    /// Stop after the first epoch with as many environment steps [default: 1000000 quick, 15000000 paper]
    #[arg(long, value_name = "N")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub steps: Option<u64>,
    /// Stop after the first epoch whose MMER reaches X
    #[arg(long, value_name = "X", allow_hyphen_values = true)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stop_at_mmer: Option<f64>,
    /// Seed of everything random in the run [default: 0]
    #[arg(long, value_name = "S", allow_negative_numbers = true, value_parser = seed())]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seed: Option<u64>,
    /// 0: sample with the newest weights; 1: with those before, while the learner learns [default: 0]
    #[arg(long, value_name = "0|1")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lag: Option<u32>,
    /// auto, cpu or cuda [default: auto]
    #[arg(long, value_name = "D")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub device: Option<String>,
    /// Threads of the learner's libtorch; results depend on it: give it where machines differ [default: one a core, 8 at most]
    #[arg(long, value_name = "N")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub threads: Option<u32>,
    /// An episode that reaches as many steps is truncated [default: 1024]
    #[arg(long, value_name = "N")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_episode_steps: Option<u32>,
    /// Rows that actors pad to on machines where results depend on the number of rows [default: 128]
    #[arg(long, value_name = "N")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rows: Option<u32>,
    /// Epochs between checkpoints [default: 10]
    #[arg(long, value_name = "N")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub checkpoint_epochs: Option<u64>,
    /// Checkpoints kept, beside the best [default: 3]
    #[arg(long, value_name = "N")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keep_checkpoints: Option<u32>,
}

/// Keys of `[service]`.
#[derive(Debug, Default, clap::Args, Serialize)]
#[command(next_help_heading = "Service")]
pub struct ServiceFlags {
    /// Local actor processes; 0 waits for remote ones [default: one a core]
    #[arg(long, value_name = "N")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub actors: Option<u32>,
    /// Episodes that a local actor steps at a time [default: 128]
    #[arg(long, value_name = "N")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub slots: Option<u32>,
    /// How a local actor is started: program and first arguments, @self for this program [default: the actor beside it]
    #[arg(long, value_name = "COMMAND", value_delimiter = ' ')]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub actor_command: Option<Vec<String>>,
    /// Address for actors [default: 127.0.0.1:0, or 127.0.0.1:50051 with --actors 0]
    #[arg(long, value_name = "ADDR")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub listen: Option<String>,
    /// Address for Prometheus: PORT, for this machine alone, or IP:PORT [default: none]
    #[arg(long, value_name = "ADDR")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub metrics_listen: Option<String>,
    /// File of the token that actors must show (16 to 1,024 characters) [default: none]
    #[arg(long, value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub token_file: Option<String>,
    /// File of the learner's certificate, PEM: actors then connect by https:// [default: none]
    #[arg(long, value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls_certificate: Option<String>,
    /// File of the certificate's private key, PEM
    #[arg(long, value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls_key: Option<String>,
    /// File of the CA that signs actors' certificates, PEM [default: none, actors need no certificate]
    #[arg(long, value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls_client_ca: Option<String>,
    /// Listen beyond this machine even without TLS or a token: only on a network whose every user you trust
    #[arg(long, num_args = 0..=1, require_equals = true, default_missing_value = "true", value_name = "BOOL")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub insecure: Option<bool>,
}

/// Keys of `[policy]`.
#[derive(Debug, Default, clap::Args, Serialize)]
#[command(next_help_heading = "Policy")]
pub struct PolicyFlags {
    /// Smallest log standard deviation of a continuous action
    #[arg(long, value_name = "X", allow_hyphen_values = true)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub log_std_min: Option<f64>,
    /// Largest log standard deviation of a continuous action
    #[arg(long, value_name = "X", allow_hyphen_values = true)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub log_std_max: Option<f64>,
}

/// `learner resume`.
#[derive(Debug, clap::Args)]
pub struct ResumeArgs {
    /// Directory of the run
    pub dir: PathBuf,
    /// Stop after the first epoch with as many environment steps [default: as configured]
    #[arg(long, value_name = "N")]
    pub steps: Option<u64>,
    /// auto, cpu or cuda [default: as configured]
    #[arg(long, value_name = "D")]
    pub device: Option<String>,
    /// How it ends when it is asked to.
    #[command(flatten)]
    pub stop: StopFlags,
    /// Keys of `[service]`.
    #[command(flatten)]
    pub service: ServiceFlags,
}

/// `learner export`.
#[derive(Debug, clap::Args)]
pub struct ExportArgs {
    /// Directory of the run
    pub dir: PathBuf,
    /// TorchScript of one time step, for Python's torch.jit.load and for C++; FILE.json says what goes in and out
    #[arg(long, value_name = "FILE")]
    pub torchscript: PathBuf,
    /// Which weights: of the checkpoint with the best mean return, or the last
    #[arg(long, value_enum, default_value_t = Which::Best)]
    pub checkpoint: Which,
}

/// `learner eval`.
#[derive(Debug, clap::Args)]
pub struct EvalArgs {
    /// Directory of the run
    pub dir: PathBuf,
    /// Episodes to play
    #[arg(long, value_name = "N", default_value_t = 100)]
    pub episodes: u64,
    /// Seed of the episodes; they are never those of training
    #[arg(long, value_name = "S", default_value_t = 0, allow_negative_numbers = true, value_parser = seed())]
    pub seed: u64,
    /// Which weights: of the checkpoint with the best mean return, or the last
    #[arg(long, value_enum, default_value_t = Which::Best)]
    pub checkpoint: Which,
    /// Play another environment: another difficulty of the run's, or any whose spaces are the same
    #[arg(long, value_name = "ID")]
    pub env: Option<String>,
    /// Take the likeliest actions, draw none
    #[arg(long)]
    pub greedy: bool,
    /// Local actor processes
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub actors: u32,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// `learner play`.
#[derive(Debug, clap::Args)]
#[command(after_help = "The keys are shown beside the picture; q, Esc or Ctrl-C leaves.")]
pub struct PlayArgs {
    /// Environment (`learner list envs`)
    #[arg(long, value_name = "ID")]
    pub env: String,
    /// Seed of the episodes; the same seed is the same game [default: of the clock]
    #[arg(long, value_name = "S", allow_negative_numbers = true, value_parser = seed())]
    pub seed: Option<u64>,
    /// Show the hidden state, too
    #[arg(long)]
    pub reveal: bool,
    /// Episodes to play
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub episodes: u64,
}

/// `learner watch`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Keys: Space pauses, then the right arrow takes one step; + and - change the speed; q, Esc or Ctrl-C leaves."
)]
pub struct WatchArgs {
    /// Directory of the run
    pub dir: PathBuf,
    /// Episodes to watch
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub episodes: u64,
    /// Seed of the episodes: those that `learner eval` plays with it, never those of training
    #[arg(long, value_name = "S", default_value_t = 0, allow_negative_numbers = true, value_parser = seed())]
    pub seed: u64,
    /// Which weights: of the checkpoint with the best mean return, or the last
    #[arg(long, value_enum, default_value_t = Which::Best)]
    pub checkpoint: Which,
    /// Steps a second
    #[arg(long, value_name = "X", default_value_t = 4.0, allow_negative_numbers = true)]
    pub speed: f64,
    /// Take the likeliest action, draw none
    #[arg(long)]
    pub greedy: bool,
    /// Show only what the agent sees, not the hidden state
    #[arg(long)]
    pub observed: bool,
    /// Write an animated GIF instead; needs no terminal
    #[arg(long, value_name = "FILE")]
    pub gif: Option<PathBuf>,
}

/// Which checkpoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Which {
    /// The one with the best mean return.
    Best,
    /// The last.
    Last,
}

/// `learner list`.
#[derive(Debug, clap::Args)]
pub struct ListArgs {
    /// What to list
    #[arg(value_enum)]
    pub what: Listed,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// What can be listed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Listed {
    /// Environments.
    Envs,
    /// Memories.
    Memories,
    /// Presets.
    Presets,
}

impl TrainArgs {
    /// The flags that were given, as a configuration table.
    ///
    /// # Errors
    /// A number too large for TOML.
    pub fn table(&self) -> anyhow::Result<Table> {
        let mut table = Table::try_from(&self.run)?;
        insert(&mut table, "service", Table::try_from(&self.service)?);
        insert(&mut table, "policy", Table::try_from(&self.policy)?);
        insert(&mut table, "ppo", Table::try_from(&self.ppo)?);
        if let Some(memory) = &self.memory {
            let memory = Table::from_iter([("name".to_owned(), Value::String(memory.clone()))]);
            insert(&mut table, "memory", memory);
        }
        Ok(table)
    }
}

impl ResumeArgs {
    /// The flags that were given, as a configuration table.
    ///
    /// # Errors
    /// A number too large for TOML.
    pub fn table(&self) -> anyhow::Result<Table> {
        let flags = RunFlags { steps: self.steps, device: self.device.clone(), ..RunFlags::default() };
        let mut table = Table::try_from(flags)?;
        insert(&mut table, "service", Table::try_from(&self.service)?);
        Ok(table)
    }
}

/// Prints what clap says: help and version as they are, an error and its tip in one line.
pub(crate) fn usage(error: &clap::Error) -> ExitCode {
    if !error.use_stderr() || error.kind() == ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand {
        // Nothing better to do if nobody reads it.
        let _ = error.print();
        return ExitCode::from(if error.use_stderr() { 2 } else { 0 });
    }
    let text = error.to_string();
    let telling = text.lines().map(str::trim).take_while(|line| !line.starts_with("Usage:"));
    let lines: Vec<&str> = telling.filter(|line| !line.is_empty() && !line.starts_with("For more")).collect();
    eprintln!("{}", lines.join("; "));
    ExitCode::from(2)
}

/// TOML's integers end at 2^63 - 1.
fn seed() -> clap::builder::RangedU64ValueParser<u64> {
    clap::value_parser!(u64).range(0..=i64::MAX as u64)
}

fn insert(table: &mut Table, key: &str, part: Table) {
    if !part.is_empty() {
        table.insert(key.to_owned(), Value::Table(part));
    }
}
