//! `learner play`: a person plays an environment in the terminal.

use std::time::{SystemTime, UNIX_EPOCH};

use super::{Failure, Outcome, say};
use crate::Extensions;
use crate::args::PlayArgs;
use crate::interrupt::EXIT_INTERRUPTED;
use crate::screen::app::{self, Ending};
use crate::screen::player::{PlayOptions, Player};
use crate::screen::terminal::Terminal;

/// Lets a person play `--episodes` episodes, and prints the scores.
///
/// # Errors
/// An unknown environment; no terminal.
pub fn play(args: &PlayArgs, extensions: &Extensions) -> Outcome {
    let mut player = prepare(args, extensions).map_err(Failure::Usage)?;
    let ending = app::run(&mut player)?;
    say(&player.summary())?;
    Ok(if ending == Ending::Interrupted { EXIT_INTERRUPTED } else { 0 })
}

fn prepare<'a>(args: &PlayArgs, extensions: &'a Extensions) -> anyhow::Result<Player<'a>> {
    anyhow::ensure!(args.episodes > 0, "--episodes is 0, allowed is 1 or more");
    let options = PlayOptions {
        env: args.env.clone(),
        seed: args.seed.unwrap_or_else(seed_of_the_clock),
        episodes: args.episodes,
        reveal: args.reveal,
    };
    let player = Player::new(&extensions.envs, options)?;
    Terminal::check("play")?;
    Ok(player)
}

/// Short enough to be typed again.
fn seed_of_the_clock() -> u64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::from(now.subsec_micros())
}
