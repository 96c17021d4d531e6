//! Memories against recordings of the upstream modules (fixtures/, or the file named by POPGYM_MEMORY_FIXTURES): outputs,
//! gradients and final states.

mod common;

use common::*;
use popgym_models::Packing;
use serde_json::Value;
use tch::{Device, Kind, Tensor};

type Case = (&'static str, &'static str, &'static [(&'static str, &'static str)]);

/// Memory (the recorded case has its name), its options, and for each of upstream's parameters ours.
const CASES: [Case; 1] = [(
    "gru",
    "hidden_size = 8",
    &[
        ("weight_ih_l0", "weight_input"),
        ("weight_hh_l0", "weight_state"),
        ("bias_ih_l0", "bias_input"),
        ("bias_hh_l0", "bias_state"),
    ],
)];

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
        Err(_) => include_str!("fixtures/gru.json").to_owned(),
    };
    let file: Value = serde_json::from_str(&text).unwrap();
    for (name, options, parameters) in CASES {
        let case = file["cases"].as_array().unwrap().iter().find(|case| case["name"] == name);
        let case = case.unwrap_or_else(|| panic!("no case {name}"));
        let [x, y, y_weight, grad_x] = ["x", "y", "y_weight", "grad_x"].map(|key| tensor(&case[key]));
        let [batch, steps, width] = x.size()[..] else { panic!() };
        let (memory, variables) = memory(name, width, options);
        assert_eq!(variables.len(), parameters.len());
        for (theirs, ours) in parameters {
            tch::no_grad(|| variables[*ours].shallow_clone().copy_(&tensor(&case["params"][theirs])));
        }
        let final_state: Vec<Tensor> = case["final_state"].as_array().unwrap().iter().map(tensor).collect();
        let assert_final = |state: &popgym_models::State| {
            assert_eq!(state.0.len(), final_state.len());
            for (state, recorded) in state.0.iter().zip(&final_state) {
                assert_recorded(state, &recorded.view(&state.size()[..]), "final state");
            }
        };

        let packing = Packing::new(&vec![steps; batch as usize]);
        let initial = memory.initial_state(batch, Device::Cpu);
        let scan = tch::no_grad(|| memory.scan(&packed(&x), &packing, &initial));
        assert_recorded(&scan.output, &packed(&y), "scan");
        assert_final(&scan.state);
        let gradient = scan_gradient(&*memory, &packed(&x), &packing, &packed(&y_weight));
        assert_recorded(&gradient, &packed(&grad_x), "gradient");

        let mut state = initial;
        for t in 0..steps {
            let (output, next) = tch::no_grad(|| memory.step(&x.select(1, t), &state));
            assert_recorded(&output, &y.select(1, t), "step");
            state = next;
        }
        assert_final(&state);
    }
}
