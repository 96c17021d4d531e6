//! A person who watches a trained agent.

use std::time::{Duration, Instant};

use popgym_envs::{Colour, Purpose, Style, View, stream};

use super::agent::{Agent, Decision};
use super::app::{App, Shown};
use super::game::Game;
use super::joint::Joint;
use super::key::{Direction, Key};
use super::panel::Panel;
use super::places::tint;
use crate::space_text::{number, value_text};

/// Slowest and fastest, in steps a second.
pub(crate) const SPEEDS: (f64, f64) = (0.01, 1000.0);

/// How long the end of an episode is shown.
pub(crate) const END: Duration = Duration::from_secs(2);

/// Bars at most.
const BARS: usize = 8;

/// As many times likelier than at random is clearly likelier.
const CLEARLY: f64 = 1.2;

/// Of the action that was chosen.
const CHOSEN: Style = Style::ink(Colour::Yellow).bold();

/// What to watch.
#[derive(Clone, Debug)]
pub(crate) struct WatchOptions {
    /// How many episodes.
    pub episodes: u64,
    /// Steps a second.
    pub speed: f64,
    /// How much the picture shows.
    pub view: View,
    /// What acts, in words.
    pub about: String,
}

/// An agent's game, watched.
pub(crate) struct Spectator {
    options: WatchOptions,
    game: Game,
    agent: Agent,
    joint: Option<Joint>,
    /// What the agent is about to do; none at the end of an episode.
    decision: Option<Decision>,
    /// The scores of the episodes before the present one.
    scores: Vec<f64>,
    speed: f64,
    paused: bool,
    /// When the present picture was first shown.
    since: Instant,
    is_left: bool,
}

impl Spectator {
    /// `agent` before the first step of the first episode of `game`.
    pub(crate) fn new(game: Game, agent: Agent, options: WatchOptions) -> Self {
        let mut spectator = Self {
            joint: Joint::of(&game.spec().action),
            speed: options.speed,
            decision: None,
            scores: Vec::new(),
            paused: false,
            since: Instant::now(),
            is_left: false,
            options,
            game,
            agent,
        };
        spectator.restart();
        spectator
    }

    /// Goes back to the first episode.
    pub(crate) fn restart(&mut self) {
        self.scores.clear();
        self.begin(0);
    }

    /// One step, or, after the end of an episode, the next one. Says whether there was any.
    ///
    /// # Errors
    /// The policy chose what is no action: its weights or its arithmetic are broken.
    pub(crate) fn advance(&mut self) -> anyhow::Result<bool> {
        if self.is_over() {
            if self.is_last() {
                return Ok(false);
            }
            self.scores.push(self.game.score());
            self.begin(self.game.episode() + 1);
        } else {
            self.game.act(self.agent.action())?;
            self.decide();
        }
        self.since = Instant::now();
        Ok(true)
    }

    /// Whether the present episode has ended.
    pub(crate) fn is_over(&self) -> bool {
        self.game.end().is_some()
    }

    /// What it shows now. `keys`: with the keys of the terminal.
    pub(crate) fn show(&self, keys: bool) -> Shown {
        let mut picture = self.game.picture(self.options.view);
        if let (Some(joint), Some(decision)) = (&self.joint, &self.decision) {
            let probabilities = Joint::probabilities(&decision.marginals);
            let chosen = joint.index(self.agent.action().discrete);
            tint(&mut picture, |action, paper| heat(&probabilities, usize::from(action), chosen, paper));
        }
        let mut panel = Panel::new();
        self.describe(&mut panel);
        if keys {
            self.describe_keys(&mut panel);
        }
        Shown { pictures: vec![picture], panel }
    }

    /// What is left to say at the end.
    pub(crate) fn summary(&self) -> String {
        let mut lines = vec![format!("{}, seed {}", self.options.about, self.game.seed())];
        lines.extend(
            self.scores.iter().enumerate().map(|(i, &score)| format!("episode {}   return {}", i + 1, number(score))),
        );
        let so_far = if self.is_over() { "" } else { " so far" };
        let (episode, score, steps) = (self.game.episode() + 1, number(self.game.score()), self.game.steps());
        lines.push(format!("episode {episode}   return{so_far} {score}, {steps} steps"));
        lines.push(format!("possible    {}", self.game.possible()));
        lines.join("\n")
    }

    fn begin(&mut self, episode: u64) {
        self.game.begin(episode);
        self.agent.begin(stream(self.game.seed(), 0, episode, Purpose::EvalAction));
        self.decide();
    }

    fn decide(&mut self) {
        self.decision = (!self.is_over()).then(|| self.agent.decide(self.game.observation()));
    }

    fn is_last(&self) -> bool {
        self.game.episode() + 1 >= self.options.episodes
    }

    fn describe(&self, panel: &mut Panel) {
        panel.title(&self.game.spec().id);
        panel.aside(&self.options.about);
        let shown = match self.options.view {
            View::Observed => "shown is what the agent sees",
            View::Revealed => "shown is the hidden state, too",
        };
        panel.aside(shown);
        let (seed, episode, episodes) = (self.game.seed(), self.game.episode() + 1, self.options.episodes);
        panel.aside(&format!("seed {seed}, episode {episode} of {episodes}")).blank();
        self.game.describe(panel);
        if let Some(decision) = &self.decision {
            self.describe_decision(decision, panel);
        }
        if let Some(end) = self.game.end() {
            panel.blank().text(end.text(), Style::PLAIN.bold()).field("possible", &self.game.possible());
        }
    }

    fn describe_decision(&self, decision: &Decision, panel: &mut Panel) {
        panel.field("value", &number(decision.value)).field("entropy", &number(decision.marginals.entropy)).blank();
        if let Some(joint) = &self.joint {
            let chosen = joint.index(self.agent.action().discrete);
            panel.styled_field("next action", &joint.name(chosen, self.game.action_names()), CHOSEN);
            self.describe_probabilities(joint, &Joint::probabilities(&decision.marginals), chosen, panel);
            return;
        }
        panel.styled_field("next action", &value_text(&self.game.spec().action, self.agent.action()), CHOSEN);
        for (component, classes) in decision.marginals.classes.iter().enumerate().take(BARS) {
            let likeliest = by_probability(classes)[0];
            panel.bar(&format!("{component}: {likeliest}"), classes[likeliest], Style::PLAIN);
        }
        for (mean, std) in decision.marginals.reals.iter().take(BARS) {
            panel.field("mean +- std", &format!("{} +- {}", number(*mean), number(*std)));
        }
    }

    fn describe_probabilities(&self, joint: &Joint, probabilities: &[f64], chosen: usize, panel: &mut Panel) {
        let mut shown: Vec<usize> = (0..probabilities.len()).collect();
        if shown.len() > BARS {
            shown = by_probability(probabilities);
            shown.truncate(BARS);
        }
        for action in shown {
            let style = if action == chosen { CHOSEN } else { Style::PLAIN };
            panel.bar(&joint.name(action, self.game.action_names()), probabilities[action], style);
        }
        if probabilities.len() > BARS {
            panel.text(&format!("the likeliest {BARS} of {}", probabilities.len()), Style::PLAIN);
        }
    }

    fn describe_keys(&self, panel: &mut Panel) {
        panel.blank();
        if self.is_over() && self.is_last() {
            panel.field("Enter", "done");
        } else {
            let state = if self.paused { "go on" } else { "pause" };
            panel.field("Space", state);
            if self.paused {
                panel.field("→", "one step");
            }
            panel.field("+ -", &format!("faster, slower ({} steps/s)", self.speed));
        }
        panel.field("q", "quit");
    }
}

impl App for Spectator {
    fn shown(&mut self) -> Shown {
        self.show(true)
    }

    fn press(&mut self, key: Key) -> anyhow::Result<()> {
        match key {
            Key::Char(' ') => {
                self.paused = !self.paused;
                self.since = Instant::now();
            }
            Key::Arrow(Direction::Right) if self.paused => {
                self.advance()?;
            }
            Key::Char('+' | '=') => self.speed = (self.speed * 2.0).min(SPEEDS.1),
            Key::Char('-' | '_') => self.speed = (self.speed / 2.0).max(SPEEDS.0),
            Key::Enter => self.is_left = self.is_over() && self.is_last(),
            _ => {}
        }
        Ok(())
    }

    fn due(&self) -> Option<Instant> {
        let step = Duration::from_secs_f64(1.0 / self.speed);
        match (self.paused, self.is_over()) {
            (true, _) => None,
            (_, true) if self.is_last() => None,
            (_, true) => Some(self.since + step.max(END)),
            (_, false) => Some(self.since + step),
        }
    }

    fn pass(&mut self) -> anyhow::Result<()> {
        self.advance().map(|_| ())
    }

    fn is_left(&self) -> bool {
        self.is_left
    }
}

/// Indices, the largest probability first; the first of equals.
fn by_probability(probabilities: &[f64]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..probabilities.len()).collect();
    order.sort_by(|&a, &b| probabilities[b].total_cmp(&probabilities[a]));
    order
}

/// What colours the place of an action, in front of this paper: the chosen one stands out, and those clearly likelier than at
/// random show how they compare with the likeliest. Where the picture has a colour of its own, that stays.
fn heat(probabilities: &[f64], action: usize, chosen: usize, paper: Colour) -> Option<Colour> {
    let probability = *probabilities.get(action)?;
    if action == chosen {
        return Some(Colour::Yellow);
    }
    if paper != Colour::Default || probability * (probabilities.len() as f64) < CLEARLY {
        return None;
    }
    let largest = probabilities.iter().copied().fold(0.0, f64::max);
    Some(match probability / largest {
        share if share > 0.5 => Colour::Red,
        share if share > 0.1 => Colour::Magenta,
        _ => Colour::Blue,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_coloured_by_probability() {
        let probabilities = [0.02, 0.52, 0.3, 0.06, 0.025, 0.025, 0.025, 0.025];
        let colour = |action| heat(&probabilities, action, 0, Colour::Default);
        assert_eq!(colour(0), Some(Colour::Yellow), "what was chosen, however unlikely");
        assert_eq!([colour(1), colour(2), colour(3)], [Some(Colour::Red), Some(Colour::Red), None]);
        assert_eq!(heat(&probabilities, 1, 0, Colour::Green), None, "the picture's own colour");
        assert_eq!(heat(&probabilities, 8, 0, Colour::Default), None, "no action");
        // One in a hundred, each; but for one that has half of all, and two with a twelfth and a thirtieth of that.
        let mut many = vec![0.0045; 100];
        (many[7], many[8], many[9]) = (0.5, 0.06, 0.03);
        let colour = |action| heat(&many, action, 0, Colour::Default);
        assert_eq!([colour(7), colour(8), colour(9)], [Some(Colour::Red), Some(Colour::Magenta), Some(Colour::Blue)]);
        assert!((10..100).all(|action| colour(action).is_none()));
    }

    #[test]
    fn the_likeliest_first() {
        assert_eq!(by_probability(&[0.1, 0.4, 0.1, 0.4]), [1, 3, 0, 2]);
    }
}
