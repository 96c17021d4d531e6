//! `learner eval`: episodes played with a trained agent, on streams of their own.

use std::collections::BTreeMap;

use anyhow::Context as _;
use bytes::Bytes;
use popgym_envs::Registry;
use popgym_proto::Episode;
use serde::Serialize;

use super::{Failure, Outcome, choose_checkpoint, say};
use crate::Extensions;
use crate::args::EvalArgs;
use crate::config::{Config, Purpose, ServiceConfig};
use crate::interrupt::{EXIT_INTERRUPTED, Interrupt};
use crate::run_dir::RunDir;
use crate::service::Target;
use crate::session::Session;
use crate::space_text::space_text;
use crate::statistics;

/// What an evaluation found.
#[derive(Debug, Serialize)]
struct Report {
    env: String,
    trained_on: String,
    memory: String,
    checkpoint_epoch: u64,
    seed: u64,
    greedy: bool,
    episodes: usize,
    mean_return: f64,
    /// None of a single episode.
    standard_error: Option<f64>,
    min_return: f64,
    median_return: f64,
    max_return: f64,
    /// Of the returns, by per cent.
    quantiles: BTreeMap<u32, f64>,
    histogram: Histogram,
    mean_length: f64,
}

/// How many returns are in each of some equal parts of their range.
#[derive(Debug, PartialEq, Serialize)]
struct Histogram {
    /// One more than there are parts. A return at an edge belongs to the part above it, the largest to the last part.
    edges: Vec<f64>,
    counts: Vec<usize>,
}

/// Per cent of the returns that are shown.
const QUANTILES: [u32; 5] = [5, 25, 50, 75, 95];

/// Parts of the histogram.
const BINS: usize = 10;

/// Characters of its longest bar.
const BAR: usize = 40;

/// Plays `--episodes` episodes with the weights of a checkpoint and prints what they returned.
///
/// # Errors
/// A directory without a run or without a checkpoint; actors that cannot be started.
pub fn eval(args: &EvalArgs, extensions: &Extensions) -> Outcome {
    let (config, trained_on) = configure(args, extensions).map_err(Failure::Usage)?;
    let interrupt = Interrupt::listen(None)?;
    let mut session = Session::new(&config, extensions)?;
    let checkpoint = choose_checkpoint(&args.dir, args.checkpoint, session.parameters())?
        .with_context(|| format!("{} holds no checkpoint yet", args.dir.display()))?;
    session.policy()?.load(&checkpoint.weights).map_err(anyhow::Error::from)?;
    let purpose = Purpose::Evaluation { greedy: args.greedy };
    session.serve(&format!("evaluation-{}", std::process::id()), purpose, None)?;
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
    let report = report(&config, trained_on, args.greedy, epoch, &collected.episodes);
    let text =
        if args.json { serde_json::to_string_pretty(&report).map_err(anyhow::Error::from)? } else { lines(&report) };
    say(&text)?;
    Ok(0)
}

/// The configuration of the evaluation, and the id of the environment that the agent was trained on.
fn configure(args: &EvalArgs, extensions: &Extensions) -> anyhow::Result<(Config, String)> {
    anyhow::ensure!(RunDir::holds_run(&args.dir), "{} holds no run (no config.toml)", args.dir.display());
    anyhow::ensure!(args.episodes > 0, "--episodes is 0, allowed is 1 or more");
    anyhow::ensure!(args.actors > 0, "--actors is 0, allowed is 1 or more");
    let path = RunDir::config_path(&args.dir);
    let mut config = Config::load(&path, &toml::Table::new(), &extensions.envs, &extensions.memories)?;
    let trained_on = config.env.clone();
    if let Some(env) = &args.env {
        extensions.envs.canonical(env)?.clone_into(&mut config.env);
        check_spaces(&config, &trained_on, &extensions.envs)?;
    }
    config.seed = args.seed;
    "cpu".clone_into(&mut config.device);
    // Its actors are local, whatever the run's were.
    config.service = ServiceConfig {
        actors: args.actors,
        listen: "127.0.0.1:0".to_owned(),
        slots: config.service.slots,
        actor_command: config.service.actor_command,
        ..ServiceConfig::default()
    };
    config.validate()?;
    Ok((config, trained_on))
}

/// An agent can only play what looks like what it was trained on.
fn check_spaces(config: &Config, trained_on: &str, envs: &Registry) -> anyhow::Result<()> {
    let spec = |id: &str| anyhow::Ok(envs.get(id)?.observed(config.observability)?);
    let (here, there) = (spec(&config.env)?, spec(trained_on)?);
    for (what, here, there) in
        [("observations", &here.observation, &there.observation), ("actions", &here.action, &there.action)]
    {
        let (id, here_text, there_text) = (&config.env, space_text(here), space_text(there));
        anyhow::ensure!(
            here == there,
            "--env is {id}, whose {what} are {here_text}; the agent of {trained_on} knows only {there_text}"
        );
    }
    Ok(())
}

fn report(config: &Config, trained_on: String, greedy: bool, checkpoint_epoch: u64, episodes: &[Episode]) -> Report {
    let returns: Vec<f64> = episodes.iter().map(Episode::total_return).collect();
    let steps: usize = episodes.iter().map(|episode| episode.steps).sum();
    let quantile = |percent: u32| statistics::quantile(&returns, f64::from(percent) / 100.0).unwrap_or(f64::NAN);
    let standard_deviation = statistics::standard_deviation(&returns);
    Report {
        env: config.env.clone(),
        trained_on,
        memory: config.memory_name().to_owned(),
        checkpoint_epoch,
        seed: config.seed,
        greedy,
        episodes: returns.len(),
        mean_return: statistics::mean(&returns).unwrap_or(f64::NAN),
        // Of the mean; a single episode tells nothing of it.
        standard_error: standard_deviation.map(|deviation| deviation / (returns.len() as f64).sqrt()),
        min_return: quantile(0),
        median_return: quantile(50),
        max_return: quantile(100),
        quantiles: QUANTILES.map(|percent| (percent, quantile(percent))).into(),
        histogram: histogram(&returns),
        mean_length: steps as f64 / returns.len() as f64,
    }
}

fn histogram(returns: &[f64]) -> Histogram {
    let least = returns.iter().copied().fold(f64::INFINITY, f64::min);
    let width = returns.iter().copied().fold(f64::NEG_INFINITY, f64::max) - least;
    // All returns may be equal.
    let bins = if width > 0.0 { BINS } else { 1 };
    let mut counts = vec![0; bins];
    for value in returns {
        let bin = if width > 0.0 { ((value - least) / width * bins as f64) as usize } else { 0 };
        counts[bin.min(bins - 1)] += 1;
    }
    Histogram { edges: (0..=bins).map(|edge| least + width * edge as f64 / bins as f64).collect(), counts }
}

fn lines(report: &Report) -> String {
    let other =
        if report.trained_on == report.env { String::new() } else { format!(", trained on {}", report.trained_on) };
    let how = if report.greedy { ", likeliest actions" } else { "" };
    let quantiles: Vec<String> =
        report.quantiles.iter().map(|(percent, value)| format!("{percent}%: {value:.4}")).collect();
    let error = report.standard_error.map_or_else(String::new, |error| format!(" +- {error:.4} (standard error)"));
    let mut lines = vec![
        format!("{} on {}, weights of epoch {}{other}{how}", report.memory, report.env, report.checkpoint_epoch),
        format!("episodes           {} (seed {})", report.episodes, report.seed),
        format!("mean return        {:.4}{error}", report.mean_return),
        format!("min, median, max   {:.4}  {:.4}  {:.4}", report.min_return, report.median_return, report.max_return),
        format!("quantiles          {}", quantiles.join("  ")),
        format!("mean length        {:.1} steps", report.mean_length),
    ];
    let Histogram { edges, counts } = &report.histogram;
    let most = counts.iter().max().copied().unwrap_or(1).max(1);
    for (edge, count) in edges.windows(2).zip(counts) {
        let bar = "#".repeat((count * BAR).div_ceil(most));
        lines.push(format!("{:>8.3} .. {:>6.3}  {count:>6}  {bar}", edge[0], edge[1]).trim_end().to_owned());
    }
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_return_is_in_one_part() {
        // Eleven values a tenth of the range apart: one at each edge; the largest belongs to the last part.
        let returns: Vec<f64> = (0..=10).map(|i| f64::from(i) * 0.5 - 1.0).collect();
        let Histogram { edges, counts } = histogram(&returns);
        assert_eq!(counts, [1, 1, 1, 1, 1, 1, 1, 1, 1, 2]);
        assert_eq!(edges.len(), 11);
        assert!((edges[0] + 1.0).abs() < 1e-12 && (edges[10] - 4.0).abs() < 1e-12 && (edges[1] + 0.5).abs() < 1e-12);
        assert_eq!(histogram(&[0.25; 7]), Histogram { edges: vec![0.25, 0.25], counts: vec![7] });
        assert_eq!(histogram(&[-1.0, 1.0]).counts, [1, 0, 0, 0, 0, 0, 0, 0, 0, 1]);
    }
}
