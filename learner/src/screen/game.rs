//! One environment, played episode by episode.

use popgym_envs::{Canvas, Colour, EnvSpec, MakeError, Observability, Purpose, Registry, Slab, Style, Value, VecEnv};
use popgym_envs::{View, stream};

use super::panel::Panel;
use crate::space_text::{number, value_text};

/// How an episode ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum End {
    /// The task itself.
    Terminated,
    /// The time limit.
    Truncated,
}

impl End {
    /// In words.
    pub(crate) fn text(self) -> &'static str {
        match self {
            Self::Terminated => "The episode is over: the task has ended.",
            Self::Truncated => "The episode is over: no time is left.",
        }
    }
}

/// An environment with its present episode and score. The episodes are those that `learner eval` plays with the same
/// seed, never those of training.
pub(crate) struct Game {
    envs: VecEnv,
    observations: Slab,
    seed: u64,
    episode: u64,
    max_steps: u32,
    steps: u32,
    reward: Option<f64>,
    score: f64,
    end: Option<End>,
}

impl Game {
    /// The first episode of the environment that answers to `name`. Episodes that reach `max_steps` are truncated.
    ///
    /// # Errors
    /// If there is no such environment, or it has no hidden state to show.
    pub(crate) fn new(
        registry: &Registry,
        name: &str,
        observability: Observability,
        seed: u64,
        max_steps: u32,
    ) -> Result<Self, MakeError> {
        let envs = VecEnv::observing(registry, name, observability, 1)?;
        let mut game = Self {
            observations: envs.observations(),
            max_steps: max_steps.min(envs.spec().max_steps),
            seed,
            episode: 0,
            steps: 0,
            reward: None,
            score: 0.0,
            end: None,
            envs,
        };
        game.begin(0);
        Ok(game)
    }

    /// Begins episode number `episode`.
    pub(crate) fn begin(&mut self, episode: u64) {
        self.envs.begin(0, stream(self.seed, 0, episode, Purpose::EvalEnv), &mut self.observations);
        (self.episode, self.steps, self.reward, self.score, self.end) = (episode, 0, None, 0.0, None);
    }

    /// Takes a step.
    ///
    /// # Errors
    /// The episode is over, or that is no action.
    pub(crate) fn act(&mut self, action: Value<'_>) -> anyhow::Result<()> {
        let step = self.envs.step(0, action, &mut self.observations)?;
        self.steps += 1;
        self.reward = Some(step.reward);
        self.score += step.reward;
        if step.terminated {
            self.end = Some(End::Terminated);
        } else if step.truncated || self.steps >= self.max_steps {
            self.end = Some(End::Truncated);
        }
        Ok(())
    }

    /// Id, spaces and limits.
    pub(crate) fn spec(&self) -> &EnvSpec {
        self.envs.spec()
    }

    /// What the classes of a `Discrete` action are called.
    pub(crate) fn action_names(&self) -> &'static [&'static str] {
        self.envs.action_names()
    }

    /// What the agent sees.
    pub(crate) fn observation(&self) -> Value<'_> {
        self.observations.row(0)
    }

    /// The present picture; empty if the environment has none.
    pub(crate) fn picture(&self, view: View) -> Canvas {
        let mut canvas = Canvas::new();
        self.envs.render(0, view, &mut canvas);
        canvas
    }

    /// The seed of the episodes.
    pub(crate) fn seed(&self) -> u64 {
        self.seed
    }

    /// The number of the episode.
    pub(crate) fn episode(&self) -> u64 {
        self.episode
    }

    /// Steps taken.
    pub(crate) fn steps(&self) -> u32 {
        self.steps
    }

    /// The sum of the rewards.
    pub(crate) fn score(&self) -> f64 {
        self.score
    }

    /// How the episode ended, if it has.
    pub(crate) fn end(&self) -> Option<End> {
        self.end
    }

    /// The smallest and the largest return there can be.
    pub(crate) fn possible(&self) -> String {
        let (low, high) = self.spec().return_range;
        format!("{} to {}", number(low), number(high))
    }

    /// Writes step, reward, score and observation.
    pub(crate) fn describe(&self, panel: &mut Panel) {
        let ink = match self.reward {
            Some(reward) if reward > 0.0 => Colour::Green,
            Some(reward) if reward < 0.0 => Colour::Red,
            _ => Colour::Default,
        };
        let reward = self.reward.map_or_else(|| "none yet".to_owned(), number);
        panel
            .field("step", &format!("{} of {}", self.steps, self.max_steps))
            .styled_field("reward", &reward, Style::ink(ink))
            .field("score", &number(self.score))
            .field("observation", &value_text(&self.spec().observation, self.observation()));
    }
}
