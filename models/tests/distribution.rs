//! Distributions against closed forms in f64, and samples against probabilities.

use popgym_envs::{EpisodeRng, Purpose, Slab, Space, Value, stream};
use popgym_models::{ActionDistribution, Policy, PolicyOptions, PolicySpec, memory};
use tch::{Device, Kind, Tensor};

const UNBOUNDED: (f64, f64) = (f64::NEG_INFINITY, f64::INFINITY);

fn rng() -> EpisodeRng {
    stream(5, 6, 7, Purpose::EvalAction)
}

fn distribution(space: &Space) -> ActionDistribution {
    ActionDistribution::new(space, UNBOUNDED).unwrap()
}

/// A discrete pair and two reals, in an order that is not the order of storage.
fn mixed() -> Space {
    let real = || Space::uniform_box(1, -2.0, 2.0);
    Space::Tuple(vec![real(), Space::Discrete(3), real(), Space::MultiDiscrete(vec![2])])
}

const PARAMS: [f32; 9] = [0.5, -1.0, 2.0, 0.3, -0.7, 0.25, -1.5, -0.4, 0.6];
const OLD_PARAMS: [f32; 9] = [0.1, 0.4, 1.0, -0.3, 0.9, -0.5, -1.0, 0.2, -0.1];

fn softmax(logits: &[f32]) -> Vec<f64> {
    let total: f64 = logits.iter().map(|&x| f64::from(x).exp()).sum();
    logits.iter().map(|&x| f64::from(x).exp() / total).collect()
}

fn evaluate(
    distribution: &ActionDistribution,
    params: &[f32],
    old: &[f32],
    discrete: &[i64],
    real: &[f32],
) -> [f64; 3] {
    let row = |x: &[f32]| Tensor::from_slice(x).view([1, -1]);
    let discrete = Tensor::from_slice(discrete).view([1, -1]);
    let found = distribution.evaluate(&row(params), &row(old), &discrete, &row(real));
    [found.log_prob, found.entropy, found.kl].map(|x| x.double_value(&[0]))
}

fn assert_near(found: [f64; 3], expected: [f64; 3]) {
    for (name, (found, expected)) in ["log-probability", "entropy", "divergence"].iter().zip(found.iter().zip(expected))
    {
        assert!((found - expected).abs() <= 2e-6 * expected.abs().max(1.0), "{name} {found}, not {expected}");
    }
}

/// Log-probability, entropy, KL(old || new).
fn categorical(params: &[f32], old: &[f32], class: usize) -> [f64; 3] {
    let (p, old) = (softmax(params), softmax(old));
    let entropy: f64 = p.iter().map(|p| -p * p.ln()).sum();
    [p[class].ln(), entropy, old.iter().zip(&p).map(|(old, p)| old * (old / p).ln()).sum()]
}

fn gaussian([mean, log_std]: [f32; 2], [old_mean, old_log_std]: [f32; 2], x: f32) -> [f64; 3] {
    let [mean, log_std, old_mean, old_log_std, x] = [mean, log_std, old_mean, old_log_std, x].map(f64::from);
    let (variance, old_variance) = ((2.0 * log_std).exp(), (2.0 * old_log_std).exp());
    let tau = std::f64::consts::TAU;
    [
        -0.5 * ((x - mean).powi(2) / variance + (tau * variance).ln()),
        0.5 * (tau * std::f64::consts::E * variance).ln(),
        0.5 * ((old_variance + (old_mean - mean).powi(2)) / variance - 1.0 + (variance / old_variance).ln()),
    ]
}

fn sum(parts: &[[f64; 3]]) -> [f64; 3] {
    parts.iter().fold([0.0; 3], |sum, part| std::array::from_fn(|i| sum[i] + part[i]))
}

#[test]
fn quantities_are_the_closed_forms() {
    let one = distribution(&Space::Discrete(5));
    for class in 0..5 {
        let found = evaluate(&one, &PARAMS[..5], &OLD_PARAMS[..5], &[class], &[]);
        assert_near(found, categorical(&PARAMS[..5], &OLD_PARAMS[..5], class as usize));
    }
    let two = distribution(&Space::MultiDiscrete(vec![2, 3]));
    let parts = [categorical(&PARAMS[..2], &OLD_PARAMS[..2], 1), categorical(&PARAMS[2..5], &OLD_PARAMS[2..5], 0)];
    assert_near(evaluate(&two, &PARAMS[..5], &OLD_PARAMS[..5], &[1, 0], &[]), sum(&parts));
    let real = distribution(&Space::uniform_box(1, -2.0, 2.0));
    let (params, old) = ([0.25, -0.4], [-0.5, 0.2]);
    for x in [0.3, -4.0] {
        assert_near(evaluate(&real, &params, &old, &[], &[x]), gaussian(params, old, x));
    }
    // All logits, then the means, then the log standard deviations, whatever the order in the space.
    let all = distribution(&mixed());
    assert_eq!(all.width(), PARAMS.len());
    let at = |x: &[f32], i: usize| [x[5 + i], x[7 + i]];
    let parts = [
        categorical(&PARAMS[..3], &OLD_PARAMS[..3], 2),
        categorical(&PARAMS[3..5], &OLD_PARAMS[3..5], 0),
        gaussian(at(&PARAMS, 0), at(&OLD_PARAMS, 0), 1.1),
        gaussian(at(&PARAMS, 1), at(&OLD_PARAMS, 1), -0.9),
    ];
    assert_near(evaluate(&all, &PARAMS, &OLD_PARAMS, &[2, 0], &[1.1, -0.9]), sum(&parts));
}

#[test]
fn samples_score_what_evaluate_scores() {
    let (distribution, mut rng) = (distribution(&mixed()), rng());
    for log_std in [-0.4, -9.0, 3.0] {
        let mut params = PARAMS;
        params[7..].fill(log_std);
        for _ in 0..200 {
            let mut action = Slab::new(&distribution.stored_space(), 1);
            let log_prob = distribution.sample(&params, &mut rng, action.row_mut(0));
            let discrete: Vec<i64> = action.discrete.iter().map(|&class| i64::from(class)).collect();
            let [expected, ..] = evaluate(&distribution, &params, &params, &discrete, &action.real);
            assert!((f64::from(log_prob) - expected).abs() <= 3e-6 * expected.abs().max(1.0), "{log_prob}, {expected}");
        }
    }
}

#[test]
fn frequencies_are_the_probabilities() {
    const N: u32 = 40_000;
    let (distribution, mut rng) = (distribution(&mixed()), rng());
    let mut counts = [[0u32; 3]; 2];
    let mut moments = [[0.0; 2]; 2];
    let mut action = Slab::new(&distribution.stored_space(), 1);
    for _ in 0..N {
        distribution.sample(&PARAMS, &mut rng, action.row_mut(0));
        for i in 0..2 {
            counts[i][usize::from(action.discrete[i])] += 1;
            let noise = (f64::from(action.real[i]) - f64::from(PARAMS[5 + i])) / f64::from(PARAMS[7 + i]).exp();
            moments[i][0] += noise / f64::from(N);
            moments[i][1] += noise * noise / f64::from(N);
        }
    }
    let n = f64::from(N);
    for (counts, logits) in counts.iter().zip([&PARAMS[..3], &PARAMS[3..5]]) {
        for (&count, p) in counts.iter().zip(softmax(logits)) {
            assert!(
                (f64::from(count) / n - p).abs() <= 4.0 * (p * (1.0 - p) / n).sqrt(),
                "{count} of {N}, expected {p}"
            );
        }
    }
    for [mean, square] in moments {
        assert!(mean.abs() <= 4.0 / n.sqrt() && (square - 1.0).abs() <= 4.0 * (2.0 / n).sqrt(), "{mean} {square}");
    }
}

#[test]
fn impossible_classes_are_never_drawn() {
    let (distribution, mut rng) = (distribution(&Space::Discrete(4)), rng());
    let params = [f32::NEG_INFINITY, 300.0, 299.0, -1e30];
    let mut action = Slab::new(&distribution.stored_space(), 1);
    for _ in 0..1_000 {
        let log_prob = distribution.sample(&params, &mut rng, action.row_mut(0));
        assert!([1, 2].contains(&action.discrete[0]) && log_prob.is_finite());
    }
}

#[test]
fn the_environment_gets_a_mapped_and_clipped_action() {
    let bounds = |low: &[f32], high: &[f32]| Space::Box { low: low.to_vec(), high: high.to_vec() };
    let space = bounds(&[-2.0, 0.0, f32::NEG_INFINITY], &[2.0, 10.0, 1.0]);
    let table = [
        ([0.0, 0.0, 0.0], [0.0, 5.0, 0.0]),
        ([0.5, 0.5, -7.0], [1.0, 7.5, -7.0]),
        ([-1.0, 1.0, 1.5], [-2.0, 10.0, 1.0]),
        ([9.0, -9.0, 3e38], [2.0, 0.0, 1.0]),
    ];
    for (stored, expected) in table {
        let mut out = Slab::new(&space, 1);
        distribution(&space).to_env(Value { discrete: &[], real: &stored }, out.row_mut(0));
        assert_eq!(out.real, expected);
        space.check(out.row(0)).unwrap();
    }
}

#[test]
fn log_standard_deviations_are_kept_within_bounds() {
    for (low, high) in [(-0.5, 0.25), UNBOUNDED] {
        let spec = PolicySpec {
            observation: Space::Discrete(2),
            action: Space::Tuple(vec![Space::Discrete(3), Space::uniform_box(2, -1.0, 1.0)]),
            memory: "mlp".to_owned(),
            memory_options: toml::Table::new(),
            options: PolicyOptions { log_std_min: low, log_std_max: high },
            max_steps: 10,
        };
        let policy = Policy::new(&spec, &memory::Registry::standard(), Device::Cpu).unwrap();
        // Logits, means, log standard deviations: what the head says at zero weights.
        let bias = Tensor::from_slice(&[4.0f32, -4.0, 3.0, 2.0, -2.0, -6.0, 6.0]);
        tch::no_grad(|| {
            let get = |part: &str| policy.parameters()[&format!("actor.output.{part}")].shallow_clone();
            let _ = get("weight").zero_();
            get("bias").copy_(&bias);
        });
        let x = Tensor::zeros([1, policy.encoder().width() as i64], (Kind::Float, Device::Cpu));
        let (params, _) = policy.act(&x, &policy.initial_state(1));
        let expected = [4.0, -4.0, 3.0, 2.0, -2.0, (-6.0f32).max(low as f32), 6.0f32.min(high as f32)];
        assert_eq!(Vec::<f32>::try_from(params.view(-1)).unwrap(), expected);
    }
    let spec = |min, max| PolicySpec {
        observation: Space::Discrete(2),
        action: Space::Discrete(2),
        memory: "mlp".to_owned(),
        memory_options: toml::Table::new(),
        options: PolicyOptions { log_std_min: min, log_std_max: max },
        max_steps: 10,
    };
    let (none, inf) = (f64::NEG_INFINITY, f64::INFINITY);
    for (min, max) in
        [(1.0, 0.0), (f64::NAN, 0.0), (0.0, f64::NAN), (inf, inf), (none, none), (none, -200.0), (800.0, inf)]
    {
        assert!(Policy::new(&spec(min, max), &memory::Registry::standard(), Device::Cpu).is_err());
    }
}

#[test]
fn a_space_without_components_is_refused() {
    assert!(ActionDistribution::new(&Space::Tuple(Vec::new()), UNBOUNDED).is_err());
}

#[test]
fn marginals_are_the_closed_forms() {
    let mixed = distribution(&mixed());
    let marginals = mixed.marginals(&PARAMS);
    for (found, expected) in marginals.classes.iter().zip([softmax(&PARAMS[..3]), softmax(&PARAMS[3..5])]) {
        assert_eq!(found.len(), expected.len());
        assert!(found.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-12), "{found:?}, not {expected:?}");
        assert!((found.iter().sum::<f64>() - 1.0).abs() < 1e-12);
    }
    // The space is -2 to 2, so a stored 1 is the environment's 2; the log standard deviations are -0.4 and 0.6.
    for ((mean, std), (stored, log_std)) in marginals.reals.iter().zip([(0.25, -0.4_f64), (-1.5, 0.6)]) {
        assert!((mean - 2.0 * stored).abs() < 1e-6 && (std - 2.0 * log_std.exp()).abs() < 1e-6, "{mean} {std}");
    }
    let [_, entropy, _] = evaluate(&mixed, &PARAMS, &PARAMS, &[0, 0], &[0.0, 0.0]);
    assert!((marginals.entropy - entropy).abs() < 1e-5, "{} is not {entropy}", marginals.entropy);
    // An unbounded real is not mapped; a class that is impossible adds nothing to the entropy.
    let unbounded = distribution(&Space::uniform_box(1, f32::NEG_INFINITY, f32::INFINITY));
    assert_eq!(unbounded.marginals(&[3.0, 0.0]).reals, [(3.0, 1.0)]);
    let certain = distribution(&Space::Discrete(2)).marginals(&[0.0, -1e9]);
    assert_eq!((certain.classes, certain.entropy), (vec![vec![1.0, 0.0]], 0.0));
}

#[test]
fn the_mode_is_the_likeliest_class_and_the_mean() {
    let mixed = distribution(&mixed());
    let mut action = Slab::new(&mixed.stored_space(), 1);
    mixed.mode(&PARAMS, action.row_mut(0));
    assert_eq!((&action.discrete[..], &action.real[..]), (&[2, 0][..], &[0.25, -1.5][..]));
    // The first of equals.
    let mut class = [9];
    distribution(&Space::Discrete(3))
        .mode(&[1.0, 1.0, 0.0], popgym_envs::ValueMut { discrete: &mut class, real: &mut [] });
    assert_eq!(class, [0]);
}
