//! `learner train` and `learner resume`.

use std::path::{Path, PathBuf};

use anyhow::Context;
use popgym_envs::{Purpose, stream};
use rand::Rng as _;
use tch::Device;

use super::{Failure, Outcome};
use crate::Extensions;
use crate::args::{ResumeArgs, TrainArgs};
use crate::checkpoint::Checkpoint;
use crate::config::{self, Config};
use crate::interrupt::{EXIT_INTERRUPTED, Interrupt};
use crate::observer::{Curve, MetricsCsv, Observer, Progress, Prometheus, RunStart, TensorBoard, TimingCsv};
use crate::run_dir::{self, RunDir};
use crate::session::Session;
use crate::trainer::Trainer;

/// Trains an agent in a new run directory, or continues one where `--continue` allows it.
///
/// # Errors
/// Bad configuration; a directory that cannot be used; a run that failed.
pub fn train(args: &TrainArgs, extensions: Extensions) -> Outcome {
    let config = configure(args, &extensions).map_err(Failure::Usage)?;
    let path = args.out.clone().unwrap_or_else(|| RunDir::fresh(&config));
    let dir = if args.continue_run && RunDir::holds_run(&path) {
        continue_run(&path, &config, &extensions)?
    } else {
        create(&path, &config)?
    };
    carry_out(&dir, &config, extensions)
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
    // What was asked for now is what the directory says from now on.
    run_dir::write(&config_path, &config.to_toml()?)?;
    carry_out(&dir, &config, extensions)
}

fn configure(args: &TrainArgs, extensions: &Extensions) -> anyhow::Result<Config> {
    let file = args.config.as_deref().map_or_else(|| Ok(toml::Table::new()), config::read_table)?;
    let mut config = Config::resolve(&file, &args.table()?, &extensions.envs, &extensions.memories)
        .with_context(|| args.config.as_ref().map_or_else(|| "flags".to_owned(), |path| path.display().to_string()))?;
    resolve_device(&mut config)?;
    Ok(config)
}

/// Replaces `auto` by the device it means here.
fn resolve_device(config: &mut Config) -> anyhow::Result<()> {
    let device = popgym_models::device::parse(&config.device)?;
    if device == Device::Cpu { "cpu" } else { "cuda" }.clone_into(&mut config.device);
    Ok(())
}

fn create(path: &Path, config: &Config) -> Result<RunDir, Failure> {
    if RunDir::holds_run(path) {
        return Err(Failure::Usage(anyhow::anyhow!(
            "{0} already holds a run; `learner resume {0}` continues it, as does `--continue`",
            path.display()
        )));
    }
    RunDir::create(path, config).map_err(Failure::Run)
}

/// Opens a directory that holds a run, if it is the same run as `config`'s.
fn continue_run(path: &Path, config: &Config, extensions: &Extensions) -> Result<RunDir, Failure> {
    let dir = RunDir::open(path)?;
    let none = toml::Table::new();
    let theirs = Config::load(&RunDir::config_path(path), &none, &extensions.envs, &extensions.memories)?;
    match config.difference(&theirs) {
        None => Ok(dir),
        Some(difference) => {
            let problem = anyhow::anyhow!("{} holds another run: {difference}", path.display());
            Err(Failure::Usage(problem))
        }
    }
}

/// Runs what `config` says in `dir`, from the directory's last checkpoint if it has one.
fn carry_out(dir: &RunDir, config: &Config, extensions: Extensions) -> Outcome {
    let interrupt = Interrupt::listen()?;
    let mut session = Session::new(config, &extensions)?;
    let checkpoint = Checkpoint::latest(&dir.checkpoints(), session.parameters())?;
    if let Some(path) = complete(dir, config, checkpoint.as_ref()) {
        println!("already complete: {}", path.display());
        return Ok(0);
    }
    // The same first weights on every machine: libtorch's own generator is seeded from the run's stream of weights.
    let seed = stream(config.seed, 0, 0, Purpose::Weights).next_u64();
    tch::manual_seed((seed >> 1) as i64);
    let policy = session.policy()?;
    let behaviour = session.policy()?;
    let observers = observers(dir, config, checkpoint.as_ref(), extensions.observers)?;
    session.serve(dir.run(), false)?;
    let trainer = Trainer {
        config,
        action: session.env().action.clone(),
        policy,
        behaviour,
        service: session.service()?,
        observers,
        checkpoints: dir.checkpoints(),
        interrupt: &interrupt,
    };
    let summary = trainer.run(checkpoint)?;
    let interrupted = summary.stopped_by == "interrupt";
    session.end(if interrupted { None } else { Some("the run is complete") });
    run_dir::write(&dir.path().join("summary.json"), &serde_json::to_string_pretty(&summary).unwrap_or_default())?;
    Ok(if interrupted { EXIT_INTERRUPTED } else { 0 })
}

/// The summary of a run that has nothing left to do.
fn complete(dir: &RunDir, config: &Config, checkpoint: Option<&Checkpoint>) -> Option<PathBuf> {
    let progress = &checkpoint?.progress;
    let target = config.stop_at_mmer.unwrap_or(f64::INFINITY);
    let done = progress.env_steps >= config.steps || progress.mmer.is_some_and(|mmer| mmer >= target);
    done.then(|| dir.path().join("summary.json")).filter(|path| path.exists())
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
        total_steps: config.steps,
        mmer: progress.and_then(|progress| progress.mmer),
    };
    for observer in &mut observers {
        observer.run_start(&start)?;
    }
    Ok(observers)
}
