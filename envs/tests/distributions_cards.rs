//! What the card games and the bandits draw is distributed as it should be. All seeds are fixed; the bounds are those
//! that a right program passes with a probability of more than 0.999 each.

mod common;

use common::discrete;
use popgym_envs::multiarmed_bandit::{LEVELS, MultiarmedBandit};
use popgym_envs::{Env, Purpose, Registry, Slab, stream};
use serde_json::json;

/// Checks counts against what is expected of each: the sum of squared, scaled differences has a mean of `freedom` and a
/// variance of `2 freedom`, and is nearly normal once its cube root is taken (Wilson and Hilferty, 1931).
fn assert_chi_square(counts: &[f64], expected: &[f64], freedom: f64, what: &str) {
    assert_eq!(counts.len(), expected.len());
    let chi_square: f64 = counts.iter().zip(expected).map(|(found, mean)| (found - mean).powi(2) / mean).sum();
    let (mean, deviation) = (1.0 - 2.0 / (9.0 * freedom), (2.0 / (9.0 * freedom)).sqrt());
    let z = ((chi_square / freedom).cbrt() - mean) / deviation;
    assert!(z.abs() < 3.5, "{what}: chi-square {chi_square} of {freedom} degrees of freedom, z = {z}");
}

fn assert_uniform(counts: &[f64], what: &str) {
    let expected = counts.iter().sum::<f64>() / counts.len() as f64;
    assert_chi_square(counts, &vec![expected; counts.len()], counts.len() as f64 - 1.0, what);
}

/// Checks that the numbers are uniform in `[0, 1)`, after Kolmogorov and Smirnov.
fn assert_uniform_reals(mut numbers: Vec<f64>, what: &str) {
    numbers.sort_by(f64::total_cmp);
    let n = numbers.len() as f64;
    let distance = numbers.iter().enumerate().fold(0.0_f64, |most, (i, x)| {
        let i = i as f64;
        most.max(x - i / n).max((i + 1.0) / n - x)
    });
    // Exceeded with a probability of 2 exp(-2 * 2^2) = 0.0007.
    assert!(distance * n.sqrt() < 2.0, "{what}: distance {distance} of {n} numbers");
}

/// The discrete parts of the first `times` observations of `episodes` episodes, with actions that are always 0.
fn observed(name: &str, episodes: u64, times: usize) -> Vec<Vec<Vec<u8>>> {
    let mut env = Registry::standard().make(name).unwrap();
    let mut observation = Slab::new(&env.spec().observation, 1);
    (0..episodes)
        .map(|index| {
            let mut rng = stream(8, 0, index, Purpose::TrainEnv);
            env.draw_world(&mut rng);
            env.begin(&mut rng, observation.row_mut(0));
            let mut seen = vec![observation.discrete.clone()];
            while seen.len() < times {
                env.step(discrete(&[0]), &mut rng, observation.row_mut(0));
                seen.push(observation.discrete.clone());
            }
            seen
        })
        .collect()
}

/// Counts of pairs `(a, b)` with both in `0..classes`.
fn table(pairs: impl Iterator<Item = (u8, u8)>, classes: usize) -> Vec<f64> {
    let mut counts = vec![0.0; classes * classes];
    pairs.for_each(|(a, b)| counts[usize::from(a) * classes + usize::from(b)] += 1.0);
    counts
}

/// Two cards of `n`, drawn one after the other, of `classes` classes: how many of each pair of classes are expected.
fn two_cards(total: usize, n: f64, classes: usize) -> Vec<f64> {
    let each = n / classes as f64;
    (0..classes * classes)
        .map(|pair| {
            let others = if pair / classes == pair % classes { each - 1.0 } else { each };
            total as f64 * each / n * others / (n - 1.0)
        })
        .collect()
}

/// The first, the second and the last card have each class as often as the deck, and first and second, and first and
/// last, are two different cards.
#[test]
fn cards_are_dealt_evenly() {
    const EPISODES: usize = 8000;
    let cases = [
        ("AutoencodeEasy", 1, 52, 4),
        ("RepeatFirstEasy", 0, 52, 4),
        ("RepeatPreviousMedium", 0, 104, 4),
        ("HigherLowerEasy", 0, 52, 13),
        ("HigherLowerHard", 0, 156, 13),
        ("CountRecallEasy", 0, 52, 2),
        ("CountRecallEasy", 1, 52, 2),
        ("CountRecallMedium", 1, 104, 4),
        ("CountRecallHard", 0, 208, 13),
    ];
    for (name, component, n, classes) in cases {
        let episodes = observed(name, EPISODES as u64, n);
        let class = |episode: usize, time: usize| episodes[episode][time][component];
        for time in [0, 1, n / 2, n - 1] {
            let mut counts = vec![0.0; classes];
            (0..EPISODES).for_each(|episode| counts[usize::from(class(episode, time))] += 1.0);
            assert_uniform(&counts, name);
        }
        for (a, b) in [(0, 1), (0, n - 1), (n / 2, n / 2 + 1)] {
            let counts = table((0..EPISODES).map(|episode| (class(episode, a), class(episode, b))), classes);
            let freedom = (classes * classes) as f64 - 1.0;
            assert_chi_square(&counts, &two_cards(EPISODES, n as f64, classes), freedom, name);
        }
    }
}

/// The table of Concentration: each place has each class as often, and neighbours are two different cards.
#[test]
fn tables_are_laid_evenly() {
    const TABLES: usize = 8000;
    for (name, n, classes) in [("ConcentrationMedium", 104, 2), ("ConcentrationHard", 52, 13)] {
        let mut env = Registry::standard().make(name).unwrap();
        let mut state = Slab::new(&env.spec().state, 1);
        let mut observation = Slab::new(&env.spec().observation, 1);
        let tables: Vec<Vec<u8>> = (0..TABLES as u64)
            .map(|index| {
                let mut rng = stream(9, 0, index, Purpose::TrainEnv);
                env.draw_world(&mut rng);
                env.begin(&mut rng, observation.row_mut(0));
                env.state(state.row_mut(0));
                state.discrete[..n].to_vec()
            })
            .collect();
        for place in [0, 1, n / 3, n - 1] {
            let next = (place + 1) % n;
            let counts = table(tables.iter().map(|table| (table[place], table[next])), classes);
            let freedom = (classes * classes) as f64 - 1.0;
            assert_chi_square(&counts, &two_cards(TABLES, n as f64, classes), freedom, name);
        }
    }
}

/// Values and queries have nothing to do with each other, at the same time or one step apart.
#[test]
fn the_two_decks_are_independent() {
    const EPISODES: usize = 8000;
    for (name, classes) in [("CountRecallEasy", 2), ("CountRecallMedium", 4), ("CountRecallHard", 13)] {
        let episodes = observed(name, EPISODES as u64, 3);
        for (value, query) in [(0, 0), (1, 1), (1, 0), (0, 1), (2, 2)] {
            let pairs = episodes.iter().map(|seen| (seen[value][0], seen[query][1]));
            assert_uniform(&table(pairs, classes), name);
        }
    }
}

/// Payout probabilities of many bandits, by arm.
fn odds(level: usize, episodes: u64) -> Vec<Vec<f64>> {
    let mut env = MultiarmedBandit::new("game", LEVELS[level]);
    let mut arms = vec![Vec::new(); LEVELS[level].arms];
    for index in 0..episodes {
        env.draw_world(&mut stream(10, level as u64, index, Purpose::TrainEnv));
        let odds: Vec<f64> = serde_json::from_value(env.world()["payout_probability"].clone()).unwrap();
        odds.into_iter().zip(&mut arms).for_each(|(p, arm)| arm.push(p));
    }
    arms
}

#[test]
fn odds_are_uniform_and_independent() {
    for level in 0..3 {
        let arms = odds(level, 4000);
        for (i, arm) in arms.iter().enumerate() {
            assert!(arm.iter().all(|p| (0.0..1.0).contains(p)));
            assert_uniform_reals(arm.clone(), "odds of an arm");
            let other = &arms[(i + 1) % arms.len()];
            let tenth = |p: f64| (10.0 * p) as u8;
            let counts = table(arm.iter().zip(other).map(|(&p, &q)| (tenth(p), tenth(q))), 10);
            assert_uniform(&counts, "odds of two arms");
        }
    }
}

/// The best of `n` uniform numbers is `n / (n + 1)` on average: knowing the best arm returns `(n - 1) / (n + 1)`.
#[test]
fn the_best_arm_is_as_good_as_it_should_be() {
    for (level, figure) in [0.818, 0.905, 0.935].into_iter().enumerate() {
        const EPISODES: u64 = 4000;
        let arms = odds(level, EPISODES);
        let best = |episode: usize| arms.iter().map(|arm| arm[episode]).fold(0.0, f64::max);
        let mean = (0..EPISODES as usize).map(best).sum::<f64>() / EPISODES as f64;
        let n = arms.len() as f64;
        assert!((figure - (n - 1.0) / (n + 1.0)).abs() < 5e-4);
        let deviation = (n / ((n + 1.0).powi(2) * (n + 2.0))).sqrt();
        assert!((2.0 * mean - 1.0 - figure).abs() < 2.0 * 3.5 * deviation / (EPISODES as f64).sqrt() + 5e-4);
    }
}

/// Each arm pays as often as its probability says, and one payout says nothing of the next.
#[test]
fn payouts_are_binomial() {
    const EPISODES: u64 = 400;
    let odds = [0.0, 0.02, 0.25, 0.5, 0.5, 0.75, 0.9, 0.98, 0.999, 1.0];
    let mut env = MultiarmedBandit::new("game", LEVELS[0]);
    env.set_world(&json!({ "payout_probability": odds })).unwrap();
    let mut observation = Slab::new(&env.spec().observation, 1);
    for (arm, p) in odds.into_iter().enumerate() {
        let (mut sums, mut twice) = (Vec::new(), 0.0);
        for index in 0..EPISODES {
            let mut rng = stream(11, arm as u64, index, Purpose::TrainEnv);
            env.begin(&mut rng, observation.row_mut(0));
            let paid: Vec<u8> = (0..200)
                .map(|_| {
                    env.step(discrete(&[arm as u8]), &mut rng, observation.row_mut(0));
                    observation.discrete[0]
                })
                .collect();
            sums.push(paid.iter().map(|&paid| f64::from(paid)).sum::<f64>());
            twice += paid.windows(2).filter(|pair| pair[0] + pair[1] == 2).count() as f64;
        }
        let (episodes, mean, variance) = (EPISODES as f64, 200.0 * p, 200.0 * p * (1.0 - p));
        let found = sums.iter().sum::<f64>() / episodes;
        assert!((found - mean).abs() <= 3.5 * (variance / episodes).sqrt(), "arm {arm}: {found} is not {mean}");
        // The mean of squared differences has a relative error of the root of 2 / n, and some more for rare events.
        let squares = sums.iter().map(|sum| (sum - mean).powi(2)).sum::<f64>() / episodes;
        let error = variance * ((2.0 + 1.0 / variance.max(1e-9)) / episodes).sqrt();
        assert!((squares - variance).abs() <= 3.5 * error, "arm {arm}: variance {squares} is not {variance}");
        // Of successive pairs, which overlap.
        let pairs = 199.0 * episodes;
        let deviation = (pairs * p * p * (1.0 - p) * (1.0 + 3.0 * p)).sqrt();
        assert!((twice - pairs * p * p).abs() <= 3.5 * deviation, "arm {arm}: {twice} payouts after payouts");
    }
}
