//! The benchmark's figures, one row an environment, measured on the Python package.
#![allow(clippy::float_cmp, reason = "these numbers are compared to the last bit")]

mod common;

use std::collections::HashSet;

use common::play_randomly;
use popgym_envs::{Registry, Space};

/// One environment as the Python package has it.
struct Row {
    name: &'static str,
    max_steps: u32,
    /// Every episode has `max_steps` steps.
    exact: bool,
    /// Width of observation, previous action and first-step flag as the paper's agents see them.
    flat: usize,
    /// Smallest and largest return.
    bounds: (f64, f64),
    /// Mean return of uniformly random actions, and its standard error (0: a theorem).
    random: (f64, f64),
}

const fn row(
    name: &'static str,
    (max_steps, exact): (u32, bool),
    flat: usize,
    bounds: (f64, f64),
    random: (f64, f64),
) -> Row {
    Row { name, max_steps, exact, flat, bounds, random }
}

const UNIT: (f64, f64) = (-1.0, 1.0);
const FROM_ZERO: (f64, f64) = (0.0, 1.0);

// For cart-pole no standard error was published: taken are those of 400 episodes, the fewest that were averaged.
const TABLE: [Row; 15] = [
    row("RepeatFirstEasy", (51, true), 10, UNIT, (-0.5, 0.0)),
    row("RepeatFirstMedium", (415, true), 10, UNIT, (-0.5, 0.0)),
    row("RepeatFirstHard", (831, true), 10, UNIT, (-0.5, 0.0)),
    row("RepeatPreviousEasy", (51, true), 10, UNIT, (-0.5, 0.0)),
    row("RepeatPreviousMedium", (103, true), 10, UNIT, (-0.5, 0.0)),
    row("RepeatPreviousHard", (155, true), 10, UNIT, (-0.5, 0.0)),
    row("PositionOnlyCartPoleEasy", (200, false), 6, FROM_ZERO, (0.111, 0.003)),
    row("PositionOnlyCartPoleMedium", (400, false), 6, FROM_ZERO, (0.056, 0.0015)),
    row("PositionOnlyCartPoleHard", (600, false), 6, FROM_ZERO, (0.037, 0.001)),
    row("PositionOnlyPendulumEasy", (200, true), 5, UNIT, (0.242, 0.006)),
    row("PositionOnlyPendulumMedium", (150, true), 5, UNIT, (0.243, 0.006)),
    row("PositionOnlyPendulumHard", (100, true), 5, UNIT, (0.243, 0.006)),
    row("BattleshipEasy", (64, false), 20, (-1.231, 1.0), (-0.449, 0.003)),
    row("BattleshipMedium", (100, false), 24, (-1.136, 1.0), (-0.414, 0.003)),
    row("BattleshipHard", (144, false), 28, (-1.091, 1.0), (-0.400, 0.003)),
];

#[test]
fn specs_are_those_of_the_table() {
    let registry = Registry::standard();
    for expected in &TABLE {
        let spec = registry.make(expected.name).unwrap().spec().clone();
        assert_eq!(spec.max_steps, expected.max_steps, "{}", spec.id);
        let seen = Space::Tuple(vec![spec.observation, spec.action, Space::Discrete(2)]);
        assert_eq!(seen.flat_width(), expected.flat, "{}", spec.id);
        assert!((spec.return_range.0 - expected.bounds.0).abs() < 6e-4, "{}", spec.id);
        assert_eq!(spec.return_range.1, expected.bounds.1, "{}", spec.id);
    }
    let named: HashSet<&str> = TABLE.iter().map(|row| row.name).collect();
    assert!(registry.iter().all(|entry| named.contains(entry.name.as_str())), "the table leaves one out");
}

#[test]
fn the_random_policy_returns_what_it_should() {
    const EPISODES: u64 = 4000;
    let registry = Registry::standard();
    for expected in &TABLE {
        let mut env = registry.make(expected.name).unwrap();
        let range = env.spec().return_range;
        let (mut sum, mut squares) = (0.0, 0.0);
        for index in 0..EPISODES {
            let episode = play_randomly(env.as_mut(), 0, index);
            let steps = episode.steps.len() as u32;
            assert!(if expected.exact { steps == expected.max_steps } else { steps <= expected.max_steps });
            let total = episode.total();
            assert!(range.0 - 1e-9 <= total && total <= range.1 + 1e-9, "{}: {total}", expected.name);
            sum += total;
            squares += total * total;
        }
        let n = EPISODES as f64;
        let (mean, (figure, published)) = (sum / n, expected.random);
        let variance = (squares / n - mean * mean) / n;
        let error = (variance + published * published).sqrt();
        println!("{:<28} {mean:+.4} +- {:.4}, expected {figure:+.4}", expected.name, variance.sqrt());
        assert!((mean - figure).abs() <= 4.0 * error, "{}: {mean} is not {figure}", expected.name);
    }
}

/// Published beside the table: random episodes last 22.2 steps on average, and never less than 8.
#[test]
fn random_cart_pole_episodes_have_the_right_length() {
    let mut env = Registry::standard().make("StatelessCartPoleEasy").unwrap();
    let lengths: Vec<usize> = (0..4000).map(|index| play_randomly(env.as_mut(), 1, index).steps.len()).collect();
    let mean = lengths.iter().sum::<usize>() as f64 / lengths.len() as f64;
    // The standard deviation is close to 12, and 400 episodes or more were averaged.
    assert!((mean - 22.2).abs() < 4.0 * 12.0 * (1.0 / 400.0 + 1.0 / 4000.0_f64).sqrt(), "{mean}");
    assert!((8..=9).contains(lengths.iter().min().unwrap()), "{:?}", lengths.iter().min());
}

/// Never repeating a shot returns 1/13 on every board: hits are worth 1, and the misses before the last hit 12/13.
#[test]
fn shooting_each_cell_once_returns_one_thirteenth() {
    const EPISODES: u64 = 4000;
    for name in ["BattleshipEasy", "BattleshipMedium", "BattleshipHard"] {
        let mut env = Registry::standard().make(name).unwrap();
        let Space::MultiDiscrete(sides) = env.spec().action.clone() else { panic!("{name}") };
        let n = sides[0] as usize;
        let returns: Vec<f64> = (0..EPISODES)
            .map(|index| {
                let mut rng = popgym_envs::stream(2, 0, index, popgym_envs::Purpose::EvalAction);
                let mut cells: Vec<usize> = (0..n * n).collect();
                let episode = common::play_drawn(env.as_mut(), 2, index, |t, _, action| {
                    let pick = t + popgym_envs::rng::below(&mut rng, (n * n - t) as u32) as usize;
                    cells.swap(t, pick);
                    action.set(0, common::discrete(&[(cells[t] / n) as u8, (cells[t] % n) as u8]));
                });
                episode.total()
            })
            .collect();
        let count = EPISODES as f64;
        let mean = returns.iter().sum::<f64>() / count;
        let error = (returns.iter().map(|x| (x - mean).powi(2)).sum::<f64>()).sqrt() / count;
        assert!((mean - 1.0 / 13.0).abs() < 4.0 * error, "{name}: {mean} +- {error}");
    }
}
