//! **Autoencode**: watch a deck of cards, then name their suits in reverse order.
//!
//! | | |
//! |---|---|
//! | observation | `(Discrete(2), Discrete(4))`: the mode, 1 to watch and 0 to play; the suit of the card just dealt |
//! | action | `Discrete(4)`: when playing, the suit of the latest card not yet named; when watching, without effect |
//! | reward | 0 when watching; then `1 / n` if right, else `-1 / n`, of `n` cards |
//! | end | terminates when all cards were named, after exactly `2n - 1` steps; never truncates |
//! | state | `[n]` suits in shuffled order (the first card dealt is the last); the mode; the cards to name, as a part of `n` |
//!
//! Quirks kept: the order is reversed, the last card first, although the paper says "in order". The last card is shown
//! with the mode 0 already, and the answer to it counts. From then on the observation is always `(0, 0)`, whose 0 is no
//! card's suit.
//!
//! Source: Morad et al., ICLR 2023, the diagnostic environments; rules as in the Python package 1.0.7, which agrees with
//! the version behind the paper's numbers.

use serde::{Deserialize, Serialize};

use crate::canvas::{Canvas, Style, View};
use crate::deck::{CARDS, Deck, Field, SUIT_NAMES, SUITS};
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

/// What a reset draws.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct World {
    /// Card indices in shuffled order, `[52 * decks]`; dealt from the end.
    pub deck: Vec<u16>,
}

/// The game.
#[derive(Clone, Debug)]
pub struct Autoencode {
    deck: Deck,
    /// Cards named.
    named: usize,
    last_action: Option<u8>,
    /// Of a wrong and of a right answer: looked up, because which it is cannot be predicted.
    rewards: [f64; 2],
    spec: EnvSpec,
}

impl Autoencode {
    /// A game of the given size, under the id `id`.
    ///
    /// # Panics
    /// If `decks` is out of the bounds of [`Deck::new`].
    pub fn new(id: &str, Params { decks }: Params) -> Self {
        let deck = Deck::new(decks);
        let n = decks * CARDS;
        let spec = EnvSpec {
            id: id.to_owned(),
            observation: Space::Tuple(vec![Space::Discrete(2), Space::Discrete(SUITS as u16)]),
            action: Space::Discrete(SUITS as u16),
            state: Space::Tuple(vec![
                Space::MultiDiscrete(vec![SUITS as u16; n]),
                Space::Discrete(2),
                Space::uniform_box(1, 0.0, 1.0),
            ]),
            max_steps: 2 * n as u32 - 1,
            return_range: (-1.0, 1.0),
        };
        let unit = 1.0 / n as f64;
        Self { spec, deck, named: 0, last_action: None, rewards: [-unit, unit] }
    }

    /// 1 while cards are to be watched.
    #[inline]
    fn mode(&self) -> u8 {
        u8::from(self.deck.left() > 0)
    }
}

impl Env for Autoencode {
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
        (self.named, self.last_action) = (0, None);
        observation.discrete.copy_from_slice(&[1, self.deck.deal_class()]);
    }

    #[expect(clippy::inline_always, reason = "too long to be inlined otherwise, and as a call it takes much longer")]
    #[inline(always)]
    fn step(&mut self, action: Value<'_>, _draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let action = action.discrete[0];
        self.last_action = Some(action);
        if self.mode() == 1 {
            let suit = self.deck.deal_class();
            observation.discrete.copy_from_slice(&[self.mode(), suit]);
            return Step::default();
        }
        // The last card dealt is at the front of the deck.
        let suits = self.deck.classes();
        let reward = self.rewards[usize::from(action == suits[self.named])];
        self.named += 1;
        observation.discrete.copy_from_slice(&[0, 0]);
        Step { reward, terminated: self.named == suits.len(), truncated: false }
    }

    fn step_all(
        envs: &mut [Self],
        rngs: &mut [EpisodeRng],
        actions: &Slab,
        observations: &mut Slab,
        steps: &mut [Step],
    ) {
        step_all_classes::<Self, 2>(envs, rngs, actions, observations, steps);
    }

    fn state(&self, state: ValueMut<'_>) {
        let n = self.deck.classes().len();
        state.discrete[..n].copy_from_slice(self.deck.classes());
        state.discrete[n] = self.mode();
        state.real[0] = self.deck.dealt().saturating_sub(self.named) as f32 / n as f32;
    }

    fn render(&self, view: View, canvas: &mut Canvas) {
        let (dealt, mode, suits) = (self.deck.dealt(), self.mode(), self.deck.classes());
        // In the observation, a suit of 0 stands for no card too.
        let shown = if self.named > 0 { Some(0) } else { self.deck.class_back(0) };
        pictures::card(canvas, 0, 0, Field::Suit, shown);
        let mode_text =
            if mode == 1 { "watch" } else { "play: the last card first; after that answer, ♠ is no card" };
        canvas.put(1, 7, mode_text, Style::PLAIN);
        let right = suits.get(self.named).copied().filter(|_| view == View::Revealed && mode == 0);
        Choices { last: self.last_action, right }.suits(canvas, 3, "the suit of the latest card not yet named?");
        if view == View::Revealed {
            pictures::answer(canvas, 5, Field::Suit, right, if mode == 1 { "any" } else { "none" });
            let to_name = suits[self.deck.left()..].iter().skip(self.named);
            let row = pictures::cards(canvas, 6, "to name:", Field::Suit, 6, to_name.map(|&suit| Some(suit)));
            pictures::line(canvas, row, "named:", &format!("{} of {dealt}", self.named), Style::PLAIN);
            pictures::to_come(canvas, row + 1, Field::Suit, &suits[..self.deck.left()]);
        }
    }

    fn action_names(&self) -> &'static [&'static str] {
        &SUIT_NAMES
    }
}
