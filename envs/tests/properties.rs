//! Spaces and decks, on random examples.
#![allow(clippy::float_cmp, reason = "these numbers are compared to the last bit")]

use popgym_envs::deck::{CARDS, Deck, colour, rank, suit};
use popgym_envs::{Leaf, Purpose, Slab, Space, SpaceError, Value, stream};
use proptest::prelude::*;

fn spaces() -> impl Strategy<Value = Space> {
    let bounds = (-10.0_f32..10.0, 0.0_f32..5.0).prop_map(|(low, width)| (low, low + width));
    let leaf = prop_oneof![
        (1_u16..=256).prop_map(Space::Discrete),
        prop::collection::vec(1_u16..=256, 1..6).prop_map(Space::MultiDiscrete),
        prop::collection::vec(bounds, 1..5).prop_map(|bounds| {
            let (low, high) = bounds.into_iter().unzip();
            Space::Box { low, high }
        }),
    ];
    leaf.prop_recursive(3, 16, 4, |part| prop::collection::vec(part, 1..4).prop_map(Space::Tuple))
}

/// A uniform point of `space`.
fn point(space: &Space, seed: u64) -> Slab {
    let mut slab = Slab::new(space, 1);
    space.sample_into(&mut stream(seed, 0, 0, Purpose::TrainAction), slab.row_mut(0));
    slab
}

proptest! {
    #[test]
    fn samples_are_points(space in spaces(), seed: u64) {
        prop_assert_eq!(space.validate(), Ok(()));
        prop_assert_eq!(space.check(point(&space, seed).row(0)), Ok(()));
    }

    #[test]
    fn flat_vectors_can_be_read_back(space in spaces(), seed: u64) {
        let slab = point(&space, seed);
        let mut flat = vec![f32::NAN; space.flat_width()];
        space.flatten_into(slab.row(0), &mut flat);
        let (mut rest, mut discrete, mut real) = (flat.as_slice(), Vec::new(), Vec::new());
        for leaf in space.leaves() {
            let width = if let Leaf::Discrete { classes } = leaf { usize::from(classes) } else { 1 };
            let (part, after) = rest.split_at(width);
            if let Leaf::Discrete { .. } = leaf {
                let ones: Vec<usize> = (0..width).filter(|&i| part[i] == 1.0).collect();
                prop_assert!(ones.len() == 1 && part.iter().sum::<f32>() == 1.0);
                discrete.push(ones[0] as u8);
            } else {
                real.push(part[0]);
            }
            rest = after;
        }
        prop_assert!(rest.is_empty());
        prop_assert_eq!(Value { discrete: &discrete, real: &real }, slab.row(0));
    }

    #[test]
    fn values_outside_are_named(space in spaces(), seed: u64, pick: prop::sample::Index) {
        let leaves = space.leaves();
        let at = pick.index(leaves.len());
        let before = |leaf: fn(&Leaf) -> bool| leaves[..at].iter().filter(|x| leaf(x)).count();
        let mut slab = point(&space, seed);
        match leaves[at] {
            Leaf::Discrete { classes } if classes <= 255 => {
                let index = before(|leaf| matches!(leaf, Leaf::Discrete { .. }));
                slab.discrete[index] = classes as u8;
                let error = SpaceError::Class { index, value: classes as u8, classes };
                prop_assert_eq!(space.check(slab.row(0)), Err(error));
            }
            // Every byte is one of 256 classes.
            Leaf::Discrete { .. } => {}
            Leaf::Real { low, high } => {
                let index = before(|leaf| matches!(leaf, Leaf::Real { .. }));
                for outside in [low - 1.0, high + 1.0, f32::NAN, f32::INFINITY] {
                    slab.real[index] = outside;
                    let found = space.check(slab.row(0));
                    prop_assert!(matches!(found, Err(SpaceError::Real { index: i, .. }) if i == index), "{:?}", found);
                }
            }
        }
    }

    #[test]
    fn other_widths_are_errors(space in spaces(), seed: u64) {
        let mut slab = point(&space, seed);
        slab.discrete.push(0);
        let value = Value { discrete: &slab.discrete, real: &slab.real };
        let is_width = matches!(space.check(value), Err(SpaceError::Width { .. }));
        prop_assert!(is_width);
    }

    #[test]
    fn a_slab_keeps_its_rows_apart(space in spaces(), seeds in prop::collection::vec(any::<u64>(), 1..6)) {
        let points: Vec<Slab> = seeds.iter().map(|&seed| point(&space, seed)).collect();
        let (mut pushed, mut written) = (Slab::new(&space, 0), Slab::new(&space, seeds.len()));
        for (row, point) in points.iter().enumerate().rev() {
            written.set(row, point.row(0));
        }
        for (row, point) in points.iter().enumerate() {
            pushed.push(point.row(0));
            prop_assert_eq!(written.row(row), point.row(0));
        }
        prop_assert_eq!(pushed, written);
    }

    #[test]
    fn a_shuffled_deck_holds_every_card(decks in 1_usize..17, seed: u64) {
        let mut deck = Deck::new(decks);
        deck.shuffle(&mut stream(seed, 0, 0, Purpose::TrainEnv));
        let shuffled = deck.cards().to_vec();
        prop_assert_eq!(deck.set(&shuffled), Ok(()));
        let dealt: Vec<u16> = (0..decks * CARDS).map(|_| deck.deal()).collect();
        prop_assert!(dealt.iter().eq(shuffled.iter().rev()));
        prop_assert_eq!((deck.left(), deck.dealt()), (0, decks * CARDS));
        // Of one deck: 13 of each suit, 26 of each colour, 4 of each rank.
        for (field, classes) in [(suit as fn(u16) -> u8, 4), (colour, 2), (rank, 13)] {
            for class in 0..classes {
                let count = dealt.iter().filter(|&&card| field(card) == class).count();
                prop_assert_eq!(count, dealt.len() / usize::from(classes));
            }
        }
    }
}

#[test]
fn cards_are_numbered_by_rank_and_suit() {
    let fields = |card| (rank(card), suit(card), colour(card));
    assert_eq!(
        [0, 1, 4, 51, 52, 103].map(fields),
        [(0, 0, 0), (0, 1, 1), (1, 0, 0), (12, 3, 1), (0, 0, 0), (12, 3, 1)]
    );
}

#[test]
fn spaces_that_make_no_sense_are_errors() {
    let two = |low: f32, high: f32| Space::Box { low: vec![0.0, low], high: vec![1.0, high] };
    let cases = [
        (Space::Discrete(0), "component 0 has 0 classes"),
        (Space::MultiDiscrete(vec![2, 257]), "component 1 has 257 classes"),
        (two(1.0, 0.5), "component 1 has the bounds"),
        (two(f32::NAN, 0.5), "component 1 has the bounds"),
        (Space::Box { low: vec![0.0], high: vec![] }, "1 lower and 0 upper"),
    ];
    for (space, reason) in cases {
        for space in [space.clone(), Space::Tuple(vec![Space::Discrete(2), space])] {
            let error = space.validate().unwrap_err();
            assert!(error.contains(reason), "{error}");
        }
    }
}
