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

use super::elementwise::on_cpu;
use super::gru_cpu::GruCell;
use super::{HiddenSize, Memory, MemoryKind, Scan, State, recurrent_cpu};
use crate::init::uniform;
use crate::packing::Packing;

/// One GRU layer.
#[derive(Debug)]
pub struct Gru {
    hidden_size: i64,
    weight_input: Tensor,
    weight_state: Tensor,
    bias_input: Tensor,
    bias_state: Tensor,
}

impl MemoryKind for Gru {
    const NAME: &'static str = "gru";
    const PAPER_NAME: &'static str = "GRU";
    const PAPER: &'static str = "Cho et al., 2014";
    type Options = HiddenSize;

    fn new(path: &Path<'_>, input_width: i64, options: &HiddenSize) -> Result<Self, String> {
        let hidden_size = super::check_size("hidden_size", options.hidden_size)?;
        let init = uniform(hidden_size);
        let gates = 3 * hidden_size;
        Ok(Self {
            hidden_size,
            weight_input: path.var("weight_input", &[gates, input_width], init),
            weight_state: path.var("weight_state", &[gates, hidden_size], init),
            bias_input: path.var("bias_input", &[gates], init),
            bias_state: path.var("bias_state", &[gates], init),
        })
    }
}

impl Gru {
    fn parameters(&self) -> [&Tensor; 4] {
        [&self.weight_input, &self.weight_state, &self.bias_input, &self.bias_state]
    }
}

impl Memory for Gru {
    fn output_width(&self) -> i64 {
        self.hidden_size
    }

    fn initial_state(&self, rows: i64, device: Device) -> State {
        State(vec![Tensor::zeros([rows, self.hidden_size], (Kind::Float, device))])
    }

    fn step(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        let [weight_input, weight_state, bias_input, bias_state] = self.parameters();
        let next = input.gru_cell(&state.0[0], weight_input, weight_state, Some(bias_input), Some(bias_state));
        (next.shallow_clone(), State(vec![next]))
    }

    fn act(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        if !on_cpu(input) {
            return tch::no_grad(|| self.step(input, state));
        }
        recurrent_cpu::step::<GruCell>(self.parameters(), input, state)
    }

    fn scan(&self, input: &Tensor, packing: &Packing, state: &State) -> Scan {
        if on_cpu(input) {
            return recurrent_cpu::scan::<GruCell>(self.parameters(), input, packing, state);
        }
        let (batch_sizes, initial) = (packing.batch_sizes_tensor(), state.0[0].unsqueeze(0));
        let (output, last) =
            Tensor::gru_data(input, &batch_sizes, &initial, &self.parameters(), true, 1, 0.0, true, false);
        Scan { output, state: State(vec![last.squeeze_dim(0)]), computed_steps: packing.rows(), backward: None }
    }
}
