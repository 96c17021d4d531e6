//! **MultiarmedBandit**: slot machines of unknown odds; find the one that pays best, and stay with it.
//!
//! | | |
//! |---|---|
//! | observation | `Discrete(2)`: 1 if the last arm paid, else 0; 0 at the start |
//! | action | `Discrete(arms)`: the arm to pull |
//! | reward | `1 / steps` if the arm pays, else `-1 / steps` |
//! | end | truncates after exactly `steps` steps; never terminates |
//! | state | `[arms]` probabilities of a payout |
//!
//! The probabilities are drawn uniformly from `[0, 1)` at each reset and stay for the episode. Each step makes one
//! uniform draw `u`, whatever the arm; the arm pays if `u` is less than its probability.
//!
//! Quirk kept: the observation does not tell which arm was pulled; agents get that from the previous action that they
//! are fed with every environment.
//!
//! Source: Morad et al., ICLR 2023, the noisy environments; rules as in the Python package 1.0.7, which agrees with the
//! version behind the paper's numbers.

use rand::Rng;
use serde::{Deserialize, Serialize};

use crate::canvas::{Canvas, Colour, Style, View};
use crate::draws::Draws;
use crate::env::{Env, EnvSpec, Step, parse_world, step_all_classes, world_value};
use crate::pictures::Choices;
use crate::rng::EpisodeRng;
use crate::space::{MAX_CLASSES, Slab, Space, Value, ValueMut};

/// The size of a game.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Params {
    /// Number of arms.
    pub arms: usize,
    /// Length of each episode.
    pub steps: u32,
}

/// Easy, medium, hard.
pub const LEVELS: [Params; 3] =
    [Params { arms: 10, steps: 200 }, Params { arms: 20, steps: 400 }, Params { arms: 30, steps: 600 }];

/// What a reset draws.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct World {
    /// For each arm, how likely it pays.
    pub payout_probability: Vec<f32>,
}

/// The game.
#[derive(Clone, Debug)]
pub struct MultiarmedBandit {
    probabilities: Vec<f32>,
    steps_left: u32,
    last_action: Option<u8>,
    paid: u8,
    /// Of nothing and of a payout: looked up, because which it is cannot be predicted.
    rewards: [f64; 2],
    spec: EnvSpec,
}

impl MultiarmedBandit {
    /// A game of the given size, under the id `id`.
    ///
    /// # Panics
    /// If there is no arm, are more than 256, or no step.
    pub fn new(id: &str, Params { arms, steps }: Params) -> Self {
        assert!((1..=usize::from(MAX_CLASSES)).contains(&arms), "{arms} arms, allowed is 1..={MAX_CLASSES}");
        assert!(steps > 0, "an episode of no step");
        let spec = EnvSpec {
            id: id.to_owned(),
            observation: Space::Discrete(2),
            action: Space::Discrete(arms as u16),
            state: Space::uniform_box(arms, 0.0, 1.0),
            max_steps: steps,
            return_range: (-1.0, 1.0),
        };
        let unit = 1.0 / f64::from(steps);
        Self { probabilities: vec![0.0; arms], steps_left: 0, last_action: None, paid: 0, rewards: [-unit, unit], spec }
    }
}

impl Env for MultiarmedBandit {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn draw_world(&mut self, rng: &mut EpisodeRng) {
        // 24 bits: as many as are exact everywhere below 1.
        self.probabilities.fill_with(|| (rng.next_u32() >> 8) as f32 / (1 << 24) as f32);
    }

    fn set_world(&mut self, world: &serde_json::Value) -> Result<(), String> {
        let World { payout_probability } = parse_world(world)?;
        let arms = self.probabilities.len();
        if payout_probability.len() != arms {
            return Err(format!("{} payout probabilities, expected {arms}", payout_probability.len()));
        }
        for (arm, p) in payout_probability.iter().enumerate() {
            if !(0.0..=1.0).contains(p) {
                return Err(format!("the payout probability of arm {arm} is {p}, allowed is 0..=1"));
            }
        }
        self.probabilities = payout_probability;
        Ok(())
    }

    fn world(&self) -> serde_json::Value {
        world_value(&World { payout_probability: self.probabilities.clone() })
    }

    fn begin(&mut self, _draws: &mut dyn Draws, observation: ValueMut<'_>) {
        (self.steps_left, self.last_action, self.paid) = (self.spec.max_steps, None, 0);
        observation.discrete[0] = 0;
    }

    #[inline]
    fn step(&mut self, action: Value<'_>, draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let arm = action.discrete[0];
        self.last_action = Some(arm);
        self.paid = u8::from(draws.uniform() < f64::from(self.probabilities[usize::from(arm)]));
        observation.discrete[0] = self.paid;
        self.steps_left -= 1;
        Step { reward: self.rewards[usize::from(self.paid)], terminated: false, truncated: self.steps_left == 0 }
    }

    fn step_all(
        envs: &mut [Self],
        rngs: &mut [EpisodeRng],
        actions: &Slab,
        observations: &mut Slab,
        steps: &mut [Step],
    ) {
        step_all_classes::<Self, 1>(envs, rngs, actions, observations, steps);
    }

    fn state(&self, state: ValueMut<'_>) {
        state.real.copy_from_slice(&self.probabilities);
    }

    fn render(&self, view: View, canvas: &mut Canvas) {
        /// Arms below each other.
        const COLUMN: usize = 10;
        /// Places of a bar.
        const BAR: usize = 10;
        let (text, style) = match (self.last_action, self.paid) {
            (None, _) => ("pull an arm".to_owned(), Style::PLAIN),
            (Some(arm), 0) => (format!("arm {arm}: nothing"), Style::PLAIN),
            (Some(arm), _) => (format!("arm {arm}: paid"), Style::ink(Colour::Yellow).bold()),
        };
        canvas.put(0, 0, &text, style);
        let arms = (0..).zip(&self.probabilities);
        let right = arms.max_by(|a, b| a.1.total_cmp(b.1)).map(|(arm, _)| arm);
        let choices = Choices { last: self.last_action, right: right.filter(|_| view == View::Revealed) };
        let width = if view == View::Revealed { 5 + BAR + 8 } else { 8 };
        for (arm, p) in self.probabilities.iter().enumerate() {
            let (row, column) = (2 + arm % COLUMN, width * (arm / COLUMN));
            choices.put(canvas, row, column, arm as u8, &format!("{arm:>3}"), Style::PLAIN);
            if view == View::Revealed {
                let full = (p * BAR as f32).round() as usize;
                canvas.put(row, column + 6, &"█".repeat(full), Style::ink(Colour::Cyan));
                canvas.put(row, column + 6 + full, &"░".repeat(BAR - full), Style::ink(Colour::Grey));
                canvas.put(row, column + 7 + BAR, &format!("{p:.2}"), Style::PLAIN);
            }
        }
        if view == View::Revealed {
            let row = 3 + self.probabilities.len().min(COLUMN);
            canvas.put(row, 0, &format!("steps left: {}", self.steps_left), Style::PLAIN);
        }
    }
}
