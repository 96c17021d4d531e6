//! **Concentration**: the memory game; turn cards over two at a time, and pairs that match stay face up.
//!
//! | | |
//! |---|---|
//! | observation | `MultiDiscrete([d + 1; n])`: for each of the `n` cards its class, or `d` if it lies face down |
//! | action | `Discrete(n)`: the card to turn over |
//! | reward | `2 / n` for a pair, `-2 f` for two cards that do not match, where `f = 1 / (2n)`; 0 for the first of two cards |
//! | end | terminates when all cards match; truncates after `2n` steps |
//! | state | `[n]` classes; `[n]` matched (0/1); the cards in play as evaluated in this step, `d` for none |
//!
//! A card's class is its colour or its rank, of `d`; any two cards of a class match. Both flags can be set in the same
//! step. The largest return is 1; turning nothing but wrong cards over returns exactly -1.
//!
//! Quirks kept: to turn over a card that is matched already costs `f` as the first of two, and `2 f` as the second, and
//! no card stays in play, the first one neither. To turn the same card over twice is a pair that does not match. The
//! cards of a failed pair are both seen in the observation of the second, and not afterwards. In the state, the card
//! with the number `d` in play looks as if there were none.
//!
//! Source: Morad et al., ICLR 2023, the game environments; rules as in the Python package 1.0.7, which agrees with the
//! version behind the paper's numbers.

use serde::{Deserialize, Serialize};

use crate::canvas::{Canvas, Colour, Style, View};
use crate::deck::{CARDS, Deck, Field, label};
use crate::draws::Draws;
use crate::env::{Env, EnvSpec, Step, parse_world, world_value};
use crate::rng::EpisodeRng;
use crate::space::{Space, Value, ValueMut};

/// The size of a game.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Params {
    /// Decks shuffled together.
    pub decks: usize,
    /// What must be equal for two cards to match.
    pub field: Field,
}

/// Easy, medium, hard.
pub const LEVELS: [Params; 3] = [
    Params { decks: 1, field: Field::Colour },
    Params { decks: 2, field: Field::Colour },
    Params { decks: 1, field: Field::Rank },
];

/// Most decks: a card, and no card, must fit into one byte.
const MAX_DECKS: usize = 4;

/// What a reset draws.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct World {
    /// Card indices, `[52 * decks]`: place `p` of the table holds card `deck[p]`.
    pub deck: Vec<u16>,
}

/// No card: the place behind the last one.
const fn none(n: usize) -> u8 {
    n as u8
}

/// The game.
#[derive(Clone, Debug)]
pub struct Concentration {
    deck: Deck,
    /// Of each card its class, and another one for no card; as many places as a byte has values, so that no index is
    /// beyond.
    classes: [u8; 256],
    /// The same where cards are matched, and the symbol of a card that lies face down elsewhere.
    table: [u8; 256],
    /// The symbol of a card that lies face down.
    face_down: u8,
    /// The first of two cards, or none.
    first: u8,
    /// The cards turned over as of the last step: the first of two, or none, and the present one, or none.
    turned: [u8; 2],
    matched: u8,
    steps: u16,
    /// By what was turned over: looked up, because which it is cannot be predicted.
    rewards: [f64; 8],
    spec: EnvSpec,
}

/// Place in `rewards` of the second of two cards.
const SECOND: usize = 1;
/// Place in `rewards` of a card that was matched before, added to that of the second.
const MATCHED: usize = 2;
/// Place in `rewards` of a pair, added to that of the second.
const PAIR: usize = 4;

impl Concentration {
    /// A game of the given size, under the id `id`.
    ///
    /// # Panics
    /// If there are no decks or more than four, or if a class has an odd number of cards.
    pub fn new(id: &str, Params { decks, field }: Params) -> Self {
        assert!((1..=MAX_DECKS).contains(&decks), "{decks} decks, allowed is 1..={MAX_DECKS}");
        let n = decks * CARDS;
        let classes = field.classes() as u16;
        assert!((n / field.classes()).is_multiple_of(2), "an odd number of cards of each {}", field.name());
        // The package's ceil(2n - n / (2n - 1)) is 2n.
        let steps = 2 * n as u32;
        let spec = EnvSpec {
            id: id.to_owned(),
            observation: Space::MultiDiscrete(vec![classes + 1; n]),
            action: Space::Discrete(n as u16),
            state: Space::Tuple(vec![
                Space::MultiDiscrete(vec![classes; n]),
                Space::MultiDiscrete(vec![2; n]),
                Space::MultiDiscrete(vec![n as u16; 2]),
            ]),
            max_steps: steps,
            return_range: (-1.0, 1.0),
        };
        let fail = -1.0 / f64::from(steps);
        let mut rewards = [0.0; 8];
        rewards[MATCHED] = fail;
        rewards[SECOND] = 2.0 * fail;
        rewards[SECOND + MATCHED] = 2.0 * fail;
        rewards[SECOND + PAIR] = 2.0 / n as f64;
        Self {
            deck: Deck::of(decks, field),
            classes: [u8::MAX; 256],
            table: [classes as u8; 256],
            face_down: classes as u8,
            first: none(n),
            turned: [none(n); 2],
            matched: 0,
            steps: 0,
            rewards,
            spec,
        }
    }

    /// The class of a card as the agent sees it, face down or not.
    fn seen(&self, card: u8) -> u8 {
        let places = if self.turned.contains(&card) { &self.classes } else { &self.table };
        places[usize::from(card)]
    }
}

impl Env for Concentration {
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
        let n = self.deck.classes().len();
        self.classes[..n].copy_from_slice(self.deck.classes());
        self.table.fill(self.face_down);
        (self.first, self.turned) = (none(n), [none(n); 2]);
        (self.matched, self.steps) = (0, 0);
        observation.discrete.fill(self.face_down);
    }

    #[expect(clippy::inline_always, reason = "too long to be inlined otherwise, and as a call it takes much longer")]
    #[inline(always)]
    fn step(&mut self, action: Value<'_>, _draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let (card, first) = (action.discrete[0], self.first);
        let [here, there] = [card, first].map(usize::from);
        let n = observation.discrete.len();
        let class = self.classes[here];
        let second = first != none(n);
        let matched = self.table[here] != self.face_down;
        // None as the first has no card's class.
        let pair = class == self.classes[there] && card != first && !matched;

        // Copied before the table changes, because a wide read must wait for the bytes written just before. A new pair is
        // in play, so that it is seen all the same.
        observation.discrete.copy_from_slice(&self.table[..n]);
        let other = if second { there } else { here };
        observation.discrete[other] = self.classes[other];
        observation.discrete[here] = class;

        // Nothing here hangs on a branch: what random players turn over cannot be predicted.
        self.turned = [first, card];
        self.first = if second || matched { none(n) } else { card };
        self.table[here] = if pair { class } else { self.table[here] };
        self.table[there] = if pair { class } else { self.table[there] };
        self.matched += 2 * u8::from(pair);
        self.steps += 1;
        let what = usize::from(second) * SECOND + usize::from(matched) * MATCHED + usize::from(pair) * PAIR;
        Step {
            reward: self.rewards[what],
            terminated: usize::from(self.matched) == n,
            truncated: usize::from(self.steps) == 2 * n,
        }
    }

    fn state(&self, state: ValueMut<'_>) {
        let n = self.deck.classes().len();
        let (classes, rest) = state.discrete.split_at_mut(n);
        let (matched, turned) = rest.split_at_mut(n);
        classes.copy_from_slice(self.deck.classes());
        for (out, &seen) in matched.iter_mut().zip(&self.table[..n]) {
            *out = u8::from(seen != self.face_down);
        }
        // The cards in the order of turning, and then the symbol for none.
        let cards = self.turned.into_iter().filter(|&card| card != none(n)).chain([self.face_down; 2]);
        turned.iter_mut().zip(cards).for_each(|(out, card)| *out = card);
    }

    fn render(&self, view: View, canvas: &mut Canvas) {
        /// Cards side by side, and columns of each.
        const LINE: usize = 13;
        const WIDTH: usize = 5;
        let field = self.deck.field();
        let cards = self.deck.cards();
        for (place, &card) in cards.iter().enumerate() {
            let (row, column) = (place / LINE, WIDTH * (place % LINE));
            let (seen, last) = (self.seen(place as u8), self.turned[1] == place as u8);
            let up = seen != self.face_down;
            let (text, style) = match view {
                View::Observed if !up => ("░░░".to_owned(), Style::ink(Colour::Grey)),
                View::Observed if field == Field::Colour => {
                    (["B", "R"][usize::from(seen)].to_owned(), field.style(seen))
                }
                View::Observed => (field.symbol(seen).to_owned(), field.style(seen)),
                View::Revealed => {
                    let style = Field::Suit.style(Field::Suit.of(card));
                    let paper = if self.table[place] != self.face_down {
                        Colour::Green
                    } else if up {
                        Colour::Blue
                    } else {
                        Colour::Default
                    };
                    (label(card), style.on(paper))
                }
            };
            let text = if last { format!("[{text:^3}]") } else { format!(" {text:^3} ") };
            canvas.put_action(row, column, &text, style, place as u16);
        }
        if view == View::Revealed {
            let (n, row) = (cards.len(), cards.len().div_ceil(LINE) + 1);
            canvas.put(row, 0, &format!("matched: {} of {n} cards", self.matched), Style::PLAIN);
            let limit = self.spec.max_steps;
            canvas.put(row + 1, 0, &format!("turned over: {} of at most {limit}", self.steps), Style::PLAIN);
        }
    }
}
