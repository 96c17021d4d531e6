//! **HigherLower**: guess whether the next card will be higher or lower than the one on show.
//!
//! | | |
//! |---|---|
//! | observation | `Discrete(13)`: the rank of the card just dealt, ace low |
//! | action | `Discrete(2)`: the next card will be 0 higher, 1 lower |
//! | reward | of `n` cards: `1 / n` if it is, `-1 / n` if it is not, 0 if the ranks are equal |
//! | end | terminates with the last card, after exactly `n - 1` steps; never truncates |
//! | state | the fraction seen of each rank, the card on show included |
//!
//! Quirks kept: `n - 1` guesses are paid by `1 / n`, so the largest return is `(n - 1) / n`; the state does not tell
//! which of the ranks seen is on show.
//!
//! Source: Morad et al., ICLR 2023, the game environments; rules as in the Python package 1.0.7, which agrees with the
//! version behind the paper's numbers.

use serde::{Deserialize, Serialize};

use crate::canvas::{Canvas, Style, View};
use crate::deck::{CARDS, Deck, Field, RANKS, count, counts};
use crate::draws::Draws;
use crate::env::{Env, EnvSpec, Step, parse_world, step_all_classes, world_value};
use crate::pictures::{self, Choices};
use crate::rng::EpisodeRng;
use crate::space::{Slab, Space, Value, ValueMut};

/// The size of a game.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Params {
    /// Decks shuffled together.
    pub decks: usize,
}

/// Easy, medium, hard.
pub const LEVELS: [Params; 3] = [Params { decks: 1 }, Params { decks: 2 }, Params { decks: 3 }];

/// What the actions are called.
pub const ACTION_NAMES: [&str; 2] = ["higher", "lower"];

/// What a reset draws.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct World {
    /// Card indices in shuffled order, `[52 * decks]`; dealt from the end.
    pub deck: Vec<u16>,
}

/// The game.
#[derive(Clone, Debug)]
pub struct HigherLower {
    deck: Deck,
    /// The rank on show.
    rank: u8,
    last_action: Option<u8>,
    /// Of each action if the next card is lower, equal, higher: looked up, because which it is cannot be predicted.
    rewards: [[f64; 2]; 3],
    spec: EnvSpec,
}

impl HigherLower {
    /// A game of the given size, under the id `id`.
    ///
    /// # Panics
    /// If `decks` is out of the bounds of [`Deck::new`].
    pub fn new(id: &str, Params { decks }: Params) -> Self {
        let deck = Deck::of(decks, Field::Rank);
        let n = (decks * CARDS) as f64;
        let most = (n - 1.0) / n;
        let spec = EnvSpec {
            id: id.to_owned(),
            observation: Space::Discrete(RANKS as u16),
            action: Space::Discrete(2),
            state: Space::uniform_box(RANKS, 0.0, 1.0),
            max_steps: (decks * CARDS) as u32 - 1,
            return_range: (-most, most),
        };
        let unit = 1.0 / n;
        let rewards = [[-unit, unit], [0.0, 0.0], [unit, -unit]];
        Self { spec, deck, rank: 0, last_action: None, rewards }
    }

    /// 0 if the rank `next` is lower than that on show, 1 if it is equal, 2 if it is higher.
    #[inline]
    fn compare(&self, next: u8) -> usize {
        usize::from(next >= self.rank) + usize::from(next > self.rank)
    }
}

impl Env for HigherLower {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn draw_world(&mut self, rng: &mut EpisodeRng) {
        self.deck.shuffle(rng);
    }

    fn set_world(&mut self, world: &serde_json::Value) -> Result<(), String> {
        self.deck.set(&parse_world::<World>(world)?.deck)
    }

    fn world(&self) -> serde_json::Value {
        world_value(&World { deck: self.deck.cards().to_vec() })
    }

    fn begin(&mut self, _draws: &mut dyn Draws, observation: ValueMut<'_>) {
        self.deck.restart();
        self.rank = self.deck.deal_class();
        self.last_action = None;
        observation.discrete[0] = self.rank;
    }

    #[inline]
    fn step(&mut self, action: Value<'_>, _draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let action = action.discrete[0];
        self.last_action = Some(action);
        let next = self.deck.deal_class();
        let reward = self.rewards[self.compare(next)][usize::from(action)];
        self.rank = next;
        observation.discrete[0] = next;
        Step { reward, terminated: self.deck.left() == 0, truncated: false }
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
        let each = (self.deck.classes().len() / RANKS) as f32;
        let seen = counts(&self.deck.classes()[self.deck.left()..]);
        for (out, seen) in state.real.iter_mut().zip(seen) {
            *out = f32::from(seen) / each;
        }
    }

    fn render(&self, view: View, canvas: &mut Canvas) {
        let left = &self.deck.classes()[..self.deck.left()];
        let shown = self.deck.class_back(0);
        let next = left.last().copied().filter(|_| shown.is_some() && view == View::Revealed);
        let right = next.and_then(|next| [Some(1), None, Some(0)][self.compare(next)]);
        pictures::card(canvas, 0, 0, Field::Rank, shown);
        canvas.put(3, 0, "the next card is", Style::PLAIN);
        let choices = Choices { last: self.last_action, right };
        for (action, (name, column)) in (0..).zip(ACTION_NAMES.into_iter().zip([17, 26])) {
            choices.put(canvas, 3, column, action, name, Style::PLAIN);
        }
        if view == View::Revealed {
            let answer = match (next, right) {
                (None, _) => "none",
                (Some(_), None) => "any (equal)",
                (Some(_), Some(action)) => ACTION_NAMES[usize::from(action)],
            };
            pictures::line(canvas, 5, "answer now:", answer, Style::PLAIN);
            let row = pictures::counts(canvas, 6, Field::Rank, &[("left", &|rank| count(left, rank))]);
            pictures::to_come(canvas, row, Field::Rank, left);
        }
    }

    fn action_names(&self) -> &'static [&'static str] {
        &ACTION_NAMES
    }
}
