//! The outer model: sizes, first weights, rows that do not influence each other, weights as files.

mod common;

use std::collections::BTreeMap;

use common::*;
use popgym_envs::Space;
use popgym_models::{Policy, WeightsError};
use safetensors::tensor::{Dtype, SafeTensors, TensorView, serialize};
use tch::{Kind, Tensor};

fn small(memory: &str) -> Policy {
    policy(memory, Space::Discrete(4), Space::MultiDiscrete(vec![3, 4]))
}

#[test]
fn parameters_outside_the_memory_are_counted_by_the_reference() {
    for name in names() {
        for (observation, action, d, n) in [
            (Space::Discrete(4), Space::Discrete(4), 10, 4),
            (Space::Discrete(2), Space::MultiDiscrete(vec![8, 8]), 20, 16),
            (Space::uniform_box(2, -1.0, 1.0), Space::uniform_box(1, -2.0, 2.0), 5, 2),
        ] {
            let policy = policy(name, observation, action);
            let outer = policy.parameters().iter().filter(|(name, _)| !name.starts_with("memory."));
            // Reference 4.1; upstream has the weight of the positional encoding even where nothing reads it.
            let positional = ["pos_mlp", "fart", "fwp", "frame_stack", "tcn"].contains(&name);
            let expected = 115_585 + i64::from(positional) + 128 * d + 129 * n;
            assert_eq!(outer.map(|(_, tensor)| tensor.numel()).sum::<usize>() as i64, expected, "{name}");
        }
    }
}

#[test]
fn first_weights_are_as_listed() {
    let policy = policy("gru", Space::Discrete(4), Space::MultiDiscrete(vec![60, 60]));
    let parameters = policy.parameters();
    for layer in ["projection", "preprocessor", "actor.first", "actor.second", "critic.first", "critic.second"] {
        let weight = &parameters[&format!("{layer}.weight")];
        let [rows, columns] = weight.size()[..] else { panic!() };
        let product = if rows <= columns { weight.matmul(&weight.tr()) } else { weight.tr().matmul(weight) };
        assert_close(&product, &Tensor::eye(rows.min(columns), FLOAT), 1e-5, layer);
    }
    for layer in ["actor.output", "critic.output"] {
        let weight = &parameters[&format!("{layer}.weight")];
        // Five standard errors.
        let error = 5.0 / (weight.numel() as f64).sqrt();
        let deviation = weight.square().mean(Kind::Double).sqrt().double_value(&[]);
        assert!((deviation / 0.01 - 1.0).abs() <= error, "{layer}: {deviation}");
        assert!((weight.mean(Kind::Double).double_value(&[]) / 0.01).abs() <= error, "{layer}");
    }
    for (name, tensor) in parameters {
        let (prefix, last) = name.rsplit_once('.').unwrap();
        let fan_in = match prefix {
            "memory" => 256,
            _ if last == "bias" => parameters[&format!("{prefix}.weight")].size()[1],
            _ => continue,
        };
        let (bound, largest) = (1.0 / (fan_in as f64).sqrt(), largest(tensor));
        // A uniform one of more than a few numbers comes close to its bound.
        let least = if tensor.numel() > 50 { 0.8 * bound } else { 0.0 };
        assert!(largest > least && largest <= bound * (1.0 + 1e-6), "{name}: {largest}, bound {bound}");
    }
}

/// With W1 the identity and no bias, z is the leaky projection, whose own mean and variance can be undone.
#[test]
fn the_projection_is_normalised() {
    let policy = policy("mlp", Space::uniform_box(3, -9.0, 9.0), Space::Discrete(3));
    let x = random(40, policy.encoder().width() as i64) * 7.0;
    let set = |name: &str, value: &Tensor| tch::no_grad(|| policy.parameters()[name].shallow_clone().copy_(value));
    set("preprocessor.weight", &Tensor::eye(128, FLOAT));
    set("preprocessor.bias", &Tensor::zeros([128], FLOAT));
    // The memory's first layer reads the identity and the second hands it on; + 10 keeps the leaky parts linear.
    set("memory.first.weight", &Tensor::eye_m(256, 128, FLOAT));
    set("memory.first.bias", &Tensor::full([256], 10.0, FLOAT));
    set("memory.second.weight", &Tensor::eye(256, FLOAT));
    set("memory.second.bias", &Tensor::zeros([256], FLOAT));
    set("critic.first.weight", &Tensor::eye_m(128, 256, FLOAT));
    set("critic.first.bias", &Tensor::zeros([128], FLOAT));
    set("critic.second.weight", &Tensor::eye(128, FLOAT));
    set("critic.second.bias", &Tensor::zeros([128], FLOAT));
    set("critic.output.bias", &Tensor::zeros([1], FLOAT));
    let columns: Vec<Tensor> = (0..128)
        .map(|feature| {
            let pick = Tensor::zeros([1, 128], FLOAT);
            let _ = pick.narrow(1, feature, 1).fill_(1.0);
            set("critic.output.weight", &pick);
            policy.step(&x, &policy.initial_state(40)).1 - 10.0
        })
        .collect();
    let z = Tensor::stack(&columns, 1);
    let u = z.minimum(&(&z * 100.0));
    let mean = u.mean_dim(1, false, Kind::Float);
    let variance = u.square().mean_dim(1, false, Kind::Float) - mean.square();
    assert!(largest(&mean) <= 1e-4, "{mean:?}");
    assert!(largest(&(variance - 1.0)) <= 1e-3);
}

#[test]
fn act_step_and_scan_agree() {
    for name in names() {
        let policy = small(name);
        let sequences = sequences(&[6, 11, 1], policy.encoder().width() as i64);
        let (packing, x) = pack(&sequences);
        let out = tch::no_grad(|| policy.scan(&x, &packing, 0));
        let (params, values) = (unpack(&out.params, &packing), unpack(&out.values, &packing));
        for (i, x) in sequences.iter().enumerate() {
            let mut state = policy.initial_state(1);
            for t in 0..x.size()[0] {
                let (acted, _) = policy.act(&x.narrow(0, t, 1), &state);
                let (stepped, value, next) = policy.step(&x.narrow(0, t, 1), &state);
                assert_same_bits(&acted, &stepped, name);
                assert_close(&stepped, &params[i].narrow(0, t, 1), 1e-5, name);
                assert_close(&value, &values[i].narrow(0, t, 1), 1e-5, name);
                assert!(!acted.requires_grad() && next.0.iter().all(|tensor| !tensor.requires_grad()));
                state = next;
            }
        }
    }
}

/// Widths of the layers' products in a policy, from and to.
const PRODUCTS: [(i64, i64); 8] =
    [(20, 128), (128, 128), (128, 768), (256, 768), (128, 256), (256, 256), (256, 128), (128, 7)];

#[test]
fn a_row_does_not_depend_on_the_others() {
    const MOST: i64 = 256;
    tch::set_num_threads(1);
    for name in names() {
        let policy = small(name);
        let x = random(MOST, policy.encoder().width() as i64);
        let twice = |x: &Tensor| {
            let (_, state) = policy.act(x, &policy.initial_state(x.size()[0]));
            policy.act(x, &state).0
        };
        let whole = twice(&x);
        for rows in [16, 17, 31, 64, 100, MOST] {
            for start in [0, MOST - rows] {
                let (found, expected) = (twice(&x.narrow(0, start, rows)), whole.narrow(0, start, rows));
                assert_close(&found, &expected, 1e-6, name);
                if libtorch_keeps_rows_apart(&PRODUCTS) {
                    assert_same_bits(&found, &expected, &format!("{name}, {rows} rows from {start}"));
                }
            }
        }
    }
}

#[test]
fn weights_come_back_bit_for_bit() {
    for name in names() {
        let (source, mut target) = (small(name), small(name));
        let bytes = source.to_bytes();
        assert_ne!(target.to_bytes(), bytes);
        assert_eq!(source.signature(), target.signature());
        target.load(&bytes).unwrap();
        assert_eq!(target.to_bytes(), bytes);
        let x = random(16, source.encoder().width() as i64);
        let act = |policy: &Policy| policy.act(&x, &policy.initial_state(16)).0;
        assert_same_bits(&act(&source), &act(&target), name);
        assert!(target.parameters().values().all(Tensor::requires_grad));
    }
}

type Parts = BTreeMap<String, (Dtype, Vec<usize>, Vec<u8>)>;

/// The bytes of `policy`'s weights after `change`.
fn changed(policy: &Policy, change: impl FnOnce(&mut Parts)) -> Vec<u8> {
    let bytes = policy.to_bytes();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let part = |(name, view): (&str, TensorView<'_>)| {
        (name.to_owned(), (view.dtype(), view.shape().to_vec(), view.data().to_vec()))
    };
    let mut parts: Parts = file.iter().map(part).collect();
    change(&mut parts);
    let views = parts
        .iter()
        .map(|(name, (dtype, shape, data))| (name.clone(), TensorView::new(*dtype, shape.clone(), data).unwrap()));
    serialize(views, None).unwrap()
}

#[test]
fn wrong_weights_are_refused_and_change_nothing() {
    const NAME: &str = "projection.bias";
    let (source, mut target) = (small("gru"), small("gru"));
    let before = target.to_bytes();
    let mut refused = |bytes: &[u8]| {
        let error = target.load(bytes).unwrap_err();
        assert_eq!(target.to_bytes(), before, "{error}");
        error
    };

    let renamed = changed(&source, |parts| {
        let part = parts.remove(NAME).unwrap();
        parts.insert("projection.bais".to_owned(), part);
    });
    let expected = WeightsError::Names { missing: NAME.to_owned(), unexpected: "projection.bais".to_owned() };
    assert_eq!(refused(&renamed), expected);

    let wrong = |found: &str| WeightsError::Tensor {
        name: NAME.to_owned(),
        found: found.to_owned(),
        expected: "F32 [128]".to_owned(),
    };
    let reshaped = changed(&source, |parts| parts.get_mut(NAME).unwrap().1 = vec![2, 64]);
    assert_eq!(refused(&reshaped), wrong("F32 [2, 64]"));
    let retyped = changed(&source, |parts| parts.get_mut(NAME).unwrap().0 = Dtype::I32);
    assert_eq!(refused(&retyped), wrong("I32 [128]"));

    for number in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let broken = changed(&source, |parts| {
            parts.get_mut(NAME).unwrap().2[8..12].copy_from_slice(&number.to_le_bytes());
        });
        assert_eq!(refused(&broken), WeightsError::NotFinite { name: NAME.to_owned() });
    }

    let whole = source.to_bytes();
    for bytes in [&whole[..whole.len() - 1], &whole[..100], &whole[..7], &[], b"not safetensors at all"] {
        assert!(matches!(refused(bytes), WeightsError::Format(_)));
    }
    assert!(matches!(refused(&small("mlp").to_bytes()), WeightsError::Names { .. }));
}
