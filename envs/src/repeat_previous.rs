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

use crate::deck::{CARDS, Deck, SUITS, suit};
use crate::draws::Draws;
use crate::env::{Env, EnvSpec, Step, parse_world};
use crate::rng::EpisodeRng;
use crate::space::{Space, Value, ValueMut};

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
    spec: EnvSpec,
    deck: Deck,
    k: usize,
    /// Of a wrong and of a right answer: looked up, because which it is cannot be predicted.
    rewards: [f64; 2],
}

impl RepeatPrevious {
    /// A game of the given size, under the id `id`.
    ///
    /// # Panics
    /// If `decks` is out of the bounds of [`Deck::new`], or `k` is not in `1..52 * decks`.
    pub fn new(id: &str, Params { decks, k }: Params) -> Self {
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
        Self { spec, deck: Deck::new(decks), k, rewards: [-unit, unit] }
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

    fn begin(&mut self, _draws: &mut dyn Draws, observation: ValueMut<'_>) {
        self.deck.restart();
        observation.discrete[0] = suit(self.deck.deal());
    }

    fn step(&mut self, action: Value<'_>, _draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let reward = match self.deck.dealt().checked_sub(self.k) {
            None => 0.0,
            Some(target) => self.rewards[usize::from(action.discrete[0] == suit(self.deck.dealt_at(target)))],
        };
        observation.discrete[0] = suit(self.deck.deal());
        Step { reward, terminated: self.deck.left() == 0, truncated: false }
    }

    fn state(&self, state: ValueMut<'_>) {
        let shown = self.deck.dealt();
        for (i, out) in state.discrete.iter_mut().enumerate() {
            // Place i holds the card shown k - i deals ago, counting the card on show as 1 ago.
            *out = (shown + i).checked_sub(self.k).map_or(0, |index| suit(self.deck.dealt_at(index)));
        }
        self.deck.write_suits_left(state.real);
    }
}
