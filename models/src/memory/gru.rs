//! `gru`: gated recurrent unit (Cho et al., 2014; the variant of cuDNN and PyTorch).
//!
//! ```text
//! r = sigmoid(W_r x + b_r + U_r h + c_r)
//! q = sigmoid(W_q x + b_q + U_q h + c_q)
//! n = tanh(W_n x + b_n + r * (U_n h + c_n))
//! h' = (1 - q) * n + q * h,    y = h'
//! ```
//!
//! On CUDA this is cuDNN's; on the CPU see `recurrent_cpu.rs`.
//!
//! `weight_input [3 hidden, inputs]` and `weight_state [3 hidden, hidden]` hold the gates in the order r, q, n. State:
//! `h [rows, hidden]`.

use tch::nn::Path;
use tch::{Device, Kind, Tensor};

use super::cell_weights::CellWeights;
use super::elementwise::on_cpu;
use super::gru_cpu::GruCell;
use super::{HiddenSize, Memory, MemoryKind, Scan, State, recurrent_cpu};
use crate::packing::Packing;

/// One GRU layer.
#[derive(Debug)]
pub struct Gru(CellWeights);

impl MemoryKind for Gru {
    const NAME: &'static str = "gru";
    const PAPER_NAME: &'static str = "GRU";
    const PAPER: &'static str = "Cho et al., 2014";
    type Options = HiddenSize;

    fn new(path: &Path<'_>, input_width: i64, options: &HiddenSize) -> Result<Self, String> {
        Ok(Self(CellWeights::new(path, 3, input_width, options)?))
    }
}

impl Memory for Gru {
    fn output_width(&self) -> i64 {
        self.0.hidden_size
    }

    fn initial_state(&self, rows: i64, device: Device) -> State {
        State(vec![Tensor::zeros([rows, self.0.hidden_size], (Kind::Float, device))])
    }

    fn step(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        let [weight_input, weight_state, bias_input, bias_state] = self.0.all();
        let next = input.gru_cell(&state.0[0], weight_input, weight_state, Some(bias_input), Some(bias_state));
        (next.shallow_clone(), State(vec![next]))
    }

    fn act(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        if !on_cpu(input) {
            return tch::no_grad(|| self.step(input, state));
        }
        recurrent_cpu::step::<GruCell>(self.0.all(), input, state)
    }

    fn scan(&self, input: &Tensor, packing: &Packing, state: &State) -> Scan {
        if on_cpu(input) {
            return recurrent_cpu::scan::<GruCell>(self.0.all(), input, packing, state);
        }
        let (batch_sizes, initial) = (packing.batch_sizes_tensor(), state.0[0].unsqueeze(0));
        let (output, last) = Tensor::gru_data(input, &batch_sizes, &initial, &self.0.all(), true, 1, 0.0, true, false);
        Scan { output, state: State(vec![last.squeeze_dim(0)]), computed_steps: packing.rows(), backward: None }
    }
}
