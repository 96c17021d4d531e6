//! A person who plays.

use std::time::Duration;

use popgym_envs::{Colour, MakeError, Observability, Registry, Style, View};

use super::app::{App, Shown};
use super::controls::{Controls, Pressed};
use super::game::Game;
use super::key::Key;
use super::layout::titled;
use super::panel::Panel;
use crate::baseline::Baseline;
use crate::space_text::{number, space_text};

/// How long a person waits for what a random agent scores.
const BASELINE_BUDGET: Duration = Duration::from_millis(300);

/// What to play.
#[derive(Clone, Debug)]
pub(crate) struct PlayOptions {
    /// A name of the environment.
    pub env: String,
    /// Seed of the episodes.
    pub seed: u64,
    /// How many episodes.
    pub episodes: u64,
    /// Whether the hidden state is shown too.
    pub reveal: bool,
}

/// A person's game.
pub(crate) struct Player<'a> {
    registry: &'a Registry,
    options: PlayOptions,
    game: Game,
    controls: Controls,
    last_action: Option<String>,
    /// What was wrong with the last key.
    problem: Option<String>,
    /// What acting at random scores; known from the end of an episode on.
    baseline: Option<Baseline>,
    /// The scores of the episodes before the present one.
    scores: Vec<f64>,
    is_left: bool,
}

impl<'a> Player<'a> {
    /// The first episode.
    ///
    /// # Errors
    /// There is no such environment.
    pub(crate) fn new(registry: &'a Registry, options: PlayOptions) -> Result<Self, MakeError> {
        let game = Game::new(registry, &options.env, Observability::Partial, options.seed, u32::MAX)?;
        let controls = Controls::new(&game.spec().action, game.action_names());
        Ok(Self {
            registry,
            options,
            controls,
            game,
            last_action: None,
            problem: None,
            baseline: None,
            scores: Vec::new(),
            is_left: false,
        })
    }

    /// What is left to say when the terminal is the person's own again.
    pub(crate) fn summary(&self) -> String {
        let spec = self.game.spec();
        let mut lines = vec![format!("{}, seed {}", spec.id, self.options.seed)];
        lines.extend(
            self.scores.iter().enumerate().map(|(i, &score)| format!("episode {}   score {}", i + 1, number(score))),
        );
        let so_far = if self.game.end().is_some() { "" } else { " so far" };
        let (episode, score, steps) = (self.game.episode() + 1, number(self.game.score()), self.game.steps());
        lines.push(format!("episode {episode}   score{so_far} {score}, step {steps} of {}", spec.max_steps));
        lines.push(format!("possible    {}", self.game.possible()));
        lines.extend(self.baseline.map(|baseline| format!("at random   {baseline}")));
        lines.push(format!("once more   learner play --env {} --seed {}", spec.id, self.options.seed));
        lines.join("\n")
    }

    fn act(&mut self, key: Key) -> anyhow::Result<()> {
        self.problem = None;
        match self.controls.press(key) {
            Pressed::Nothing => {}
            Pressed::Refused(problem) => self.problem = Some(problem),
            Pressed::Action(action) => {
                self.last_action = Some(self.controls.describe(action.value()));
                self.game.act(action.value())?;
                if self.game.end().is_some() && self.baseline.is_none() {
                    self.baseline = Some(Baseline::measure(self.registry, &self.options.env, BASELINE_BUDGET)?);
                }
            }
        }
        Ok(())
    }

    fn next_episode(&mut self) {
        if self.is_last() {
            self.is_left = true;
            return;
        }
        self.scores.push(self.game.score());
        self.last_action = None;
        self.game.begin(self.game.episode() + 1);
    }

    fn is_last(&self) -> bool {
        self.game.episode() + 1 >= self.options.episodes
    }

    fn panel(&self) -> Panel {
        let mut panel = Panel::new();
        let spec = self.game.spec();
        let PlayOptions { seed, episodes, .. } = self.options;
        panel.title(&spec.id);
        panel.aside(&format!("sees {}", space_text(&spec.observation)));
        panel.aside(&format!("acts {}", space_text(&spec.action)));
        panel.aside(&format!("seed {seed}, episode {} of {episodes}", self.game.episode() + 1)).blank();
        self.game.describe(&mut panel);
        if let Some(action) = &self.last_action {
            panel.field("last action", action);
        }
        if self.game.end().is_some() {
            self.describe_end(&mut panel);
        } else {
            self.describe_keys(&mut panel);
        }
        panel.field("q", "quit");
        panel
    }

    fn describe_end(&self, panel: &mut Panel) {
        panel.blank();
        if let Some(end) = self.game.end() {
            panel.text(end.text(), Style::PLAIN.bold());
        }
        panel.field("possible", &self.game.possible());
        if let Some(baseline) = self.baseline {
            panel.field("at random", &format!("{baseline} ({} episodes)", baseline.episodes));
        }
        panel.blank().field("Enter", if self.is_last() { "done" } else { "next episode" });
    }

    fn describe_keys(&self, panel: &mut Panel) {
        if let Some(name) = self.controls.pointed_name() {
            panel.field("pointing at", &name);
        }
        if !self.controls.typed().is_empty() {
            panel.field("typed", &format!("{}_", self.controls.typed()));
        }
        if let Some(problem) = &self.problem {
            panel.text(problem, Style::ink(Colour::Red));
        }
        panel.blank().keys(&self.controls.help());
    }
}

impl App for Player<'_> {
    fn shown(&mut self) -> Shown {
        let mut observed = self.game.picture(View::Observed);
        self.controls.see(&observed);
        if self.game.end().is_none() {
            self.controls.mark(&mut observed);
        }
        let pictures = if self.options.reveal {
            vec![titled("observed", &observed), titled("revealed", &self.game.picture(View::Revealed))]
        } else {
            vec![observed]
        };
        Shown { pictures, panel: self.panel() }
    }

    fn press(&mut self, key: Key) -> anyhow::Result<()> {
        if self.game.end().is_none() {
            return self.act(key);
        }
        if key == Key::Enter {
            self.next_episode();
        }
        Ok(())
    }

    fn is_left(&self) -> bool {
        self.is_left
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::screen::app::frame;
    use crate::screen::layout::Size;

    fn player<'a>(registry: &'a Registry, env: &str, episodes: u64) -> Player<'a> {
        let options = PlayOptions { env: env.to_owned(), seed: 7, episodes, reveal: false };
        Player::new(registry, options).unwrap()
    }

    fn text(player: &mut Player<'_>) -> String {
        player.shown().panel.canvas().to_text()
    }

    /// The value of a name on the panel.
    fn field(player: &mut Player<'_>, name: &str) -> String {
        let text = text(player);
        let line = text.lines().find_map(|line| line.strip_prefix(name));
        line.unwrap_or_else(|| panic!("no `{name}` in\n{text}")).trim().to_owned()
    }

    #[test]
    fn whoever_remembers_scores_1() {
        let registry = Registry::standard();
        let mut player = player(&registry, "RepeatPreviousEasy", 1);
        let mut seen: Vec<char> = Vec::new();
        for step in 0..51 {
            seen.push(field(&mut player, "observation").chars().next().unwrap());
            assert_eq!(field(&mut player, "step"), format!("{step} of 51"));
            // The first three answers do not count.
            let answer = seen[seen.len().saturating_sub(4)];
            player.press(Key::Char(answer)).unwrap();
        }
        assert_eq!(field(&mut player, "score"), "1.0000");
        assert_eq!(field(&mut player, "possible"), "-1.0000 to 1.0000");
        assert!(field(&mut player, "at random").starts_with("-0."));
        assert!(player.summary().contains("score 1.0000, step 51 of 51"), "{}", player.summary());
        player.press(Key::Char('0')).unwrap();
        assert!(!player.is_left(), "only Enter goes on");
        player.press(Key::Enter).unwrap();
        assert!(player.is_left());
    }

    #[test]
    fn every_environment_can_be_played() {
        let registry = Registry::standard();
        let plain = Size { columns: 80, rows: 24 };
        for (entry, (reveal, room)) in registry
            .iter()
            .flat_map(|entry| [(false, plain), (true, Size { columns: 140, rows: 45 })].map(|options| (entry, options)))
        {
            let mut player = player(&registry, entry.id(), 1);
            player.options.reveal = reveal;
            let mut layouts = Default::default();
            // One of few classes, one of many, or two.
            for symbol in "0\r0 0\r".chars() {
                if player.game.steps() > 0 {
                    break;
                }
                player.press(if symbol == '\r' { Key::Enter } else { Key::Char(symbol) }).unwrap();
                let text = frame(&player.shown(), &mut layouts, room).to_text();
                assert!(text.contains("score"), "{}: {text}", entry.id());
            }
            assert_eq!(player.game.steps(), 1, "{}", entry.id());
        }
    }

    #[test]
    fn episodes_follow_one_another() {
        let registry = Registry::standard();
        let mut player = player(&registry, "RepeatFirstEasy", 2);
        for episode in 1..=2 {
            assert!(text(&mut player).contains(&format!("episode {episode} of 2")));
            (0..51).for_each(|_| player.press(Key::Char('1')).unwrap());
            player.press(Key::Enter).unwrap();
        }
        assert!(player.is_left());
        let summary = player.summary();
        assert!(summary.contains("episode 1   score") && summary.contains("episode 2   score"), "{summary}");
    }

    #[test]
    fn what_is_no_action_is_told_and_costs_nothing() {
        let registry = Registry::standard();
        let mut player = player(&registry, "BattleshipEasy", 1);
        "8 0".chars().for_each(|symbol| player.press(Key::Char(symbol)).unwrap());
        assert_eq!(field(&mut player, "typed"), "8 0_");
        player.press(Key::Enter).unwrap();
        assert!(text(&mut player).contains("`8` is no action: 0 to 7"), "{}", text(&mut player));
        assert_eq!(field(&mut player, "step"), "0 of 64");
        "7 0".chars().for_each(|symbol| player.press(Key::Char(symbol)).unwrap());
        player.press(Key::Enter).unwrap();
        assert_eq!(
            (field(&mut player, "step"), field(&mut player, "last action")),
            ("1 of 64".into(), "(7, 0)".into())
        );
        assert!(player.summary().contains("score so far"), "{}", player.summary());
    }
}
