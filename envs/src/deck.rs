//! The cards of the card games: one or more French decks, shuffled together.
//!
//! Card `i` of `0..52 * decks` has suit `i mod 4` (spades, diamonds, clubs, hearts), colour `i mod 2` (black, red) and
//! rank `(i mod 52) div 4` (ace, 2..10, jack, queen, king). Dealing takes from the END of the shuffled array, as the
//! Python package does.

use crate::rng::{EpisodeRng, below};

/// Cards in one deck.
pub const CARDS: usize = 52;
/// Number of suits.
pub const SUITS: usize = 4;
/// Number of ranks.
pub const RANKS: usize = 13;
/// Most decks that can be shuffled together: a card is stored in 16 bits.
pub const MAX_DECKS: usize = 1 << 10;

/// The suit of a card, in `0..4`.
pub fn suit(card: u16) -> u8 {
    (card % SUITS as u16) as u8
}

/// The colour of a card, in `0..2`.
pub fn colour(card: u16) -> u8 {
    (card % 2) as u8
}

/// The rank of a card, in `0..13`.
pub fn rank(card: u16) -> u8 {
    (card % CARDS as u16 / SUITS as u16) as u8
}

/// A shuffled deck and how much of it was dealt.
#[derive(Clone, Debug)]
pub struct Deck {
    cards: Vec<u16>,
    left: usize,
}

impl Deck {
    /// `decks` decks of 52 cards, not shuffled, nothing dealt.
    ///
    /// # Panics
    /// If `decks` is not in `1..=`[`MAX_DECKS`].
    pub fn new(decks: usize) -> Self {
        assert!((1..=MAX_DECKS).contains(&decks), "{decks} decks, allowed is 1..={MAX_DECKS}");
        let left = decks * CARDS;
        Self { cards: (0..left as u16).collect(), left }
    }

    /// Shuffles all cards and takes them back. The order depends on `rng` alone, not on the order before.
    pub fn shuffle(&mut self, rng: &mut EpisodeRng) {
        // Fisher and Yates, "inside out": fills the array while shuffling it.
        for i in 0..self.cards.len() {
            let j = below(rng, i as u32 + 1) as usize;
            self.cards[i] = self.cards[j];
            self.cards[j] = i as u16;
        }
        self.restart();
    }

    /// Puts the cards in the order `cards` and takes them back.
    ///
    /// # Errors
    /// If `cards` does not hold every card once.
    pub fn set(&mut self, cards: &[u16]) -> Result<(), String> {
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
        self.cards.copy_from_slice(cards);
        self.restart();
        Ok(())
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

    /// The card that was (or will be) dealt as number `index`, counted from 0.
    pub fn dealt_at(&self, index: usize) -> u16 {
        self.cards[self.cards.len() - 1 - index]
    }

    /// How many cards were dealt.
    pub fn dealt(&self) -> usize {
        self.cards.len() - self.left
    }

    /// How many cards were not yet dealt.
    pub fn left(&self) -> usize {
        self.left
    }

    /// Cards in all, dealt or not, in shuffled order (dealt from the end).
    pub fn cards(&self) -> &[u16] {
        &self.cards
    }

    /// Writes the fraction of each suit not yet dealt, `[4]`, each in `[0, 1]`.
    pub fn write_suits_left(&self, out: &mut [f32]) {
        let mut counts = [0_u16; SUITS];
        for &card in &self.cards[..self.left] {
            counts[usize::from(suit(card))] += 1;
        }
        let each = (self.cards.len() / SUITS) as f32;
        for (out, count) in out.iter_mut().zip(counts) {
            *out = f32::from(count) / each;
        }
    }
}
