//! The DNC's own forms against its definition, [`Memory::step`], and autograd's gradients of it.

mod common;

use std::collections::BTreeMap;

use common::*;
use popgym_models::memory::{Memory, Registry, scan_by_steps};
use popgym_models::{Packing, State};
use tch::nn::VarStore;
use tch::{Device, Kind, Tensor};

const WIDTH: i64 = 20;

/// One cell; sizes that fill no vector; more than a vector; the paper's.
const SIZES: [&str; 5] = [
    "hidden_size = 7\ncells = 1\ncell_size = 1\nread_heads = 1",
    "hidden_size = 19\ncells = 3\ncell_size = 4\nread_heads = 2",
    "hidden_size = 19\ncells = 16\ncell_size = 16\nread_heads = 4",
    "hidden_size = 33\ncells = 21\ncell_size = 18\nread_heads = 3",
    "",
];

/// A memory whose parameters, and so its interface's numbers, are larger than first weights.
fn lively(options: &str, kind: Kind) -> (Box<dyn Memory>, BTreeMap<String, Tensor>) {
    let mut store = VarStore::new(Device::Cpu);
    let entry = Registry::standard().get("dnc").unwrap().clone();
    let memory = entry.build(&store.root(), WIDTH, &options.parse().unwrap()).unwrap();
    let variables: BTreeMap<String, Tensor> = store.variables().into_iter().collect();
    tch::no_grad(|| {
        for name in ["weight_interface", "bias_interface"] {
            let _ = variables[name].shallow_clone().g_mul_scalar_(4.0);
        }
    });
    if kind == Kind::Double {
        store.double();
    }
    (memory, variables)
}

/// States as an episode could leave them: usages and weights within 0..1, no two usages close.
fn used(memory: &dyn Memory, rows: i64) -> State {
    let mut state = memory.initial_state(rows, Device::Cpu);
    for (i, tensor) in state.0.iter_mut().enumerate() {
        let shape = tensor.size();
        let cells = *shape.last().unwrap() as f64;
        *tensor = match i {
            3..=6 => Tensor::rand(&shape[..], FLOAT) / cells,
            7 => (Tensor::rand(&shape[..], FLOAT).argsort(1, false) + 0.5) / cells,
            _ => Tensor::randn(&shape[..], FLOAT) * 0.5,
        };
    }
    let cells = state.0[3].size()[1];
    state.0[3] = &state.0[3] * (1.0 - Tensor::eye(cells, FLOAT));
    state
}

/// Outputs, the last state, d sum(output * weight) / d input and d parameters.
type Result = (Tensor, State, Tensor, BTreeMap<String, Tensor>);

fn own(
    memory: &dyn Memory,
    parameters: &BTreeMap<String, Tensor>,
    x: &Tensor,
    packing: &Packing,
    state: &State,
    weight: &Tensor,
) -> Result {
    let x = x.detach().set_requires_grad(true);
    let scan = memory.scan(&x, packing, state);
    let grad_x = scan.backward.expect("a backward of its own")(weight);
    (scan.output, scan.state, grad_x, take_gradients(parameters))
}

fn autograd(
    memory: &dyn Memory,
    parameters: &BTreeMap<String, Tensor>,
    x: &Tensor,
    packing: &Packing,
    state: &State,
    weight: &Tensor,
) -> Result {
    let x = x.detach().set_requires_grad(true);
    let scan = scan_by_steps(memory, &x, packing, state);
    (&scan.output * weight).sum(None::<Kind>).backward();
    (scan.output.detach(), scan.state, x.grad(), take_gradients(parameters))
}

fn convert(x: &Tensor, kind: Kind) -> Tensor {
    x.to_kind(kind)
}

#[test]
fn the_loop_has_the_gradients_of_the_definition() {
    for options in SIZES {
        for lengths in [&[1][..], &[6, 2, 6, 1, 9, 3], &[17, 11]] {
            let (memory, parameters) = lively(options, Kind::Float);
            let (wide, wide_parameters) = lively(options, Kind::Double);
            tch::no_grad(|| {
                for (name, parameter) in &parameters {
                    wide_parameters[name].shallow_clone().copy_(parameter);
                }
            });
            let (packing, x) = pack(&sequences(lengths, WIDTH));
            let weight = random(packing.rows(), memory.output_width());
            let state = used(&*memory, packing.sequences());
            let wide_state = State(state.0.iter().map(|x| convert(x, Kind::Double)).collect());
            let [wide_x, wide_weight] = [&x, &weight].map(|x| convert(x, Kind::Double));
            let exact = autograd(&*wide, &wide_parameters, &wide_x, &packing, &wide_state, &wide_weight);
            let found = own(&*memory, &parameters, &x, &packing, &state, &weight);
            let what = format!("{options:?}, lengths {lengths:?}");
            assert_close(&found.0, &convert(&exact.0, Kind::Float), 1e-5, &what);
            for (i, (a, b)) in found.1.0.iter().zip(&exact.1.0).enumerate() {
                assert_close(a, &convert(b, Kind::Float), 1e-5, &format!("{what}, state {i}"));
            }
            assert_close(&found.2, &convert(&exact.2, Kind::Float), 1e-5, &what);
            let exact = exact.3.into_iter().map(|(name, x)| (name, convert(&x, Kind::Float))).collect();
            assert_gradients_close(&found.3, &exact, 1e-4, &what);
        }
    }
}

#[test]
fn gradients_are_right_from_a_memory_of_zeros() {
    // Cells of length zero, and usages that are all equal.
    for options in SIZES {
        let (memory, parameters) = lively(options, Kind::Float);
        let (packing, x) = pack(&sequences(&[3, 1, 7], WIDTH));
        let weight = random(packing.rows(), memory.output_width());
        let state = memory.initial_state(3, Device::Cpu);
        let expected = autograd(&*memory, &parameters, &x, &packing, &state, &weight);
        let found = own(&*memory, &parameters, &x, &packing, &state, &weight);
        assert_close(&found.0, &expected.0, 1e-5, options);
        assert_close(&found.2, &expected.2, 1e-5, options);
        assert_gradients_close(&found.3, &expected.3, 1e-4, options);
    }
}

#[test]
fn acting_is_the_definition() {
    for options in SIZES {
        let (memory, _) = lively(options, Kind::Float);
        for rows in [1, 2, 17] {
            let mut state = used(&*memory, rows);
            for _ in 0..3 {
                let x = random(rows, WIDTH);
                let (output, next) = memory.act(&x, &state);
                let (expected, expected_next) = tch::no_grad(|| memory.step(&x, &state));
                assert_close(&output, &expected, 1e-5, options);
                for (i, (a, b)) in next.0.iter().zip(&expected_next.0).enumerate() {
                    assert_close(a, b, 1e-5, &format!("{options:?}, state {i}"));
                }
                state = next;
            }
        }
    }
}

#[test]
fn of_equally_used_cells_the_first_is_written() {
    let (memory, parameters) = lively("hidden_size = 8\ncells = 5\ncell_size = 3\nread_heads = 2", Kind::Float);
    let (allocation_gate, write_gate) = (0.75_f64, 0.5);
    let logit = |p: f64| (p / (1.0 - p)).ln();
    tch::no_grad(|| {
        let _ = parameters["weight_interface"].shallow_clone().zero_();
        // Gates stand before the 2 x 3 modes.
        let bias = &parameters["bias_interface"];
        let at = bias.size()[0] - 8;
        let _ = bias.narrow(0, at, 1).fill_(logit(allocation_gate));
        let _ = bias.narrow(0, at + 1, 1).fill_(logit(write_gate));
    });
    // The content of equal cells is equal; the allocation is 1 - u, u (1 - u), u^2 (1 - u), ... with u = 1e-6.
    let expected: Vec<f64> = (0..5)
        .map(|i| {
            let allocation = 1e-6_f64.powi(i) * (1.0 - 1e-6);
            write_gate * (allocation_gate * allocation + (1.0 - allocation_gate) / 5.0)
        })
        .collect();
    let expected = Tensor::from_slice(&expected).to_kind(Kind::Float).unsqueeze(0).expand([2, 5], false);
    let (x, state) = (random(2, WIDTH), memory.initial_state(2, Device::Cpu));
    let scan = tch::no_grad(|| memory.scan(&x, &Packing::new(&[1, 1]), &state));
    let forms = [memory.step(&x, &state).1, memory.act(&x, &state).1, scan.state];
    for (form, state) in ["step", "act", "scan"].iter().zip(forms) {
        assert_close(&state.0[6].detach(), &expected, 1e-6, form);
    }
}

#[test]
fn wild_inputs_give_finite_numbers() {
    for options in SIZES {
        let (memory, parameters) = lively(options, Kind::Float);
        let (packing, x) = pack(&sequences(&[12, 5], WIDTH));
        let x = x * 1e6;
        let weight = random(packing.rows(), memory.output_width());
        let found = own(&*memory, &parameters, &x, &packing, &memory.initial_state(2, Device::Cpu), &weight);
        let acted = memory.act(&x, &memory.initial_state(packing.rows(), Device::Cpu)).1;
        let state = found.1.0.iter().chain(&acted.0);
        for tensor in state.chain([&found.0, &found.2]).chain(found.3.values()) {
            assert!(largest(tensor).is_finite(), "{options:?}");
        }
    }
}

#[test]
fn impossible_sizes_are_told() {
    let entry = Registry::standard().get("dnc").unwrap().clone();
    for (key, most) in [("hidden_size", 4096), ("cells", 512), ("cell_size", 512), ("read_heads", 64)] {
        for value in [i64::MIN, -1, 0, most + 1] {
            let options = format!("{key} = {value}").parse().unwrap();
            let error = entry.build(&VarStore::new(Device::Cpu).root(), WIDTH, &options).err().expect("no such size");
            let expected = format!("`{key}` is {value}, allowed is 1..={most}");
            assert!(error.to_string().contains(&expected), "{error}");
        }
    }
}
