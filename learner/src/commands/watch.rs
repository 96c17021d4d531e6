//! `learner watch`: a trained agent plays, on the terminal or in an animated GIF.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use std::time::Duration;

use anyhow::{Context as _, ensure};
use indicatif::{ProgressBar, ProgressStyle};
use popgym_envs::{Canvas, View};
use popgym_models::Policy;
use tch::Device;

use super::{Failure, Outcome, choose_checkpoint, say};
use crate::Extensions;
use crate::args::WatchArgs;
use crate::config::Config;
use crate::files;
use crate::interrupt::{EXIT_INTERRUPTED, Interrupt};
use crate::run_dir::RunDir;
use crate::screen::agent::Agent;
use crate::screen::animation::Animation;
use crate::screen::app::{self, Ending};
use crate::screen::game::Game;
use crate::screen::layout::Layout;
use crate::screen::spectator::{END, SPEEDS, Spectator, WatchOptions};
use crate::screen::terminal::Terminal;

/// Shows `--episodes` episodes of a trained agent, or writes them to a GIF, and prints the returns.
///
/// # Errors
/// A directory without a run or without a checkpoint; no terminal; a file that cannot be written.
pub fn watch(args: &WatchArgs, extensions: &Extensions) -> Outcome {
    // Before the first file is touched: an interrupt leaves none behind.
    let interrupt = args.gif.is_some().then(|| Interrupt::listen(None)).transpose()?;
    check(args).map_err(Failure::Usage)?;
    let mut spectator = prepare(args, extensions)?;
    let Some((path, interrupt)) = args.gif.as_ref().zip(interrupt) else {
        let ending = app::run(&mut spectator)?;
        say(&spectator.summary())?;
        return Ok(if ending == Ending::Interrupted { EXIT_INTERRUPTED } else { 0 });
    };
    match files::replace(path, |partial| film(&mut spectator, args.speed, &interrupt, partial)) {
        Err(_) if interrupt.requested() => return Ok(EXIT_INTERRUPTED),
        result => result?,
    }
    say(&spectator.summary())?;
    say(&path.display().to_string())?;
    Ok(0)
}

/// Checks all that can be checked without the run.
fn check(args: &WatchArgs) -> anyhow::Result<()> {
    ensure!(args.episodes > 0, "--episodes is 0, allowed is 1 or more");
    let (slowest, fastest) = SPEEDS;
    ensure!(
        (slowest..=fastest).contains(&args.speed),
        "--speed is {}, allowed is {slowest} to {fastest} steps a second",
        args.speed
    );
    ensure!(RunDir::holds_run(&args.dir), "{} holds no run (no config.toml)", args.dir.display());
    match &args.gif {
        Some(path) => files::check_writable(path),
        None => Terminal::check("watch").context("without --gif"),
    }
}

fn prepare(args: &WatchArgs, extensions: &Extensions) -> Result<Spectator, Failure> {
    let path = RunDir::config_path(&args.dir);
    let config = Config::load(&path, &toml::Table::new(), &extensions.envs, &extensions.memories);
    let config = config.map_err(Failure::Usage)?;
    // As actors do it.
    popgym_models::device::set_threads(1);
    let game = Game::new(&extensions.envs, &config.env, config.observability, args.seed, config.max_episode_steps);
    let game = game.map_err(anyhow::Error::from)?;
    let spec = config.policy_spec(game.spec());
    let mut policy = Policy::new(&spec, &extensions.memories, Device::Cpu).map_err(anyhow::Error::from)?;
    let parameters = policy.parameters().values().map(|tensor| tensor.numel() as i64).sum();
    let checkpoint = choose_checkpoint(&args.dir, args.checkpoint, parameters)?
        .ok_or_else(|| Failure::Usage(anyhow::anyhow!("{} holds no checkpoint yet", args.dir.display())))?;
    policy.load(&checkpoint.weights).map_err(anyhow::Error::from)?;
    let agent = Agent::new(policy, game.spec(), config.rows, args.greedy);
    let options = WatchOptions {
        episodes: args.episodes,
        speed: args.speed,
        view: if args.observed { View::Observed } else { View::Revealed },
        about: about(&config, checkpoint.progress.epoch, args.greedy),
    };
    Ok(Spectator::new(game, agent, options))
}

fn about(config: &Config, epoch: u64, greedy: bool) -> String {
    let greedy = if greedy { ", greedy" } else { "" };
    format!("{}, weights of epoch {epoch}{greedy}", config.memory_name())
}

/// Writes the whole of what a terminal would show to the file `path`.
fn film(spectator: &mut Spectator, speed: f64, interrupt: &Interrupt, path: &Path) -> anyhow::Result<()> {
    let file = BufWriter::new(File::create(path)?);
    let progress = ProgressBar::new_spinner();
    progress.set_style(ProgressStyle::with_template("{spinner:.green} {elapsed} {msg} {human_pos} frames")?);
    // Twice the same: first to learn how large the pictures get.
    let mut layout = Layout::default();
    let frames = each_frame(spectator, interrupt, &progress, "measuring", |blocks, _| {
        layout.side_by_side(blocks);
        Ok(())
    })?;
    progress.set_length(frames);
    progress
        .set_style(ProgressStyle::with_template("{spinner:.green} {elapsed} {msg} {human_pos}/{human_len} frames")?);
    let mut animation = Animation::new(file, layout.size())?;
    each_frame(spectator, interrupt, &progress, "drawing", |blocks, is_over| {
        let step = Duration::from_secs_f64(1.0 / speed);
        animation.add(&layout.side_by_side(blocks), if is_over { step.max(END) } else { step })
    })?;
    progress.finish_and_clear();
    animation.finish()?.into_inner().map_err(|error| anyhow::anyhow!("{error}"))?;
    Ok(())
}

/// Goes through all episodes from the first, and gives each frame's blocks to `take`, with whether it shows the end of an
/// episode. Returns the number of frames.
fn each_frame(
    spectator: &mut Spectator,
    interrupt: &Interrupt,
    progress: &ProgressBar,
    what: &'static str,
    mut take: impl FnMut(&[&Canvas], bool) -> anyhow::Result<()>,
) -> anyhow::Result<u64> {
    progress.reset();
    progress.set_message(what);
    spectator.restart();
    let mut frames = 0;
    loop {
        ensure!(!interrupt.requested(), "interrupted");
        take(&spectator.show(false).blocks(), spectator.is_over())?;
        frames += 1;
        progress.set_position(frames);
        if !spectator.advance()? {
            return Ok(frames);
        }
    }
}
