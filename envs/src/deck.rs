//! The cards of the card games: one or more French decks, shuffled together.
//!
//! Card `i` of `0..52 * decks` has suit `i mod 4` (spades, diamonds, clubs, hearts), colour `i mod 2` (black, red) and
//! rank `(i mod 52) div 4` (ace, 2..10, jack, queen, king). Dealing takes from the END of the shuffled array, as the
//! Python package does.

use crate::canvas::{Colour, Style};
use crate::rng::{EpisodeRng, below};

/// Cards in one deck.
pub const CARDS: usize = 52;
/// Number of suits.
pub const SUITS: usize = 4;
/// Number of ranks.
pub const RANKS: usize = 13;
/// Most decks that can be shuffled together: a card is stored in 16 bits.
pub const MAX_DECKS: usize = 1 << 10;

/// What the suits are called, in their order.
pub const SUIT_NAMES: [&str; SUITS] = ["spades", "diamonds", "clubs", "hearts"];
/// How the suits are drawn, in their order.
pub const SUIT_SYMBOLS: [&str; SUITS] = ["♠", "♦", "♣", "♥"];
/// How the ranks are drawn, in their order.
pub const RANK_SYMBOLS: [&str; RANKS] = ["A", "2", "3", "4", "5", "6", "7", "8", "9", "10", "J", "Q", "K"];
/// What the colours are called, in their order.
pub const COLOUR_NAMES: [&str; 2] = ["black", "red"];

/// The suit of a card, in `0..4`.
#[inline]
pub fn suit(card: u16) -> u8 {
    (card % SUITS as u16) as u8
}

/// The colour of a card, in `0..2`.
#[inline]
pub fn colour(card: u16) -> u8 {
    (card % 2) as u8
}

/// The rank of a card, in `0..13`.
#[inline]
pub fn rank(card: u16) -> u8 {
    (card % CARDS as u16 / SUITS as u16) as u8
}

/// Rank and suit of a card, as it is drawn: `10♥`.
pub fn label(card: u16) -> String {
    [Field::Rank.symbol(rank(card)), Field::Suit.symbol(suit(card))].concat()
}

/// What a game looks at in a card.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Field {
    /// Black or red.
    Colour,
    /// Spades, diamonds, clubs or hearts.
    Suit,
    /// Ace, 2..10, jack, queen or king.
    Rank,
}

impl Field {
    /// Number of classes.
    pub const fn classes(self) -> usize {
        match self {
            Self::Colour => 2,
            Self::Suit => SUITS,
            Self::Rank => RANKS,
        }
    }

    /// The class of a card, in `0..classes`.
    #[inline]
    pub fn of(self, card: u16) -> u8 {
        match self {
            Self::Colour => colour(card),
            Self::Suit => suit(card),
            Self::Rank => rank(card),
        }
    }

    /// What it is called.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Colour => "colour",
            Self::Suit => "suit",
            Self::Rank => "rank",
        }
    }

    /// How a class is drawn.
    ///
    /// # Panics
    /// If there is no such class.
    pub const fn symbol(self, class: u8) -> &'static str {
        match self {
            Self::Colour => COLOUR_NAMES[class as usize],
            Self::Suit => SUIT_SYMBOLS[class as usize],
            Self::Rank => RANK_SYMBOLS[class as usize],
        }
    }

    /// How a class looks: red in red.
    pub const fn style(self, class: u8) -> Style {
        match self {
            Self::Colour | Self::Suit if class % 2 == 1 => Style::ink(Colour::Red),
            _ => Style::PLAIN,
        }
    }
}

/// A shuffled deck and how much of it was dealt.
#[derive(Clone, Debug)]
pub struct Deck {
    left: usize,
    /// Of each card, what the game looks at: all that a step reads.
    classes: Vec<u8>,
    field: Field,
    cards: Vec<u16>,
}

impl Deck {
    /// `decks` decks of 52 cards whose suits matter, not shuffled, nothing dealt.
    ///
    /// # Panics
    /// If `decks` is not in `1..=`[`MAX_DECKS`].
    pub fn new(decks: usize) -> Self {
        Self::of(decks, Field::Suit)
    }

    /// `decks` decks of 52 cards of which `field` matters, not shuffled, nothing dealt.
    ///
    /// # Panics
    /// If `decks` is not in `1..=`[`MAX_DECKS`].
    pub fn of(decks: usize, field: Field) -> Self {
        assert!((1..=MAX_DECKS).contains(&decks), "{decks} decks, allowed is 1..={MAX_DECKS}");
        let n = decks * CARDS;
        let mut deck = Self { left: n, classes: vec![0; n], field, cards: (0..n as u16).collect() };
        deck.classify();
        deck
    }

    /// Shuffles all cards and takes them back. The order depends on `rng` alone, not on the order before.
    pub fn shuffle(&mut self, rng: &mut EpisodeRng) {
        // Fisher and Yates, "inside out": fills the array while shuffling it.
        for i in 0..self.cards.len() {
            let j = below(rng, i as u32 + 1) as usize;
            self.cards[i] = self.cards[j];
            self.cards[j] = i as u16;
        }
        self.classify();
        self.restart();
    }

    /// Checks that `cards` holds every card once.
    ///
    /// # Errors
    /// The first thing that is wrong.
    pub fn check(&self, cards: &[u16]) -> Result<(), String> {
        let n = self.cards.len();
        if cards.len() != n {
            return Err(format!("a deck of {} cards, expected {n}", cards.len()));
        }
        let mut seen = vec![false; n];
        for &card in cards {
            match seen.get_mut(usize::from(card)) {
                None => return Err(format!("card {card} in the deck, allowed is 0..{n}")),
                Some(true) => return Err(format!("card {card} is twice in the deck")),
                Some(place) => *place = true,
            }
        }
        Ok(())
    }

    /// Puts the cards in the order `cards` and takes them back.
    ///
    /// # Errors
    /// If `cards` does not hold every card once.
    pub fn set(&mut self, cards: &[u16]) -> Result<(), String> {
        self.check(cards)?;
        self.cards.copy_from_slice(cards);
        self.classify();
        self.restart();
        Ok(())
    }

    /// Looks at each card.
    fn classify(&mut self) {
        let pairs = self.classes.iter_mut().zip(&self.cards);
        // One loop for each field, of which every one is a vector loop.
        match self.field {
            Field::Colour => pairs.for_each(|(class, &card)| *class = colour(card)),
            Field::Suit => pairs.for_each(|(class, &card)| *class = suit(card)),
            Field::Rank => pairs.for_each(|(class, &card)| *class = rank(card)),
        }
    }

    /// Takes all cards back, in the same order.
    pub fn restart(&mut self) {
        self.left = self.cards.len();
    }

    /// Deals the next card.
    ///
    /// # Panics
    /// If no card is left.
    pub fn deal(&mut self) -> u16 {
        self.left = self.left.checked_sub(1).expect("a card is left while the episode lasts");
        self.cards[self.left]
    }

    /// Deals the next card and gives its class.
    ///
    /// # Panics
    /// If no card is left.
    #[inline]
    pub fn deal_class(&mut self) -> u8 {
        let left = self.left.wrapping_sub(1);
        let class = *self.classes.get(left).expect("a card is left while the episode lasts");
        self.left = left;
        class
    }

    /// The class of the card dealt `back` cards before the last one dealt, if there is one.
    #[inline]
    pub fn class_back(&self, back: usize) -> Option<u8> {
        self.classes.get(self.left + back).copied()
    }

    /// How many cards were dealt.
    #[inline]
    pub fn dealt(&self) -> usize {
        self.cards.len() - self.left
    }

    /// How many cards were not yet dealt.
    #[inline]
    pub fn left(&self) -> usize {
        self.left
    }

    /// Cards in all, dealt or not, in shuffled order (dealt from the end).
    pub fn cards(&self) -> &[u16] {
        &self.cards
    }

    /// Their classes, in the same order.
    #[inline]
    pub fn classes(&self) -> &[u8] {
        &self.classes
    }

    /// What matters of the cards.
    pub fn field(&self) -> Field {
        self.field
    }

    /// Writes the fraction of each class not yet dealt, each in `[0, 1]`.
    pub fn write_fractions_left(&self, out: &mut [f32]) {
        let each = (self.cards.len() / self.field.classes()) as f32;
        for (class, out) in (0..).zip(out) {
            *out = f32::from(count(&self.classes[..self.left], class)) / each;
        }
    }
}

/// How often each class is among `classes`, of which there are fewer than 65536. For few classes, `count` is faster.
pub(crate) fn counts(classes: &[u8]) -> [u16; RANKS] {
    let mut counts = [0; RANKS];
    for &class in classes {
        counts[usize::from(class)] += 1;
    }
    counts
}

/// How often `class` is among `classes`, of which there are fewer than 65536.
pub(crate) fn count(classes: &[u8], class: u8) -> u16 {
    classes.iter().map(|&other| u16::from(other == class)).sum()
}
