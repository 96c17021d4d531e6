//! Memories against recordings of the upstream modules (fixtures/memories.json, or the file named by
//! POPGYM_MEMORY_FIXTURES): outputs, gradients with respect to the input, and final states.
//!
//! The file: `cases`, each with `name`, `params` (upstream's names), `x [B, T, inputs]`, `y [B, T, outputs]`, `y_weight`,
//! `grad_x` = d sum(y y_weight) / dx, and `final_state`; both rows have length T, states start at zero.

mod common;

use common::*;
use popgym_models::{Packing, State};
use serde_json::Value;
use tch::{Device, Kind, Tensor};

/// How a recorded case is laid over a memory.
struct Case {
    /// The recorded case and our memory.
    name: &'static str,
    options: &'static str,
    /// For each of upstream's parameters that matters ours; the numbers are in the same order.
    parameters: &'static [(&'static str, &'static str)],
    /// Weights of ours that the recorded module lacks: they hand on what they are given.
    identities: &'static [&'static str],
    /// The like biases.
    zeros: &'static [&'static str],
    /// From the recorded final state to ours, but for the tensors' shapes.
    final_state: fn(Vec<Tensor>) -> Vec<Tensor>,
}

fn as_recorded(state: Vec<Tensor>) -> Vec<Tensor> {
    state
}

/// PyTorch's names of a recurrent layer's parameters and ours.
const RECURRENT: &[(&str, &str)] = &[
    ("weight_ih_l0", "weight_input"),
    ("weight_hh_l0", "weight_state"),
    ("bias_ih_l0", "bias_input"),
    ("bias_hh_l0", "bias_state"),
];

const CASES: &[Case] = &[
    Case {
        name: "elman",
        options: "hidden_size = 8",
        parameters: RECURRENT,
        identities: &[],
        zeros: &[],
        final_state: as_recorded,
    },
    Case {
        name: "lstm",
        options: "hidden_size = 8",
        parameters: RECURRENT,
        identities: &[],
        zeros: &[],
        final_state: as_recorded,
    },
    Case {
        name: "gru",
        options: "hidden_size = 8",
        parameters: RECURRENT,
        identities: &[],
        zeros: &[],
        final_state: as_recorded,
    },
    Case {
        name: "dnc",
        options: "hidden_size = 8\ncells = 3\ncell_size = 4\nread_heads = 2",
        parameters: &[
            ("lstm_layer_0.weight_ih_l0", "weight_input"),
            ("lstm_layer_0.weight_hh_l0", "weight_state"),
            ("lstm_layer_0.bias_ih_l0", "bias_input"),
            ("lstm_layer_0.bias_hh_l0", "bias_state"),
            ("rnn_layer_memory_shared.interface_weights.weight", "weight_interface"),
            ("rnn_layer_memory_shared.interface_weights.bias", "bias_interface"),
            ("output.weight", "weight_output"),
            ("output.bias", "bias_output"),
        ],
        identities: &[],
        zeros: &[],
        final_state: as_recorded,
    },
    Case {
        name: "fart",
        options: "hidden_size = 4\nkey_size = 4",
        parameters: ATTENTION,
        identities: &["output.weight"],
        zeros: &["output.bias"],
        final_state: as_recorded,
    },
    Case {
        name: "fwp",
        options: "hidden_size = 4\nkey_size = 4",
        parameters: ATTENTION,
        identities: &["output.weight"],
        zeros: &["output.bias"],
        final_state: as_recorded,
    },
    Case {
        name: "tcn",
        options: "hidden_size = 8",
        parameters: &[("weight", "weight"), ("bias", "bias")],
        identities: &[],
        zeros: &[],
        final_state: as_recorded,
    },
];

/// The block of `fart` and `fwp`, but for the projection after it.
const ATTENTION: &[(&str, &str)] = &[
    ("norm.weight", "norm_weight"),
    ("norm.bias", "norm_bias"),
    ("key.weight", "key"),
    ("query.weight", "query"),
    ("value.weight", "value"),
    ("ff.0.weight", "first.weight"),
    ("ff.0.bias", "first.bias"),
    ("ff.2.weight", "second.weight"),
    ("ff.2.bias", "second.bias"),
    ("shortcut.weight", "shortcut.weight"),
    ("shortcut.bias", "shortcut.bias"),
];

fn tensor(value: &Value) -> Tensor {
    fn walk(value: &Value, depth: usize, shape: &mut Vec<i64>, numbers: &mut Vec<f64>) {
        if let Some(list) = value.as_array() {
            if shape.len() == depth {
                shape.push(list.len() as i64);
            }
            for value in list {
                walk(value, depth + 1, shape, numbers);
            }
        } else {
            numbers.push(value.as_f64().expect("a number"));
        }
    }
    let (mut shape, mut numbers) = (Vec::new(), Vec::new());
    walk(value, 0, &mut shape, &mut numbers);
    Tensor::from_slice(&numbers).view(&shape[..]).to_kind(Kind::Float)
}

fn assert_recorded(a: &Tensor, recorded: &Tensor, what: &str) {
    assert_eq!(a.size(), recorded.size(), "{what}");
    let excess = ((a - recorded).abs() - recorded.abs() * 1e-4).max().double_value(&[]);
    assert!(excess <= 1e-5, "{what} differs from the recording by {excess:e} too much");
}

/// `[sequences, steps, width]` to packed rows, all sequences being equally long.
fn packed(x: &Tensor) -> Tensor {
    x.transpose(0, 1).reshape([-1, x.size()[2]])
}

#[test]
fn memories_do_what_upstream_does() {
    let text = match std::env::var("POPGYM_MEMORY_FIXTURES") {
        Ok(path) => std::fs::read_to_string(path).expect("POPGYM_MEMORY_FIXTURES names a file"),
        Err(_) => include_str!("fixtures/memories.json").to_owned(),
    };
    let file: Value = serde_json::from_str(&text).unwrap();
    for recorded in file["cases"].as_array().unwrap() {
        let name = recorded["name"].as_str().unwrap();
        let case = CASES.iter().find(|case| case.name == name);
        replay(recorded, case.unwrap_or_else(|| panic!("no memory for the recorded case {name}")));
        println!("{name}: outputs, gradients and final state match");
    }
}

fn replay(recorded: &Value, case: &Case) {
    let name = case.name;
    let [x, y, y_weight, grad_x] = ["x", "y", "y_weight", "grad_x"].map(|key| tensor(&recorded[key]));
    let [batch, steps, width] = x.size()[..] else { panic!() };
    let (memory, variables) = memory(name, width, case.options);
    assert_eq!(variables.len(), case.parameters.len() + case.identities.len() + case.zeros.len(), "{name}");
    let set = |ours: &str, value: &Tensor| tch::no_grad(|| variables[ours].shallow_clone().copy_(value));
    for (theirs, ours) in case.parameters {
        set(ours, &tensor(&recorded["params"][theirs]).view_as(&variables[*ours]));
    }
    for ours in case.identities {
        set(ours, &Tensor::eye(variables[*ours].size()[0], FLOAT));
    }
    for ours in case.zeros {
        set(ours, &variables[*ours].zeros_like());
    }
    let final_state = (case.final_state)(recorded["final_state"].as_array().unwrap().iter().map(tensor).collect());
    let assert_final = |state: &State| {
        assert_eq!(state.0.len(), final_state.len());
        for (i, (state, recorded)) in state.0.iter().zip(&final_state).enumerate() {
            assert_recorded(state, &recorded.reshape(state.size()), &format!("{name}, final state {i}"));
        }
    };

    let packing = Packing::new(&vec![steps; batch as usize]);
    let initial = memory.initial_state(batch, Device::Cpu);
    let scan = tch::no_grad(|| memory.scan(&packed(&x), &packing, &initial));
    assert_recorded(&scan.output, &packed(&y), &format!("{name}, scan"));
    assert_final(&scan.state);
    let gradient = scan_gradient(&*memory, &packed(&x), &packing, &packed(&y_weight));
    assert_recorded(&gradient, &packed(&grad_x), &format!("{name}, gradient"));

    for acting in [false, true] {
        let mut state = State(initial.0.iter().map(Tensor::copy).collect());
        for t in 0..steps {
            let x = x.select(1, t);
            let (output, next) = if acting { memory.act(&x, &state) } else { memory.step(&x, &state) };
            assert_recorded(&output.detach(), &y.select(1, t), &format!("{name}, step {t}, acting {acting}"));
            state = State(next.0.iter().map(Tensor::detach).collect());
        }
        assert_final(&state);
    }
}
