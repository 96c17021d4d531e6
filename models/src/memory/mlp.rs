//! `mlp`: no memory at all, the baseline that cannot remember (paper: MLP).
//!
//! `y = LeakyReLU(W2 LeakyReLU(W1 x + b1) + b2)`, `W1 [hidden, inputs]`, `W2 [hidden, hidden]`; the state is empty.

use tch::nn::Path;
use tch::{Device, Tensor};

use super::{HiddenSize, Memory, MemoryKind, Scan, State};
use crate::init::{Linear, leaky_relu, uniform};
use crate::packing::Packing;

/// Two layers on the present input.
#[derive(Debug)]
pub struct Mlp {
    hidden_size: i64,
    first: Linear,
    second: Linear,
}

impl MemoryKind for Mlp {
    const NAME: &'static str = "mlp";
    const PAPER_NAME: &'static str = "MLP";
    const PAPER: &'static str = "Morad et al., 2023";
    type Options = HiddenSize;

    fn new(path: &Path<'_>, input_width: i64, options: &HiddenSize) -> Result<Self, String> {
        let hidden_size = super::check_hidden_size(options.hidden_size)?;
        Ok(Self {
            hidden_size,
            first: Linear::new(&(path / "first"), input_width, hidden_size, uniform(input_width)),
            second: Linear::new(&(path / "second"), hidden_size, hidden_size, uniform(hidden_size)),
        })
    }
}

impl Memory for Mlp {
    fn output_width(&self) -> i64 {
        self.hidden_size
    }

    fn initial_state(&self, _rows: i64, _device: Device) -> State {
        State::default()
    }

    fn step(&self, input: &Tensor, _state: &State) -> (Tensor, State) {
        let hidden = leaky_relu(self.first.forward(input));
        (leaky_relu(self.second.forward(&hidden)), State::default())
    }

    fn scan(&self, input: &Tensor, packing: &Packing, state: &State) -> Scan {
        let (output, state) = self.step(input, state);
        Scan { output, state, computed_steps: packing.rows(), backward: None }
    }
}
