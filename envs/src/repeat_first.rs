//! **RepeatFirst**: a card is shown, then many more; keep naming the suit of the first.
//!
//! | | |
//! |---|---|
//! | observation | `Discrete(4)`: the suit of the card just dealt |
//! | action | `Discrete(4)`: the suit of the first card |
//! | reward | `1 / (n - 1)` if right, else `-1 / (n - 1)`, of `n` cards; the answer to the first card counts too |
//! | end | terminates with the last card, after exactly `n - 1` steps; never truncates |
//! | state | the first suit; the fraction of each suit not yet dealt |
//!
//! Quirk kept: nothing in the observation marks the first card, although the paper speaks of an indicator; agents get
//! it from the first-step flag that they are fed with every environment.
//!
//! Source: Morad et al., ICLR 2023, the diagnostic environments; rules as in the Python package 1.0.7, which agrees with
//! the version behind the paper's numbers.

use serde::{Deserialize, Serialize};

use crate::canvas::{Canvas, View};
use crate::deck::{CARDS, Deck, Field, SUIT_NAMES, SUITS, count};
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
pub const LEVELS: [Params; 3] = [Params { decks: 1 }, Params { decks: 8 }, Params { decks: 16 }];

/// What a reset draws.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct World {
    /// Card indices in shuffled order, `[52 * decks]`; dealt from the end.
    pub deck: Vec<u16>,
}

/// The game.
#[derive(Clone, Debug)]
pub struct RepeatFirst {
    deck: Deck,
    first: u8,
    last_action: Option<u8>,
    /// Of a wrong and of a right answer: looked up, because which it is cannot be predicted.
    rewards: [f64; 2],
    spec: EnvSpec,
}

impl RepeatFirst {
    /// A game of the given size, under the id `id`.
    ///
    /// # Panics
    /// If `decks` is out of the bounds of [`Deck::new`].
    pub fn new(id: &str, Params { decks }: Params) -> Self {
        let deck = Deck::new(decks);
        let steps = decks * CARDS - 1;
        let spec = EnvSpec {
            id: id.to_owned(),
            observation: Space::Discrete(SUITS as u16),
            action: Space::Discrete(SUITS as u16),
            state: Space::Tuple(vec![Space::Discrete(SUITS as u16), Space::uniform_box(SUITS, 0.0, 1.0)]),
            max_steps: steps as u32,
            return_range: (-1.0, 1.0),
        };
        let unit = 1.0 / steps as f64;
        Self { spec, deck, first: 0, last_action: None, rewards: [-unit, unit] }
    }
}

impl Env for RepeatFirst {
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
        self.first = self.deck.deal_class();
        self.last_action = None;
        observation.discrete[0] = self.first;
    }

    #[inline]
    fn step(&mut self, action: Value<'_>, _draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let action = action.discrete[0];
        self.last_action = Some(action);
        observation.discrete[0] = self.deck.deal_class();
        let reward = self.rewards[usize::from(action == self.first)];
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
        state.discrete[0] = self.first;
        self.deck.write_fractions_left(state.real);
    }

    fn render(&self, view: View, canvas: &mut Canvas) {
        let shown = self.deck.class_back(0);
        let right = shown.filter(|_| view == View::Revealed && self.deck.left() > 0).map(|_| self.first);
        pictures::card(canvas, 0, 0, Field::Suit, shown);
        Choices { last: self.last_action, right }.suits(canvas, 3, "the first suit?");
        if view == View::Revealed {
            let left = &self.deck.classes()[..self.deck.left()];
            pictures::answer(canvas, 5, Field::Suit, right, "none");
            let row = pictures::counts(canvas, 6, Field::Suit, &[("left", &|suit| count(left, suit))]);
            pictures::to_come(canvas, row, Field::Suit, left);
        }
    }

    fn action_names(&self) -> &'static [&'static str] {
        &SUIT_NAMES
    }
}
