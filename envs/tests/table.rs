//! The benchmark's figures, one row an environment, measured on the Python package.
#![allow(clippy::float_cmp, reason = "these numbers are compared to the last bit")]

mod common;

use std::collections::HashSet;

use common::play_randomly;
use popgym_envs::{Env, Purpose, Registry, Slab, Space, stream};

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
/// The goal is a step away at best.
const ESCAPE: (f64, f64) = (-1023.0 / 1024.0, 1023.0 / 1024.0);
const EXPLORE: (f64, f64) = (-1023.0 / 1024.0, 1.0);

/// Uniform answers are right once in `answers` times.
const fn one_of(answers: f64) -> (f64, f64) {
    (2.0 / answers - 1.0, 0.0)
}

/// Each of `n` cards but the last pays at most `1 / n`.
const fn within(cards: f64) -> (f64, f64) {
    (1.0 / cards - 1.0, (cards - 1.0) / cards)
}

// For cart-pole no standard error was published: taken are those of 400 episodes, the fewest that were averaged.
const TABLE: &[Row] = &[
    row("AutoencodeEasy", (103, true), 12, UNIT, (-0.5, 0.0)),
    row("AutoencodeMedium", (207, true), 12, UNIT, (-0.5, 0.0)),
    row("AutoencodeHard", (311, true), 12, UNIT, (-0.5, 0.0)),
    row("CountRecallEasy", (51, true), 33, UNIT, one_of(27.0)),
    row("CountRecallMedium", (103, true), 37, UNIT, one_of(27.0)),
    row("CountRecallHard", (207, true), 45, UNIT, one_of(17.0)),
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
    // Dynamics, rewards and lengths of the position-only cart-pole, and so its random return.
    row("VelocityOnlyCartPoleEasy", (200, false), 6, FROM_ZERO, (0.111, 0.003)),
    row("VelocityOnlyCartPoleMedium", (400, false), 6, FROM_ZERO, (0.056, 0.0015)),
    row("VelocityOnlyCartPoleHard", (600, false), 6, FROM_ZERO, (0.037, 0.001)),
    row("NoisyPositionOnlyCartPoleEasy", (200, false), 6, FROM_ZERO, (0.1105, 0.003)),
    row("NoisyPositionOnlyCartPoleMedium", (200, false), 6, FROM_ZERO, (0.1105, 0.003)),
    row("NoisyPositionOnlyCartPoleHard", (200, false), 6, FROM_ZERO, (0.1105, 0.003)),
    row("NoisyPositionOnlyPendulumEasy", (200, true), 5, UNIT, (0.237, 0.007)),
    row("NoisyPositionOnlyPendulumMedium", (200, true), 5, UNIT, (0.237, 0.007)),
    row("NoisyPositionOnlyPendulumHard", (200, true), 5, UNIT, (0.237, 0.007)),
    row("BattleshipEasy", (64, false), 20, (-1.231, 1.0), (-0.449, 0.003)),
    row("BattleshipMedium", (100, false), 24, (-1.136, 1.0), (-0.414, 0.003)),
    row("BattleshipHard", (144, false), 28, (-1.091, 1.0), (-0.400, 0.003)),
    row("MineSweeperEasy", (14, false), 13, UNIT, (-0.236, 0.006)),
    row("MineSweeperMedium", (30, false), 21, UNIT, (-0.403, 0.002)),
    row("MineSweeperHard", (54, false), 28, UNIT, (-0.433, 0.0015)),
    row("LabyrinthEscapeEasy", (1023, false), 56, ESCAPE, (-0.392, 0.017)),
    row("LabyrinthEscapeMedium", (1023, false), 56, ESCAPE, (-0.828, 0.010)),
    row("LabyrinthEscapeHard", (1023, false), 56, ESCAPE, (-0.964, 0.005)),
    row("LabyrinthExploreEasy", (1023, false), 56, EXPLORE, (-0.360, 0.0055)),
    row("LabyrinthExploreMedium", (1023, false), 56, EXPLORE, (-0.614, 0.003)),
    row("LabyrinthExploreHard", (1023, false), 56, EXPLORE, (-0.739, 0.003)),
    row("MultiarmedBanditEasy", (200, true), 14, UNIT, (0.0, 0.0)),
    row("MultiarmedBanditMedium", (400, true), 24, UNIT, (0.0, 0.0)),
    row("MultiarmedBanditHard", (600, true), 34, UNIT, (0.0, 0.0)),
    row("ConcentrationEasy", (104, false), 210, UNIT, (-0.194, 0.002)),
    row("ConcentrationMedium", (208, false), 418, UNIT, (-0.184, 0.002)),
    row("ConcentrationHard", (104, false), 782, UNIT, (-0.835, 0.002)),
    row("HigherLowerEasy", (51, true), 17, within(52.0), (0.0, 0.0)),
    row("HigherLowerMedium", (103, true), 17, within(104.0), (0.0, 0.0)),
    row("HigherLowerHard", (155, true), 17, within(156.0), (0.0, 0.0)),
];

#[test]
fn specs_are_those_of_the_table() {
    let registry = Registry::standard();
    for expected in TABLE {
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

/// Length and return of an episode of uniformly random actions. Nothing else is looked at: these are millions of steps.
fn random_episode(env: &mut dyn Env, index: u64) -> (u32, f64) {
    let space = env.spec().action.clone();
    let (mut observation, mut action) = (Slab::new(&env.spec().observation, 1), Slab::new(&space, 1));
    let [mut rng, mut policy] = [Purpose::EvalEnv, Purpose::EvalAction].map(|purpose| stream(1, 0, index, purpose));
    env.draw_world(&mut rng);
    env.begin(&mut rng, observation.row_mut(0));
    let (mut steps, mut total) = (0, 0.0);
    loop {
        space.sample_into(&mut policy, action.row_mut(0));
        let step = env.step(action.row(0), &mut rng, observation.row_mut(0));
        steps += 1;
        total += step.reward;
        if step.done() {
            return (steps, total);
        }
    }
}

#[test]
fn the_random_policy_returns_what_it_should() {
    const EPISODES: u64 = 4000;
    let registry = Registry::standard();
    for expected in TABLE {
        let mut env = registry.make(expected.name).unwrap();
        let range = env.spec().return_range;
        let (mut sum, mut squares) = (0.0, 0.0);
        for index in 0..EPISODES {
            let (steps, total) = random_episode(env.as_mut(), index);
            assert!(if expected.exact { steps == expected.max_steps } else { steps <= expected.max_steps });
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
