//! The recurrent memories with loops of their own on the CPU, against autograd through their steps, and their constants.

mod common;

use std::collections::BTreeMap;

use common::*;
use popgym_models::memory::{Memory, Registry, Scan, scan_by_steps, sliding_window};
use popgym_models::{Packing, State};
use tch::nn::VarStore;
use tch::{Device, Kind, Tensor};

const NAMES: [&str; 5] = ["elman", "lstm", "gru", "indrnn", "lmu"];
const RAGGED: [i64; 6] = [7, 1, 40, 23, 40, 2];

/// d sum(output * weight) / d input and d parameters.
fn gradients(
    scan: Scan,
    input: &Tensor,
    weight: &Tensor,
    parameters: &BTreeMap<String, Tensor>,
) -> (Tensor, BTreeMap<String, Tensor>) {
    let grad_input = if let Some(backward) = scan.backward {
        backward(weight)
    } else {
        input.shallow_clone().zero_grad();
        (scan.output * weight).sum(Kind::Float).backward();
        input.grad()
    };
    (grad_input, take_gradients(parameters))
}

#[test]
fn own_backwards_agree_with_autograd() {
    for name in NAMES {
        for hidden in [1, 19, 64] {
            let (memory, parameters) = memory(name, 12, &format!("hidden_size = {hidden}"));
            if hidden == 1 {
                // A single unit of IndRNN's is else often dead.
                tch::no_grad(|| parameters.values().for_each(|x| drop(x.shallow_clone().abs_())));
            }
            let packing = Packing::new(&RAGGED);
            let x = random(packing.rows(), 12).set_requires_grad(true);
            let weight = random(packing.rows(), hidden);
            let state = memory.initial_state(packing.sequences(), Device::Cpu);
            let state = State(state.0.iter().map(|tensor| tensor.randn_like() * 0.5).collect());
            let own = memory.scan(&x, &packing, &state);
            assert!(own.backward.is_some() && !own.output.requires_grad(), "{name}");
            let by_steps = scan_by_steps(&*memory, &x, &packing, &state);
            let what = format!("{name}, hidden {hidden}");
            assert_close(&own.output, &by_steps.output.detach(), 1e-5, &what);
            for (own, by_steps) in own.state.0.iter().zip(&by_steps.state.0) {
                assert_close(own, &by_steps.detach(), 1e-5, &what);
            }
            let own = gradients(own, &x, &weight, &parameters);
            let by_steps = gradients(by_steps, &x, &weight, &parameters);
            assert_close(&own.0, &by_steps.0, 1e-5, &what);
            // A single unit's gradient may cancel to almost nothing: on the scale of the input's, as above.
            for (key, gradient) in &own.1 {
                assert_close(gradient, &by_steps.1[key], 1e-5, &format!("{what}: {key}"));
            }
        }
    }
}

/// The same memory in f64, where libtorch's operators run, agrees with the loops in f32.
#[test]
fn f64_agrees() {
    for name in NAMES {
        let mut store = VarStore::new(Device::Cpu);
        let options = "hidden_size = 19".parse().unwrap();
        let memory = Registry::standard().get(name).unwrap().build(&store.root(), 12, &options).unwrap();
        let packing = Packing::new(&RAGGED);
        let (x, weight) = (random(packing.rows(), 12), random(packing.rows(), 19));
        let run = |memory: &dyn Memory, kind: Kind, parameters: &BTreeMap<String, Tensor>| {
            let x = x.to_kind(kind).copy().set_requires_grad(true);
            let state = memory.initial_state(packing.sequences(), Device::Cpu);
            let state = State(state.0.iter().map(|tensor| (tensor + 0.3).to_kind(kind)).collect());
            let scan = memory.scan(&x, &packing, &state);
            assert_eq!(scan.backward.is_some(), kind == Kind::Float, "{name}");
            let output = scan.output.detach();
            let (grad_input, gradients) = gradients(scan, &x, &weight.to_kind(kind), parameters);
            (output, grad_input, gradients)
        };
        let narrow = run(&*memory, Kind::Float, &store.variables().into_iter().collect());
        store.double();
        let parameters: BTreeMap<String, Tensor> = store.variables().into_iter().collect();
        for parameter in parameters.values() {
            parameter.shallow_clone().zero_grad();
        }
        let wide = run(&*memory, Kind::Double, &parameters);
        assert_close(&narrow.0, &wide.0, 1e-5, name);
        assert_close(&narrow.1, &wide.1, 1e-5, name);
        assert_gradients_close(&narrow.2, &wide.2, 1e-5, name);
    }
}

#[test]
fn long_episodes_agree_with_steps() {
    for name in NAMES {
        let (memory, _) = memory(name, 128, "");
        let (packing, x) = pack(&sequences(&[1023, 207, 1023], 128));
        let scan = tch::no_grad(|| memory.scan(&x, &packing, &memory.initial_state(3, Device::Cpu)));
        let by_steps = tch::no_grad(|| scan_by_steps(&*memory, &x, &packing, &memory.initial_state(3, Device::Cpu)));
        assert_close(&scan.output, &by_steps.output, 1e-5, name);
    }
}

/// Acting, as actors do it: on one thread a row has the same bits whatever the others.
#[test]
fn acting_is_exact_in_every_batch() {
    tch::set_num_threads(1);
    for name in NAMES {
        let (memory, _) = memory(name, 128, "");
        let x = random(256, 128);
        let state = memory.initial_state(256, Device::Cpu);
        let state = State(state.0.iter().map(Tensor::randn_like).collect());
        let (expected, _) = memory.act(&x, &state);
        for rows in [16, 17, 31, 64, 100] {
            let part: Vec<i64> = (0..rows).map(|row| 255 - row).collect();
            let index = Tensor::from_slice(&part);
            let (output, next) = memory.act(&x.index_select(0, &index), &state.select(&part));
            assert_same_bits(&output, &expected.index_select(0, &index), &format!("{name}, {rows} rows"));
            assert_eq!(next.0.len(), state.0.len());
        }
    }
}

#[test]
fn independent_recurrences_are_bounded() {
    let (memory, parameters) = memory("indrnn", 3, "hidden_size = 2");
    let bound = 2_f64.powf(1.0 / 1024.0);
    tch::no_grad(|| {
        for parameter in parameters.values() {
            let _ = parameter.shallow_clone().fill_(0.0);
        }
        parameters["first_recurrent"].shallow_clone().copy_(&Tensor::from_slice(&[5.0_f32, 0.5]));
        parameters["weight_between"].shallow_clone().copy_(&Tensor::eye(2, FLOAT));
    });
    let state = State(vec![Tensor::ones([1, 2], FLOAT), Tensor::zeros([1, 2], FLOAT)]);
    let x = Tensor::zeros([1024, 3], FLOAT).set_requires_grad(true);
    let scan = memory.scan(&x, &Packing::new(&[1024]), &state);
    // Kept from exploding, a state doubles in 1024 steps.
    assert!((scan.output.double_value(&[1023, 0]) - 2.0).abs() < 1e-3);
    assert!((scan.output.double_value(&[0, 0]) - bound).abs() < 1e-6);
    assert!((scan.output.double_value(&[1, 1]) - 0.25).abs() < 1e-7);
    let kept = parameters["first_recurrent"].double_value(&[0]);
    assert!((kept - 5.0).abs() < 1e-7, "the parameter itself is left alone");
    let _ = scan.backward.unwrap()(&Tensor::ones([1024, 2], FLOAT));
    let gradient = parameters["first_recurrent"].grad();
    assert!(gradient.double_value(&[0]).abs() < 1e-9, "beyond the bound there is no gradient");
    // d sum of u^t / du for t = 1, 2, ... is 1 / (1 - u)^2.
    assert!((gradient.double_value(&[1]) - 4.0).abs() < 1e-5);

    // After an optimiser's step it is put back to the bound, where its gradient lets it leave.
    memory.constrain();
    assert!((parameters["first_recurrent"].double_value(&[0]) - bound).abs() < 1e-6);
    assert!((parameters["first_recurrent"].double_value(&[1]) - 0.5).abs() < 1e-7);
    let scan = memory.scan(&x, &Packing::new(&[1024]), &state);
    let _ = scan.backward.unwrap()(&Tensor::ones([1024, 2], FLOAT));
    let gradient = parameters["first_recurrent"].grad();
    assert!(gradient.double_value(&[0]) > 1024.0 * 1023.0 / 2.0, "1 + 2 u + 3 u^2 + .. with u at the bound");
}

#[test]
fn the_sliding_window_is_the_references() {
    let close = |x: &Tensor, index: &[i64], expected: f64| {
        let found = x.double_value(index);
        assert!((found - expected).abs() < 1e-8, "{index:?}: {found}, not {expected}");
    };
    let (a, b) = sliding_window(4, 4.0);
    for (j, expected) in [0.755_130_31, -0.191_390_08, -0.093_519_84, -0.002_614_27].into_iter().enumerate() {
        close(&a, &[0, j as i64], expected);
    }
    for (i, expected) in [0.244_869_69, -0.574_170_24, 0.467_599_20, -0.018_299_87].into_iter().enumerate() {
        close(&b, &[i as i64], expected);
    }
    let (a, b) = sliding_window(256, 64.0);
    for (i, j, expected) in [(0, 0, 0.984_374_18), (1, 0, 0.046_140_13), (255, 255, -0.017_910_55)] {
        close(&a, &[i, j], expected);
    }
    for (i, expected) in [(0, 0.015_625_82), (1, -0.046_140_13), (2, 0.074_505_1)] {
        close(&b, &[i], expected);
    }
    // The scalar case: dm/dt = (u - m) / theta.
    let (a, b) = sliding_window(1, 7.0);
    close(&a, &[0, 0], (-1.0_f64 / 7.0).exp());
    close(&b, &[0], 1.0 - (-1.0_f64 / 7.0).exp());
}

#[test]
fn the_sliding_window_is_the_recorded_one() {
    let file: serde_json::Value = serde_json::from_str(include_str!("fixtures/memories.json")).unwrap();
    let case = file["cases"].as_array().unwrap().iter().find(|case| case["name"] == "lmu").unwrap();
    let (a, b) = sliding_window(7, 16.0);
    for i in 0..7 {
        for j in 0..7 {
            let recorded = case["params"]["cell.A"][i][j].as_f64().unwrap();
            assert!((a.double_value(&[i as i64, j as i64]) - recorded).abs() < 1e-7);
        }
        let recorded = case["params"]["cell.B"][i][0].as_f64().unwrap();
        assert!((b.double_value(&[i as i64]) - recorded).abs() < 1e-7);
    }
}

/// The least and greatest orders and windows give a memory that forgets.
#[test]
fn every_sliding_window_is_stable() {
    for (order, theta) in [(1, 1.0), (1, 65_536.0), (300, 3.7), (1024, 1.0), (1024, 65_536.0)] {
        let (a, b) = sliding_window(order, theta);
        let radius = a.linalg_eigvals().abs().max().double_value(&[]);
        assert!(radius < 1.0, "order {order}, theta {theta}: {radius}");
        assert!(largest(&b).is_finite());
    }
}

#[test]
fn wrong_options_of_the_lmu_are_told() {
    let entry = Registry::standard().get("lmu").unwrap().clone();
    let store = VarStore::new(Device::Cpu);
    for (option, key) in [
        ("theta = 0", "theta"),
        ("theta = -1.5", "theta"),
        ("theta = nan", "theta"),
        ("theta = inf", "theta"),
        ("theta = 65537", "theta"),
        ("memory_size = 0", "memory_size"),
        ("memory_size = 1025", "memory_size"),
    ] {
        let error = entry.build(&store.root(), 4, &option.parse().unwrap()).err().expect(option).to_string();
        assert!(error.contains(key) && error.contains("allowed is 1..="), "{error}");
    }
    assert!(store.is_empty(), "nothing was built");
}
