//! **RepeatPrevious**: cards are shown one by one; name the suit that was shown some steps ago.
//!
//! | | |
//! |---|---|
//! | observation | `Discrete(4)`: the suit of the card just dealt |
//! | action | `Discrete(4)`: the suit of the `k`-th most recent card, `k = 1` being the card on show |
//! | reward | 0 while fewer than `k` cards were shown; then `1 / (n - k)` if right, else `-1 / (n - k)`, of `n` cards |
//! | end | terminates with the last card, after exactly `n - 1` steps; never truncates |
//! | state | the last `k` suits, oldest first, padded with 0 at the left; the fraction of each suit not yet dealt |
//!
//! Quirks kept: the answer is the observation `k - 1` steps back, so 3, 31 and 63 steps, although the paper writes
//! "the observation `k` steps ago". The very first `k - 1` actions are free.
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
    /// Which of the recent cards to name; 1 is the card on show.
    pub k: usize,
}

/// Easy, medium, hard.
pub const LEVELS: [Params; 3] = [Params { decks: 1, k: 4 }, Params { decks: 2, k: 32 }, Params { decks: 3, k: 64 }];

/// What a reset draws.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct World {
    /// Card indices in shuffled order, `[52 * decks]`; dealt from the end.
    pub deck: Vec<u16>,
}

/// The game.
#[derive(Clone, Debug)]
pub struct RepeatPrevious {
    deck: Deck,
    k: usize,
    last_action: Option<u8>,
    /// Of a wrong and of a right answer: looked up, because which it is cannot be predicted.
    rewards: [f64; 2],
    spec: EnvSpec,
}

impl RepeatPrevious {
    /// A game of the given size, under the id `id`.
    ///
    /// # Panics
    /// If `decks` is out of the bounds of [`Deck::new`], or `k` is not in `1..52 * decks`.
    pub fn new(id: &str, Params { decks, k }: Params) -> Self {
        let deck = Deck::new(decks);
        let n = decks * CARDS;
        assert!((1..n).contains(&k), "k is {k}, allowed is 1..{n}");
        let spec = EnvSpec {
            id: id.to_owned(),
            observation: Space::Discrete(SUITS as u16),
            action: Space::Discrete(SUITS as u16),
            state: Space::Tuple(vec![Space::MultiDiscrete(vec![SUITS as u16; k]), Space::uniform_box(SUITS, 0.0, 1.0)]),
            max_steps: n as u32 - 1,
            return_range: (-1.0, 1.0),
        };
        let unit = 1.0 / (n - k) as f64;
        Self { spec, deck, k, last_action: None, rewards: [-unit, unit] }
    }
}

impl RepeatPrevious {
    /// The suit to name, once `k` cards were shown.
    #[inline]
    fn target(&self) -> Option<u8> {
        self.deck.class_back(self.k - 1)
    }
}

impl Env for RepeatPrevious {
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
        self.last_action = None;
        observation.discrete[0] = self.deck.deal_class();
    }

    #[inline]
    fn step(&mut self, action: Value<'_>, _draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let action = action.discrete[0];
        self.last_action = Some(action);
        let reward = match self.target() {
            None => 0.0,
            Some(suit) => self.rewards[usize::from(action == suit)],
        };
        observation.discrete[0] = self.deck.deal_class();
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
        // Oldest first: the last place holds the card on show.
        for (back, out) in state.discrete.iter_mut().rev().enumerate() {
            *out = self.deck.class_back(back).unwrap_or(0);
        }
        self.deck.write_fractions_left(state.real);
    }

    fn render(&self, view: View, canvas: &mut Canvas) {
        let ended = self.deck.left() == 0;
        let right = self.target().filter(|_| view == View::Revealed && !ended);
        pictures::card(canvas, 0, 0, Field::Suit, self.deck.class_back(0));
        let question = match self.k {
            1 => "the suit on show?".to_owned(),
            2 => "the suit before this one?".to_owned(),
            k => format!("the suit {} cards ago?", k - 1),
        };
        Choices { last: self.last_action, right }.suits(canvas, 3, &question);
        if view == View::Revealed {
            let left = &self.deck.classes()[..self.deck.left()];
            pictures::answer(canvas, 5, Field::Suit, right, if ended { "none" } else { "any" });
            let recent = (0..self.k).rev().map(|back| self.deck.class_back(back));
            let row = pictures::cards(canvas, 6, &format!("last {}:", self.k), Field::Suit, usize::MAX, recent);
            let row = pictures::counts(canvas, row, Field::Suit, &[("left", &|suit| count(left, suit))]);
            pictures::to_come(canvas, row, Field::Suit, left);
        }
    }

    fn action_names(&self) -> &'static [&'static str] {
        &SUIT_NAMES
    }
}
