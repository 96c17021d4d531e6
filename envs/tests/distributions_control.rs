//! What the control tasks draw: first states, and noise on observations. Seeds are fixed.

mod common;

use std::f64::consts::PI;

use common::play_randomly;
use popgym_envs::{Draws, Env, Leaf, Purpose, Registry, stream};

/// `P(Z < x)` of a standard normal number (Marsaglia, "Evaluating the Normal Distribution", 2004).
fn normal_cdf(x: f64) -> f64 {
    if x.abs() > 8.0 {
        return f64::from(u8::from(x > 0.0));
    }
    let (mut term, mut sum, mut odd) = (x, x, 1.0);
    while term.abs() > 1e-17 * sum.abs() {
        odd += 2.0;
        term *= x * x / odd;
        sum += term;
    }
    0.5 + sum * (-0.5 * x * x).exp() / (2.0 * PI).sqrt()
}

#[test]
fn normal_cdf_is_that_of_the_tables() {
    for (x, p) in [(0.0, 0.5), (1.0, 0.841_344_746), (-1.96, 0.024_997_895), (3.0, 0.998_650_102)] {
        assert!((normal_cdf(x) - p).abs() < 1e-9, "{x}");
    }
}

/// The statistic of Kolmogorov and Smirnov against uniform on `[0, 1]`, times the root of the number of samples: one in
/// a thousand is above 1.95.
fn assert_uniform(mut samples: Vec<f64>, what: &str) {
    samples.sort_by(f64::total_cmp);
    let n = samples.len() as f64;
    let distance = samples
        .iter()
        .enumerate()
        .fold(0.0_f64, |most, (i, &x)| most.max((x - i as f64 / n).abs()).max((x - (i as f64 + 1.0) / n).abs()));
    let statistic = distance * n.sqrt();
    assert!(samples.len() > 1000 && statistic < 1.95, "{what}: {statistic} of {n} samples");
}

/// Pearson's chi-square on a grid of 6 x 6, of pairs uniform on the unit square: 35 degrees of freedom, one in a thousand
/// is above 66.6.
fn assert_independent(pairs: &[(f64, f64)], what: &str) {
    const SIDE: usize = 6;
    let mut counts = [0.0; SIDE * SIDE];
    let cell = |x: f64| ((x * SIDE as f64) as usize).min(SIDE - 1);
    for &(a, b) in pairs {
        counts[cell(a) * SIDE + cell(b)] += 1.0;
    }
    let expected = pairs.len() as f64 / counts.len() as f64;
    let chi2: f64 = counts.iter().map(|count: &f64| (count - expected).powi(2) / expected).sum();
    assert!(expected > 20.0 && chi2 < 66.6, "{what}: {chi2} of {} pairs", pairs.len());
}

/// First states of 8000 episodes, each number scaled from its range to `[0, 1)`.
fn first_states(name: &str, ranges: &[(f64, f64)]) -> Vec<Vec<f64>> {
    let mut env = Registry::standard().make(name).unwrap();
    (0..8000)
        .map(|index| {
            env.draw_world(&mut stream(11, 0, index, Purpose::TrainEnv));
            let world = env.world();
            let numbers: Vec<f64> = match world.get("state") {
                Some(state) => state.as_array().unwrap().iter().map(|part| part.as_f64().unwrap()).collect(),
                None => ["theta", "theta_dot"].map(|key| world[key].as_f64().unwrap()).to_vec(),
            };
            assert_eq!(numbers.len(), ranges.len());
            numbers.iter().zip(ranges).map(|(x, (low, high))| (x - low) / (high - low)).collect()
        })
        .collect()
}

#[test]
fn first_states_are_uniform_and_independent() {
    let (cart, rod) = ([(-0.05, 0.05); 4], [(-PI, PI), (-1.0, 1.0)]);
    for (name, ranges) in [
        ("PositionOnlyCartPoleEasy", &cart[..]),
        ("VelocityOnlyCartPoleMedium", &cart),
        ("NoisyPositionOnlyCartPoleHard", &cart),
        ("PositionOnlyPendulumEasy", &rod),
        ("NoisyPositionOnlyPendulumHard", &rod),
    ] {
        let states = first_states(name, ranges);
        assert!(states.iter().flatten().all(|x| (0.0..1.0).contains(x)), "{name}");
        for i in 0..ranges.len() {
            assert_uniform(states.iter().map(|state| state[i]).collect(), &format!("{name}, number {i}"));
            for j in 0..i {
                let pairs: Vec<_> = states.iter().map(|state| (state[i], state[j])).collect();
                assert_independent(&pairs, &format!("{name}, numbers {i} and {j}"));
            }
        }
        let after: Vec<_> = states.windows(2).map(|pair| (pair[0][0], pair[1][0])).collect();
        assert_independent(&after, &format!("{name}, one episode and the next"));
    }
}

/// The noise of one number of an observation.
#[derive(Clone, Copy)]
struct Noise {
    /// Where it lies between the clips, as a quantile; none if it was clipped.
    quantile: Option<f64>,
    /// How likely it was to be clipped.
    clip: f64,
}

/// The noise of every observation of random episodes: `[episode][time][number]`.
fn noise(name: &str, episodes: u64, sigma: f64) -> Vec<Vec<[Noise; 2]>> {
    let mut env = Registry::standard().make(name).unwrap();
    // Of the hidden state, where the clean observation is.
    let clean_at = if name.contains("CartPole") { [0, 2] } else { [0, 1] };
    let limits: Vec<(f32, f32)> = (env.spec().observation.leaves().iter())
        .map(|leaf| if let Leaf::Real { low, high } = *leaf { (low, high) } else { panic!("{leaf:?}") })
        .collect();
    (0..episodes)
        .map(|index| {
            let episode = play_randomly(env.as_mut(), 12, index);
            (0..=episode.steps.len())
                .map(|t| {
                    [0, 1].map(|i| {
                        let (seen, clean) =
                            (episode.observations.row(t).real[i], episode.states.row(t).real[clean_at[i]]);
                        let p = |to: f32| normal_cdf((f64::from(to) - f64::from(clean)) / sigma);
                        let (low, high) = limits[i];
                        let inside = low < seen && seen < high;
                        let quantile = inside.then(|| (p(seen) - p(low)) / (p(high) - p(low)));
                        Noise { quantile, clip: 1.0 - p(high) + p(low) }
                    })
                })
                .collect()
        })
        .collect()
}

#[test]
fn noise_is_normal_independent_and_clipped() {
    for (class, episodes) in [("NoisyPositionOnlyCartPole", 400), ("NoisyPositionOnlyPendulum", 40)] {
        for (level, sigma) in [("Easy", 0.1), ("Medium", 0.2), ("Hard", 0.3)] {
            let name = format!("{class}{level}");
            let noise = noise(&name, episodes, sigma);
            let all: Vec<[Noise; 2]> = noise.concat();
            for i in 0..2 {
                // Every observation has its noise, the first of an episode too.
                let quantiles = all.iter().filter_map(|both| both[i].quantile).collect();
                assert_uniform(quantiles, &format!("{name}, number {i}"));
                let (mut clipped, mut expected, mut variance) = (0.0, 0.0, 0.0);
                for Noise { quantile, clip } in all.iter().map(|both| both[i]) {
                    clipped += f64::from(u8::from(quantile.is_none()));
                    expected += clip;
                    variance += clip * (1.0 - clip);
                }
                let error = (clipped - expected) / f64::sqrt(variance).max(1.0);
                assert!(error.abs() < 4.0, "{name}, number {i}: {clipped} clipped, expected {expected}");

                let steps: Vec<_> = (noise.iter())
                    .flat_map(|episode| episode.windows(2))
                    .filter_map(|pair| pair[0][i].quantile.zip(pair[1][i].quantile))
                    .collect();
                assert_independent(&steps, &format!("{name}, number {i}, one step and the next"));
            }
            let both: Vec<_> = all.iter().filter_map(|both| both[0].quantile.zip(both[1].quantile)).collect();
            assert_independent(&both, &format!("{name}, both numbers"));
        }
    }
    // An angle of a standing pole is often clipped at this noise, a position never.
    let hard = noise("NoisyPositionOnlyCartPoleHard", 100, 0.3).concat();
    assert!(hard.iter().all(|both| both[0].quantile.is_some()) && hard.iter().any(|both| both[1].quantile.is_none()));
}

/// First observations alone: their noise follows the draws of the world.
#[test]
fn first_observations_are_noisy_too() {
    let noise = noise("NoisyPositionOnlyCartPoleMedium", 1500, 0.2);
    assert_uniform(noise.iter().map(|episode| episode[0][0].quantile.unwrap()).collect(), "first noise");
}

#[test]
fn normal_pairs_are_normal_in_every_direction() {
    let mut rng = stream(13, 0, 0, Purpose::TrainEnv);
    let pairs: Vec<[f64; 2]> = (0..40_000).map(|_| rng.normal_pair(0.5).map(|x| x / 0.5)).collect();
    let cdf = |number: &dyn Fn(&[f64; 2]) -> f64| pairs.iter().map(|pair| normal_cdf(number(pair))).collect::<Vec<_>>();
    let diagonal = 0.5_f64.sqrt();
    let (x, y) = (cdf(&|pair| pair[0]), cdf(&|pair| pair[1]));
    assert_uniform(cdf(&|pair| (pair[0] + pair[1]) * diagonal), "x + y");
    assert_uniform(cdf(&|pair| (pair[0] - pair[1]) * diagonal), "x - y");
    assert_independent(&x.iter().copied().zip(y.iter().copied()).collect::<Vec<_>>(), "x and y");
    assert_independent(&y.iter().copied().zip(x[1..].iter().copied()).collect::<Vec<_>>(), "y and the next x");
    assert_uniform(x, "x");
    assert_uniform(y, "y");
    // Angles fill the circle evenly, and do not go with radii.
    let polar: Vec<_> =
        (pairs.iter()).map(|[x, y]| (y.atan2(*x) / (2.0 * PI) + 0.5, 1.0 - (-0.5 * (x * x + y * y)).exp())).collect();
    assert_uniform(polar.iter().map(|pair| pair.0).collect(), "angles");
    assert_uniform(polar.iter().map(|pair| pair.1).collect(), "radii");
    assert_independent(&polar, "angles and radii");
}
