//! Random streams: the same seed is the same numbers, another seed is others.
#![allow(clippy::float_cmp, reason = "these numbers are compared to the last bit")]

use std::collections::HashSet;

use popgym_envs::deck::Deck;
use popgym_envs::rng::{below, uniform};
use popgym_envs::{Draws, Purpose, stream};

#[test]
fn streams_differ_in_each_of_their_four_parts() {
    let purposes = [
        Purpose::TrainEnv,
        Purpose::TrainAction,
        Purpose::EvalEnv,
        Purpose::EvalAction,
        Purpose::Shuffle,
        Purpose::Weights,
        Purpose::Resample,
    ];
    let mut seen = HashSet::new();
    for part in 0..3 {
        for value in 1..20 {
            let mut key = [0; 3];
            key[part] = value;
            for purpose in purposes {
                assert!(seen.insert(stream(key[0], key[1], key[2], purpose).uniform().to_bits()));
            }
        }
    }
}

/// Computed apart from this crate, from the definition of ChaCha8 with the key (1, 2, 3, purpose): these numbers must
/// never change, or old seeds would mean other episodes.
#[test]
fn the_streams_are_those_of_every_machine_and_version() {
    let mut rng = stream(1, 2, 3, Purpose::TrainEnv);
    let classes: Vec<u32> = (0..12).map(|_| below(&mut rng, 52)).collect();
    assert_eq!(classes, [20, 29, 20, 32, 28, 4, 31, 8, 17, 18, 29, 15]);
    assert_eq!(rng.uniform(), 0.336_251_805_441_117_44);
    assert_eq!(uniform(&mut rng, -2.0, 6.0), 5.249_761_857_865_084);
    let mut deck = Deck::new(1);
    deck.shuffle(&mut stream(1, 2, 3, Purpose::EvalEnv));
    assert_eq!(deck.cards()[..12], [46, 3, 34, 11, 49, 7, 14, 15, 40, 28, 32, 9]);
}

/// Computed apart from this crate too: 64 bits for the radius, 64 for the angle. Sines and
/// logarithms are the C library's, which may differ in the last bit.
#[test]
fn normal_numbers_are_those_of_every_version() {
    let mut rng = stream(1, 2, 3, Purpose::TrainEnv);
    for expected in [
        [0.081_421_000_132_952_53, -0.380_169_239_195_188_25],
        [-0.067_059_645_453_904_9, -0.112_145_693_089_145_49],
        [0.266_598_556_608_547_8, -0.084_639_756_653_552_57],
    ] {
        let found = rng.normal_pair(0.3);
        assert!((0..2).all(|i| (found[i] - expected[i]).abs() < 1e-14), "{found:?} is not {expected:?}");
    }
}

/// With so large an `n`, plain scaling would make each third number twice as likely as the others.
#[test]
fn below_has_no_bias() {
    const DRAWS: u32 = 30_000;
    let mut rng = stream(0, 0, 0, Purpose::Shuffle);
    let n = 3 << 30;
    let mut counts = [0; 3];
    for _ in 0..DRAWS {
        let drawn = below(&mut rng, n);
        assert!(drawn < n);
        counts[(drawn % 3) as usize] += 1;
    }
    // Binomial with p = 1/3: the standard deviation is 82.
    assert!(counts.iter().all(|&count: &i32| (count - 10_000).abs() < 410), "{counts:?}");
}

#[test]
fn normal_draws_have_the_right_moments() {
    const DRAWS: usize = 100_000;
    let mut rng = stream(0, 0, 1, Purpose::TrainEnv);
    let draws: Vec<f64> = (0..DRAWS).map(|_| rng.normal_pair(0.3)[0] / 0.3).collect();
    let moment = |power: i32| draws.iter().map(|x| x.powi(power)).sum::<f64>() / DRAWS as f64;
    // Five standard errors of each: the variances of x, x^2 and x^4 are 1, 2 and 96.
    for (power, expected, variance) in [(1, 0.0, 1.0_f64), (2, 1.0, 2.0), (4, 3.0, 96.0)] {
        let found = moment(power);
        assert!((found - expected).abs() < 5.0 * (variance / DRAWS as f64).sqrt(), "moment {power}: {found}");
    }
}

/// Each card is as often at each place.
#[test]
fn shuffles_are_uniform() {
    const SHUFFLES: usize = 26_000;
    let mut deck = Deck::new(1);
    let mut rng = stream(0, 0, 2, Purpose::TrainEnv);
    let mut counts = vec![[0_u32; 52]; 52];
    for _ in 0..SHUFFLES {
        deck.shuffle(&mut rng);
        for (place, &card) in deck.cards().iter().enumerate() {
            counts[usize::from(card)][place] += 1;
        }
    }
    let expected = (SHUFFLES / 52) as f64;
    for (card, places) in counts.iter().enumerate() {
        let chi2: f64 = places.iter().map(|&count| (f64::from(count) - expected).powi(2) / expected).sum();
        // 51 degrees of freedom: mean 51, standard deviation 10.
        assert!((15.0..115.0).contains(&chi2), "card {card}: {chi2}");
    }
}
