//! **CountRecall**: each step shows a value and asks how often another was shown so far.
//!
//! | | |
//! |---|---|
//! | observation | `MultiDiscrete([d, d])`: the class of the card just dealt, the value; the class that is asked for, the query |
//! | action | `Discrete(m + 1)`: how many values of the query's class were shown, the present one included |
//! | reward | `1 / (n - 1)` if right, else `-1 / (n - 1)`, of `n` cards |
//! | end | terminates with the last value, after exactly `n - 1` steps; never truncates |
//! | state | for each class the values, then the queries shown, as a part of `m`; the present value and query |
//!
//! Values and queries come from two decks of `n` cards, shuffled apart. A card's class is its colour, suit or rank: `d`
//! classes of `m = n / d` cards. The last query is never answered.
//!
//! Quirk kept: the full count `m` can be answered, which the version behind the paper's numbers did not allow: it had
//! one action fewer, the only difference.
//!
//! Source: Morad et al., ICLR 2023, the diagnostic environments; rules as in the Python package 1.0.7.

use serde::{Deserialize, Serialize};

use crate::canvas::{Canvas, Style, View};
use crate::deck::{CARDS, Deck, Field, RANKS, count, counts};
use crate::draws::Draws;
use crate::env::{Env, EnvSpec, Step, parse_world, step_all_classes, world_value};
use crate::pictures::{self, Choices};
use crate::rng::EpisodeRng;
use crate::space::{MAX_CLASSES, Slab, Space, Value, ValueMut};

/// The size of a game.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Params {
    /// Decks shuffled together, as values and again as queries.
    pub decks: usize,
    /// What counts of a card.
    pub field: Field,
}

/// Easy, medium, hard.
pub const LEVELS: [Params; 3] = [
    Params { decks: 1, field: Field::Colour },
    Params { decks: 2, field: Field::Suit },
    Params { decks: 4, field: Field::Rank },
];

/// What a reset draws.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct World {
    /// Card indices in shuffled order, `[52 * decks]`; dealt from the end as values.
    pub value_deck: Vec<u16>,
    /// Card indices in shuffled order, `[52 * decks]`; dealt from the end as queries.
    pub query_deck: Vec<u16>,
}

/// The classes that are counted: enough places for ranks, and a power of two, so that no index is beyond.
const PLACES: usize = RANKS.next_power_of_two();

/// The game.
#[derive(Clone, Debug)]
pub struct CountRecall {
    /// Values and queries, in shuffled order.
    shown: Vec<[u8; 2]>,
    /// Cards not yet dealt, of each deck.
    left: usize,
    /// Values shown of each class.
    counts: [u8; PLACES],
    /// What is shown.
    observed: [u8; 2],
    last_action: Option<u8>,
    /// Of a wrong and of a right answer: looked up, because which it is cannot be predicted.
    rewards: [f64; 2],
    values: Deck,
    queries: Deck,
    spec: EnvSpec,
}

impl CountRecall {
    /// A game of the given size, under the id `id`.
    ///
    /// # Panics
    /// If `decks` is out of the bounds of [`Deck::new`], or there are more than 255 cards of a class.
    pub fn new(id: &str, Params { decks, field }: Params) -> Self {
        let deck = Deck::of(decks, field);
        let (n, classes) = (decks * CARDS, field.classes());
        let most = n / classes;
        assert!(most < usize::from(MAX_CLASSES), "{most} cards of each {}, allowed is up to 255", field.name());
        let spec = EnvSpec {
            id: id.to_owned(),
            observation: Space::MultiDiscrete(vec![classes as u16; 2]),
            action: Space::Discrete(most as u16 + 1),
            state: Space::Tuple(vec![
                Space::uniform_box(classes, 0.0, 1.0),
                Space::uniform_box(classes, 0.0, 1.0),
                Space::MultiDiscrete(vec![classes as u16; 2]),
            ]),
            max_steps: n as u32 - 1,
            return_range: (-1.0, 1.0),
        };
        let unit = 1.0 / (n - 1) as f64;
        Self {
            shown: vec![[0; 2]; n],
            left: n,
            values: deck.clone(),
            queries: deck,
            counts: [0; PLACES],
            observed: [0; 2],
            last_action: None,
            rewards: [-unit, unit],
            spec,
        }
    }

    /// Puts values and queries side by side.
    fn pair(&mut self) {
        let classes = self.values.classes().iter().zip(self.queries.classes());
        self.shown.iter_mut().zip(classes).for_each(|(shown, (&value, &query))| *shown = [value, query]);
        self.left = self.shown.len();
    }

    #[inline]
    fn deal(&mut self, observation: &mut [u8]) {
        let left = self.left.wrapping_sub(1);
        self.observed = *self.shown.get(left).expect("a card is left while the episode lasts");
        self.left = left;
        self.counts[usize::from(self.observed[0]) % PLACES] += 1;
        observation.copy_from_slice(&self.observed);
    }

    /// How many values of the query's class were shown.
    #[inline]
    fn right(&self) -> u8 {
        self.counts[usize::from(self.observed[1]) % PLACES]
    }
}

impl Env for CountRecall {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn draw_world(&mut self, rng: &mut EpisodeRng) {
        self.values.shuffle(rng);
        self.queries.shuffle(rng);
        self.pair();
    }

    fn set_world(&mut self, world: &serde_json::Value) -> Result<(), String> {
        let World { value_deck, query_deck } = parse_world(world)?;
        // Both are checked before either is set.
        self.queries.check(&query_deck).map_err(|error| format!("query_deck: {error}"))?;
        self.values.set(&value_deck).map_err(|error| format!("value_deck: {error}"))?;
        self.queries.set(&query_deck)?;
        self.pair();
        Ok(())
    }

    fn world(&self) -> serde_json::Value {
        let [value_deck, query_deck] = [&self.values, &self.queries].map(|deck| deck.cards().to_vec());
        world_value(&World { value_deck, query_deck })
    }

    fn begin(&mut self, _draws: &mut dyn Draws, observation: ValueMut<'_>) {
        self.left = self.shown.len();
        self.counts.fill(0);
        self.last_action = None;
        self.deal(observation.discrete);
    }

    #[expect(clippy::inline_always, reason = "too long to be inlined otherwise, and as a call it takes much longer")]
    #[inline(always)]
    fn step(&mut self, action: Value<'_>, _draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let action = action.discrete[0];
        self.last_action = Some(action);
        let reward = self.rewards[usize::from(action == self.right())];
        self.deal(observation.discrete);
        Step { reward, terminated: self.left == 0, truncated: false }
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
        let classes = self.values.field().classes();
        let most = (self.shown.len() / classes) as f32;
        let (values, queries) = state.real.split_at_mut(classes);
        let asked = counts(&self.queries.classes()[self.left..]);
        values.iter_mut().zip(self.counts).for_each(|(out, count)| *out = f32::from(count) / most);
        queries.iter_mut().zip(asked).for_each(|(out, count)| *out = f32::from(count) / most);
        state.discrete.copy_from_slice(&self.observed);
    }

    fn render(&self, view: View, canvas: &mut Canvas) {
        /// Counts side by side.
        const LINE: u8 = 9;
        let (field, left) = (self.values.field(), self.left);
        let [value, query] = self.observed;
        let begun = left < self.shown.len();
        canvas.put(0, 0, "value", Style::PLAIN);
        canvas.put(0, 12, "query", Style::PLAIN);
        pictures::card(canvas, 1, 0, field, begun.then_some(value));
        pictures::card(canvas, 1, 12, field, begun.then_some(query));
        let question = format!("how many values of {} {} so far?", field.name(), field.symbol(query));
        canvas.put(4, 0, &question, Style::PLAIN);
        let right = (view == View::Revealed && begun && left > 0).then(|| self.right());
        let choices = Choices { last: self.last_action, right };
        let most = (self.shown.len() / field.classes()) as u8;
        for number in 0..=most {
            let (row, column) = (usize::from(5 + number / LINE), 4 * usize::from(number % LINE));
            choices.put(canvas, row, column, number, &format!("{number:>2}"), Style::PLAIN);
        }
        if view == View::Revealed {
            let row = usize::from(7 + most / LINE);
            let answer = right.map_or("none".to_owned(), |number| number.to_string());
            pictures::line(canvas, row, "answer now:", &answer, Style::PLAIN);
            let queries = &self.queries.classes()[self.left..];
            let values = |class| u16::from(self.counts[usize::from(class) % PLACES]);
            let rows: [(&str, &dyn Fn(u8) -> u16); 2] =
                [("values", &values), ("queries", &|class| count(queries, class))];
            let row = pictures::counts(canvas, row + 1, field, &rows);
            pictures::line(canvas, row, "left:", &format!("{left} of each"), Style::PLAIN);
        }
    }
}
