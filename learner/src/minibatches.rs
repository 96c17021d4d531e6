//! How an epoch's episodes are cut into minibatches, whole episode by whole episode.

use popgym_envs::EpisodeRng;
use popgym_envs::rng::below;
use serde::{Deserialize, Serialize};

use crate::config::Ppo;

/// Which episodes share a minibatch.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Minibatches {
    /// Every pass shuffles all episodes and cuts them anew.
    Shuffled,
    /// The same in every pass, visited in another order (RLlib 2.0's, which the paper used).
    Fixed,
}

/// The minibatches of one pass, as indices of episodes that are as long as `lengths` says.
pub fn minibatches(lengths: &[i64], ppo: &Ppo, rng: &mut EpisodeRng) -> Vec<Vec<usize>> {
    match ppo.minibatches {
        Minibatches::Shuffled => shuffled(lengths, ppo.minibatch_steps, rng),
        Minibatches::Fixed => {
            let mut parts = fixed(lengths, ppo.minibatch_steps);
            shuffle(&mut parts, rng);
            parts
        }
    }
}

/// Whole episodes, shuffled, cut into parts of about `budget` steps; every episode is in exactly one.
///
/// There are round(steps / budget) parts (1 at least), as equal as whole episodes allow: an episode belongs to the part
/// in which its middle falls when all are laid end to end.
fn shuffled(lengths: &[i64], budget: i64, rng: &mut EpisodeRng) -> Vec<Vec<usize>> {
    let mut order: Vec<usize> = (0..lengths.len()).collect();
    shuffle(&mut order, rng);
    let total: i64 = lengths.iter().sum();
    let parts = ((total + budget / 2) / budget).clamp(1, lengths.len() as i64);
    let mut minibatches = vec![Vec::new(); parts as usize];
    let mut before = 0;
    for episode in order {
        let middle = before + lengths[episode] / 2;
        minibatches[(middle * parts / total) as usize].push(episode);
        before += lengths[episode];
    }
    minibatches.retain(|episodes| !episodes.is_empty());
    minibatches
}

/// Episodes in their order. Part `j` begins with the episode that contains step `budget j` when all are laid end to end, and
/// ends before the one that contains step `budget (j + 1)`. There are floor(steps / budget) parts (1 at least); what follows
/// the last is not used in this epoch. (Reference: RLlib 2.0's slices along whole sequences.)
fn fixed(lengths: &[i64], budget: i64) -> Vec<Vec<usize>> {
    let total: i64 = lengths.iter().sum();
    let parts = (total / budget).max(1);
    let mut starts = lengths.iter().scan(0, |end, length| {
        *end += length;
        Some(*end)
    });
    // The first episode that ends after a step contains it, or all end before.
    let mut episode = 0;
    let mut end = starts.next().unwrap_or(0);
    let mut containing = |step: i64| {
        while episode < lengths.len() && end <= step {
            episode += 1;
            end = starts.next().unwrap_or(i64::MAX);
        }
        episode
    };
    let boundaries: Vec<usize> = (0..=parts).map(|part| containing(part * budget)).collect();
    let parts = boundaries.windows(2).map(|ends| (ends[0]..ends[1]).collect::<Vec<usize>>());
    // An episode may be longer than a part, even longer than all of them.
    let mut parts: Vec<Vec<usize>> = parts.filter(|part| !part.is_empty()).collect();
    if parts.is_empty() {
        parts.push((0..lengths.len()).collect());
    }
    parts
}

/// Every order is equally likely.
fn shuffle<T>(items: &mut [T], rng: &mut EpisodeRng) {
    for last in (1..items.len()).rev() {
        items.swap(last, below(rng, last as u32 + 1) as usize);
    }
}

#[cfg(test)]
mod tests {
    use popgym_envs::{Purpose, stream};
    use proptest::prelude::*;

    use super::*;

    /// Reference 3.4, by hand: episodes end after steps 3, 7, 9, 10, 16, 18.
    #[test]
    fn fixed_minibatches_by_hand() {
        let lengths = [3, 4, 2, 1, 6, 2];
        // Steps 0, 5, 10, 15 lie in episodes 0, 1, 4, 4: the part from 10 to 15 is empty.
        assert_eq!(fixed(&lengths, 5), [vec![0], vec![1, 2, 3]]);
        // Steps 0, 6, 12, 18: the last is behind all.
        assert_eq!(fixed(&lengths, 6), [vec![0], vec![1, 2, 3], vec![4, 5]]);
        // Steps 0 and 10; the rest is not used.
        assert_eq!(fixed(&lengths, 10), [vec![0, 1, 2, 3]]);
        assert_eq!(fixed(&lengths, 18), [vec![0, 1, 2, 3, 4, 5]]);
        assert_eq!(fixed(&lengths, 100), [vec![0, 1, 2, 3, 4, 5]]);
        // Steps 0, 10, 20 lie in the only episode, which must be learned from all the same.
        assert_eq!(fixed(&[25], 10), [vec![0]]);
        assert_eq!(fixed(&[8_192; 8], 8_192), (0..8).map(|episode| vec![episode]).collect::<Vec<_>>());
    }

    #[test]
    fn fixed_minibatches_are_visited_in_every_order() {
        let ppo = Ppo { minibatch_steps: 2, ..Ppo::paper() };
        let mut rng = stream(1, 0, 0, Purpose::Shuffle);
        let orders: std::collections::BTreeSet<Vec<Vec<usize>>> =
            (0..200).map(|_| minibatches(&[1; 6], &ppo, &mut rng)).collect();
        assert_eq!(orders.len(), 6, "three parts have six orders");
        for order in orders {
            let mut parts = order;
            parts.sort_unstable();
            assert_eq!(parts, [vec![0, 1], vec![2, 3], vec![4, 5]]);
        }
    }

    proptest! {
        #[test]
        fn every_episode_is_in_one_shuffled_minibatch(
            lengths in proptest::collection::vec(1..300i64, 1..80), budget in 1..5000i64, seed in 0..1000u64,
        ) {
            let mut rng = stream(seed, 0, 0, Purpose::Shuffle);
            let parts = shuffled(&lengths, budget, &mut rng);
            let mut seen: Vec<usize> = parts.concat();
            seen.sort_unstable();
            prop_assert_eq!(seen, (0..lengths.len()).collect::<Vec<_>>());
            // A part is the budget, give or take what rounding to whole parts and whole episodes makes of it.
            let longest = lengths.iter().max().unwrap();
            for part in &parts {
                let steps: i64 = part.iter().map(|&episode| lengths[episode]).sum();
                prop_assert!(steps <= budget + budget / 2 + 2 * longest + 1);
            }
        }
    }
}
