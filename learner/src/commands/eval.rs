//! `learner eval`: episodes played with a trained agent, on streams of their own.

use anyhow::Context as _;
use bytes::Bytes;
use popgym_proto::Episode;
use serde::Serialize;

use super::{Failure, Outcome, choose_checkpoint, say};
use crate::Extensions;
use crate::args::EvalArgs;
use crate::config::Config;
use crate::gae::mean_and_variance;
use crate::interrupt::{EXIT_INTERRUPTED, Interrupt};
use crate::run_dir::RunDir;
use crate::service::Target;
use crate::session::Session;

/// What an evaluation found.
#[derive(Debug, Serialize)]
struct Report {
    env: String,
    memory: String,
    checkpoint_epoch: u64,
    seed: u64,
    episodes: usize,
    mean_return: f64,
    standard_error: f64,
    min_return: f64,
    median_return: f64,
    max_return: f64,
    mean_length: f64,
}

/// Plays `--episodes` episodes with the weights of a checkpoint and prints what they returned.
///
/// # Errors
/// A directory without a run or without a checkpoint; actors that cannot be started.
pub fn eval(args: &EvalArgs, extensions: &Extensions) -> Outcome {
    let config = configure(args, extensions).map_err(Failure::Usage)?;
    let interrupt = Interrupt::listen()?;
    let mut session = Session::new(&config, extensions)?;
    let checkpoint = choose_checkpoint(&args.dir, args.checkpoint, session.parameters())?
        .with_context(|| format!("{} holds no checkpoint yet", args.dir.display()))?;
    session.policy()?.load(&checkpoint.weights).map_err(anyhow::Error::from)?;
    session.serve(&format!("evaluation-{}", std::process::id()), true)?;
    let service = session.service()?;
    let epoch = checkpoint.progress.epoch;
    service.open(0, epoch, Bytes::clone(&checkpoint.weights), Target::Episodes(args.episodes))?;
    let hopeless = session.hopeless();
    let collected = service.collect(|| interrupt.requested() || hopeless.is_set());
    session.end(Some("the evaluation is complete"));
    let Some(collected) = collected else {
        if interrupt.requested() {
            return Ok(EXIT_INTERRUPTED);
        }
        return Err(Failure::Run(anyhow::anyhow!("the actors could not do their work")));
    };
    let report = report(&config, epoch, &collected.episodes);
    let text =
        if args.json { serde_json::to_string_pretty(&report).map_err(anyhow::Error::from)? } else { lines(&report) };
    say(&text)?;
    Ok(0)
}

fn configure(args: &EvalArgs, extensions: &Extensions) -> anyhow::Result<Config> {
    anyhow::ensure!(RunDir::holds_run(&args.dir), "{} holds no run (no config.toml)", args.dir.display());
    anyhow::ensure!(args.episodes > 0, "--episodes is 0, allowed is 1 or more");
    anyhow::ensure!(args.actors > 0, "--actors is 0, allowed is 1 or more");
    let path = RunDir::config_path(&args.dir);
    let mut config = Config::load(&path, &toml::Table::new(), &extensions.envs, &extensions.memories)?;
    config.seed = args.seed;
    "cpu".clone_into(&mut config.device);
    config.service.actors = args.actors;
    "127.0.0.1:0".clone_into(&mut config.service.listen);
    config.service.metrics_listen.clear();
    config.validate()?;
    Ok(config)
}

fn report(config: &Config, checkpoint_epoch: u64, episodes: &[Episode]) -> Report {
    let mut returns: Vec<f64> = episodes.iter().map(Episode::total_return).collect();
    returns.sort_by(f64::total_cmp);
    let count = returns.len();
    let (mean_return, variance) = mean_and_variance(&returns);
    let steps: usize = episodes.iter().map(|episode| episode.steps).sum();
    Report {
        env: config.env.clone(),
        memory: config.memory_name().to_owned(),
        checkpoint_epoch,
        seed: config.seed,
        episodes: count,
        mean_return,
        // Of the mean, from the sample variance; a single episode tells nothing of it.
        standard_error: if count > 1 { (variance / (count - 1) as f64).sqrt() } else { f64::NAN },
        min_return: returns[0],
        median_return: f64::midpoint(returns[(count - 1) / 2], returns[count / 2]),
        max_return: returns[count - 1],
        mean_length: steps as f64 / count as f64,
    }
}

fn lines(report: &Report) -> String {
    [
        format!("{} on {}, weights of epoch {}", report.memory, report.env, report.checkpoint_epoch),
        format!("episodes           {} (seed {})", report.episodes, report.seed),
        format!("mean return        {:.4} +- {:.4} (standard error)", report.mean_return, report.standard_error),
        format!("min, median, max   {:.4}  {:.4}  {:.4}", report.min_return, report.median_return, report.max_return),
        format!("mean length        {:.1} steps", report.mean_length),
    ]
    .join("\n")
}
