//! `elman`: the simple recurrent network (Elman, 1990: Finding structure in time; tanh, as in PyTorch).
//!
//! ```text
//! h' = tanh(W x + b + U h + c),    y = h'
//! ```
//!
//! `weight_input [hidden, inputs]` is W, `weight_state [hidden, hidden]` U, `bias_input` and `bias_state [hidden]` are b and
//! c; all start uniform within `+-1/sqrt(hidden)`. State: `h [rows, hidden]`. Nothing differs from upstream POPGym.
//!
//! On CUDA a scan is cuDNN's; on the CPU see `recurrent_cpu.rs`.

use tch::nn::Path;
use tch::{Device, Kind, Tensor};

use super::cell_weights::CellWeights;
use super::elementwise::on_cpu;
use super::elman_cpu::ElmanCell;
use super::{HiddenSize, Memory, MemoryKind, Scan, State, recurrent_cpu};
use crate::packing::Packing;

/// One Elman layer.
#[derive(Debug)]
pub struct Elman(CellWeights);

impl MemoryKind for Elman {
    const NAME: &'static str = "elman";
    const PAPER_NAME: &'static str = "Elman";
    const PAPER: &'static str = "Elman, 1990";
    type Options = HiddenSize;

    fn new(path: &Path<'_>, input_width: i64, options: &HiddenSize) -> Result<Self, String> {
        Ok(Self(CellWeights::new(path, 1, input_width, options)?))
    }
}

impl Memory for Elman {
    fn output_width(&self) -> i64 {
        self.0.hidden_size
    }

    fn initial_state(&self, rows: i64, device: Device) -> State {
        State(vec![Tensor::zeros([rows, self.0.hidden_size], (Kind::Float, device))])
    }

    fn step(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        let [weight_input, weight_state, bias_input, bias_state] = self.0.all();
        let next = input.rnn_tanh_cell(&state.0[0], weight_input, weight_state, Some(bias_input), Some(bias_state));
        (next.shallow_clone(), State(vec![next]))
    }

    fn act(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        if !on_cpu(input) {
            return tch::no_grad(|| self.step(input, state));
        }
        recurrent_cpu::step::<ElmanCell>(self.0.all(), input, state)
    }

    fn scan(&self, input: &Tensor, packing: &Packing, state: &State) -> Scan {
        if on_cpu(input) {
            return recurrent_cpu::scan::<ElmanCell>(self.0.all(), input, packing, state);
        }
        let (batch_sizes, initial) = (packing.batch_sizes_tensor(), state.0[0].unsqueeze(0));
        let (output, last) =
            Tensor::rnn_tanh_data(input, &batch_sizes, &initial, &self.0.all(), true, 1, 0.0, true, false);
        Scan { output, state: State(vec![last.squeeze_dim(0)]), computed_steps: packing.rows(), backward: None }
    }
}
