//! `indrnn`: two layers whose units are independent of one another in time (Li et al., 2018: Independently recurrent
//! neural network).
//!
//! ```text
//! a' = relu(W0 x  + b0 + u0 * a + c0)
//! e' = relu(W1 a' + b1 + u1 * e + c1),    y = e'
//! ```
//!
//! `weight_input [hidden, inputs]` is W0, `weight_between [hidden, hidden]` W1; all others are vectors `[hidden]`: u0 and u1
//! are `first_recurrent` and `second_recurrent`, b0 and b1 `first_bias_input` and `second_bias_input`, c0 and c1
//! `first_bias_state` and `second_bias_state`. W and b start uniform within `+-1/sqrt(fan-in)`, u and c uniform within 0 and
//! 1 (the biases c too, as upstream). State: `a` and `e`, `[rows, hidden]` each.
//!
//! u0 and u1 are clamped to `+-2^(1/1024)`, so that 1024 steps at most double a state: the parameters themselves after
//! each optimiser's step (upstream: before each forward), so that one at a bound is free to come back, and their use in
//! the function, for weights from elsewhere. Upstream ignores its option `activation` (it says tanh, ReLU is
//! built in; so it is here) and has an output layer that it never uses, which is left out.
//!
//! On the CPU a scan is two matrix products and two loops over time without any (`indrnn_cpu.rs`).

use tch::nn::{Init, Path};
use tch::{Device, Kind, Tensor};

use super::elementwise::on_cpu;
use super::{HiddenSize, Memory, MemoryKind, Scan, State, indrnn_cpu, scan_by_steps};
use crate::init::uniform;
use crate::packing::Packing;

/// The paper's U(0, 1).
const UP_TO_ONE: Init = Init::Uniform { lo: 0.0, up: 1.0 };

/// Of the recurrent weights' absolute values.
fn bound() -> f64 {
    2_f64.powf(1.0 / 1024.0)
}

/// Two layers of independent units.
#[derive(Debug)]
pub struct IndRnn {
    hidden_size: i64,
    first: Layer,
    second: Layer,
}

/// `next = relu(weight input + bias_input + clamp(recurrent) * state + bias_state)`.
#[derive(Debug)]
pub(super) struct Layer {
    /// `[hidden, inputs]`; the others are `[hidden]`.
    pub(super) weight: Tensor,
    pub(super) bias_input: Tensor,
    pub(super) recurrent: Tensor,
    pub(super) bias_state: Tensor,
}

impl Layer {
    fn new(path: &Path<'_>, name: &str, weight: &str, [hidden, inputs]: [i64; 2]) -> Self {
        Self {
            weight: path.var(weight, &[hidden, inputs], uniform(inputs)),
            bias_input: path.var(&format!("{name}_bias_input"), &[hidden], uniform(inputs)),
            recurrent: path.var(&format!("{name}_recurrent"), &[hidden], UP_TO_ONE),
            bias_state: path.var(&format!("{name}_bias_state"), &[hidden], UP_TO_ONE),
        }
    }

    /// The recurrent weights as they act.
    pub(super) fn clamped(&self) -> Tensor {
        self.recurrent.clamp(-bound(), bound())
    }

    fn constrain(&self) {
        tch::no_grad(|| {
            let _ = self.recurrent.shallow_clone().clamp_(-bound(), bound());
        });
    }

    fn step(&self, input: &Tensor, state: &Tensor) -> Tensor {
        (input.linear(&self.weight, Some(&self.bias_input)) + state * self.clamped() + &self.bias_state).relu()
    }
}

impl MemoryKind for IndRnn {
    const NAME: &'static str = "indrnn";
    const PAPER_NAME: &'static str = "IndRNN";
    const PAPER: &'static str = "Li et al., 2018";
    type Options = HiddenSize;

    fn new(path: &Path<'_>, input_width: i64, options: &HiddenSize) -> Result<Self, String> {
        let hidden_size = super::check_hidden_size(options.hidden_size)?;
        Ok(Self {
            hidden_size,
            first: Layer::new(path, "first", "weight_input", [hidden_size, input_width]),
            second: Layer::new(path, "second", "weight_between", [hidden_size, hidden_size]),
        })
    }
}

impl Memory for IndRnn {
    fn output_width(&self) -> i64 {
        self.hidden_size
    }

    fn initial_state(&self, rows: i64, device: Device) -> State {
        State([(); 2].map(|()| Tensor::zeros([rows, self.hidden_size], (Kind::Float, device))).into())
    }

    fn step(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        let a = self.first.step(input, &state.0[0]);
        let e = self.second.step(&a, &state.0[1]);
        (e.shallow_clone(), State(vec![a, e]))
    }

    fn act(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        if !on_cpu(input) {
            return tch::no_grad(|| self.step(input, state));
        }
        let a = indrnn_cpu::step(&self.first, input, &state.0[0]);
        let e = indrnn_cpu::step(&self.second, &a, &state.0[1]);
        (e.shallow_clone(), State(vec![a, e]))
    }

    fn scan(&self, input: &Tensor, packing: &Packing, state: &State) -> Scan {
        if !on_cpu(input) {
            return scan_by_steps(self, input, packing, state);
        }
        indrnn_cpu::scan([&self.first, &self.second], input, packing, state)
    }

    fn constrain(&self) {
        self.first.constrain();
        self.second.constrain();
    }
}
