//! `learner train` and `learner resume`.

use std::path::Path;
use std::time::{Duration, Instant};

use popgym_proto::monitor;
use tch::Device;

use super::{Failure, Outcome, say};
use crate::Extensions;
use crate::args::{ResumeArgs, TrainArgs};
use crate::checkpoint::Checkpoint;
use crate::config::{self, Config, Purpose};
use crate::files;
use crate::interrupt::Interrupt;
use crate::manifest;
use crate::observer::{
    Curve, MetricsCsv, Observer, Progress, Prometheus, RunStart, SummaryJson, TensorBoard, TimingCsv,
};
use crate::run_dir::{self, RunDir};
use crate::session::Session;
use crate::trainer::Trainer;

/// There where an NVIDIA driver is loaded.
const NVIDIA_DRIVER: &str = "/proc/driver/nvidia/version";

/// How long the actors of a run that was complete before may take to hear of it: more than their start does.
const LATECOMERS: Duration = Duration::from_secs(10);

/// Trains an agent in a new run directory, or continues one where `--continue` allows it.
///
/// # Errors
/// Bad configuration; a directory that cannot be used; a run that failed.
pub fn train(args: &TrainArgs, extensions: Extensions) -> Outcome {
    let config = configure(args, &extensions).map_err(Failure::Usage)?;
    let interrupt = Interrupt::listen(Some(args.stop.grace()))?.with_sigterm_status(args.stop.sigterm_status);
    if args.with_parent {
        interrupt.with_parent()?;
    }
    let path = args.out.clone().unwrap_or_else(|| RunDir::fresh(&config));
    if RunDir::holds_run(&path) {
        if !args.continue_run {
            let hint = format!("`learner resume {}` continues it, as does `--continue`", path.display());
            return Err(Failure::Usage(anyhow::anyhow!("{} already holds a run; {hint}", path.display())));
        }
        let dir = continue_run(&path, &config, &extensions)?;
        let session = Session::new(&config, &extensions)?;
        return carry_out(&dir, session, &config, extensions, &interrupt);
    }
    // What can fail for want of an address or a program does so before there is a directory.
    let mut session = Session::new(&config, &extensions)?;
    session.listen()?;
    let dir = RunDir::create(&path, &config)?;
    carry_out(&dir, session, &config, extensions, &interrupt)
}

/// Continues the run of a directory from its last checkpoint, or from the beginning if it has none.
///
/// # Errors
/// A directory without a run, bad flags, or a run that failed.
pub fn resume(args: &ResumeArgs, extensions: Extensions) -> Outcome {
    let config_path = RunDir::config_path(&args.dir);
    let dir = if config_path.exists() {
        RunDir::open(&args.dir)?
    } else {
        return Err(Failure::Usage(anyhow::anyhow!("{} holds no run (no config.toml)", args.dir.display())));
    };
    let load = |flags: &toml::Table| Config::load(&config_path, flags, &extensions.envs, &extensions.memories);
    let flags = args.table().map_err(Failure::Usage)?;
    let mut config = load(&flags).map_err(Failure::Usage)?;
    resolve_device(&mut config).map_err(Failure::Usage)?;
    let session = Session::new(&config, &extensions)?;
    let interrupt = Interrupt::listen(Some(args.stop.grace()))?.with_sigterm_status(args.stop.sigterm_status);
    carry_out(&dir, session, &config, extensions, &interrupt)
}

fn configure(args: &TrainArgs, extensions: &Extensions) -> anyhow::Result<Config> {
    let file = args.config.as_deref().map_or_else(|| Ok(toml::Table::new()), config::read_table)?;
    let flags = args.table()?;
    let resolve = |flags: &toml::Table| Config::resolve(&file, flags, &extensions.envs, &extensions.memories);
    let mut config = resolve(&flags).map_err(|error| match &args.config {
        // The file is to blame only for what is wrong without the flags too.
        Some(path) if resolve(&toml::Table::new()).is_err() => error.context(path.display().to_string()),
        _ => error,
    })?;
    resolve_device(&mut config)?;
    Ok(config)
}

/// Replaces `auto` by the device it means here.
fn resolve_device(config: &mut Config) -> anyhow::Result<()> {
    let device = popgym_models::device::parse(&config.device)?;
    if config.device == "auto" && device == Device::Cpu && Path::new(NVIDIA_DRIVER).exists() {
        // Asked for, it says why it cannot be had.
        if let Err(reason) = popgym_models::device::parse("cuda") {
            tracing::warn!("training on the CPU, though there is an NVIDIA driver: {reason}");
        }
    }
    if device == Device::Cpu { "cpu" } else { "cuda" }.clone_into(&mut config.device);
    Ok(())
}

/// Opens a directory that holds a run, if it is the same run as `config`'s.
fn continue_run(path: &Path, config: &Config, extensions: &Extensions) -> Result<RunDir, Failure> {
    let dir = RunDir::open(path)?;
    let none = toml::Table::new();
    let theirs = Config::load(&RunDir::config_path(path), &none, &extensions.envs, &extensions.memories)
        .map_err(Failure::Usage)?;
    match config.difference(&theirs) {
        None => Ok(dir),
        Some(difference) => {
            let problem = anyhow::anyhow!("{} holds another run: {difference}", path.display());
            Err(Failure::Usage(problem))
        }
    }
}

/// Runs what `config` says in `dir`, from the directory's last checkpoint if it has one.
fn carry_out(
    dir: &RunDir,
    mut session: Session<'_>,
    config: &Config,
    extensions: Extensions,
    interrupt: &Interrupt,
) -> Outcome {
    if run_dir::finished(dir.path(), config).is_some() {
        say(&format!("already complete: {}", dir.path().join(SummaryJson::FILE).display()))?;
        if config.service.actors == 0
            && let Err(error) = tell_latecomers(dir, session, interrupt)
        {
            tracing::warn!("actors that come now are not told: {error:#}");
        }
        return Ok(0);
    }
    // Before the observers hear of the run: metrics are known from then on.
    session.listen()?;
    let rows = MetricsCsv::read(dir.path()).map_or(0, |rows| rows.len() as u64);
    let checkpoint = Checkpoint::latest(&dir.checkpoints(), session.parameters(), rows)?;
    // What was asked for now is what the directory says from now on.
    files::write(&RunDir::config_path(dir.path()), &config.to_toml()?)?;
    let (policy, behaviour) = (session.first_policy()?, session.policy()?);
    let mut users = extensions.observers;
    users.push(Box::new(session.board()));
    let observers = observers(dir, config, checkpoint.as_ref(), users)?;
    session.serve(dir.run(), Purpose::Training, Some(&dir.path().join("events.jsonl")))?;
    let trainer = Trainer {
        config,
        action: session.env().action.clone(),
        about: manifest::describe(config, session.env(), &policy),
        policy,
        behaviour,
        service: session.service()?,
        observers,
        checkpoints: dir.checkpoints(),
        interrupt,
        hopeless: session.hopeless(),
    };
    let summary = trainer.run(checkpoint)?;
    if !summary.is_complete() {
        session.end(None);
        return Ok(interrupt.exit_status());
    }
    session.end(Some("the run is complete"));
    // Else Prometheus would know a run that went away before its end.
    monitor::wait_for_scrape(|| interrupt.requested());
    Ok(0)
}

/// Tells remote actors that were started for a complete run that there is nothing to do. They would wait for a learner.
fn tell_latecomers(dir: &RunDir, mut session: Session<'_>, interrupt: &Interrupt) -> anyhow::Result<()> {
    session.serve(dir.run(), Purpose::Training, None)?;
    let until = Instant::now() + LATECOMERS;
    while Instant::now() < until && !interrupt.requested() {
        std::thread::sleep(Duration::from_millis(100));
    }
    session.end(Some("the run is complete"));
    Ok(())
}

fn observers(
    dir: &RunDir,
    config: &Config,
    checkpoint: Option<&Checkpoint>,
    users: Vec<Box<dyn Observer>>,
) -> anyhow::Result<Vec<Box<dyn Observer>>> {
    let progress = checkpoint.map(|checkpoint| &checkpoint.progress);
    let epochs = progress.map_or(0, |progress| progress.epoch);
    let mut observers: Vec<Box<dyn Observer>> = vec![
        Box::new(MetricsCsv::open(dir.path(), epochs)?),
        Box::new(TimingCsv::open(dir.path(), epochs)?),
        Box::new(SummaryJson::new()),
        Box::new(TensorBoard::new()),
        Box::new(Prometheus::new()),
    ];
    observers.extend(users);
    // Last: the closing summary names what the others have left.
    observers.push(Box::new(Curve::new()));
    observers.push(Box::new(Progress::new()));
    let start = RunStart {
        dir: dir.path().to_owned(),
        env: config.env.clone(),
        memory: config.memory_name().to_owned(),
        preset: config.preset.clone(),
        seed: config.seed,
        epoch: epochs,
        env_steps: progress.map_or(0, |progress| progress.env_steps),
        episodes: progress.map_or(0, |progress| progress.episodes),
        total_steps: config.steps,
        mmer: progress.and_then(|progress| progress.mmer),
    };
    for observer in &mut observers {
        observer.run_start(&start)?;
    }
    Ok(observers)
}
