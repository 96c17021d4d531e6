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
        for lengths in [&[1][..], &[6, 2, 6, 1, 9, 3], &[31, 17]] {
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
