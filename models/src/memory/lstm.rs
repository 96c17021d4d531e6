//! `lstm`: long short-term memory (Hochreiter and Schmidhuber, 1997; with the forget gate of Gers et al., 2000, as in PyTorch).
//!
//! ```text
//! i = sigmoid(W_i x + b_i + U_i h + d_i)    f, o likewise
//! g = tanh(W_g x + b_g + U_g h + d_g)
//! c' = f * c + i * g
//! h' = o * tanh(c'),    y = h'
//! ```
//!
//! `weight_input [4 hidden, inputs]` (W), `weight_state [4 hidden, hidden]` (U), `bias_input` (b) and `bias_state
//! [4 hidden]` (d) hold the gates in the order i, f, g, o; all start uniform within `+-1/sqrt(hidden)`, the forget gate's
//! biases too. State: `h` and `c`, `[rows, hidden]` each. Nothing differs from upstream POPGym.
//!
//! On CUDA a scan is cuDNN's; on the CPU see `recurrent_cpu.rs`.

use tch::nn::Path;
use tch::{Device, Kind, Tensor};

use super::cell_weights::CellWeights;
use super::elementwise::on_cpu;
use super::lstm_cpu::LstmCell;
use super::{HiddenSize, Memory, MemoryKind, Scan, State, recurrent_cpu};
use crate::packing::Packing;

/// One LSTM layer.
#[derive(Debug)]
pub struct Lstm(CellWeights);

impl MemoryKind for Lstm {
    const NAME: &'static str = "lstm";
    const PAPER_NAME: &'static str = "LSTM";
    const PAPER: &'static str = "Hochreiter and Schmidhuber, 1997";
    type Options = HiddenSize;

    fn new(path: &Path<'_>, input_width: i64, options: &HiddenSize) -> Result<Self, String> {
        Ok(Self(CellWeights::new(path, 4, input_width, options)?))
    }
}

impl Memory for Lstm {
    fn output_width(&self) -> i64 {
        self.0.hidden_size
    }

    fn initial_state(&self, rows: i64, device: Device) -> State {
        let zeros = || Tensor::zeros([rows, self.0.hidden_size], (Kind::Float, device));
        State(vec![zeros(), zeros()])
    }

    fn step(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        let [weight_input, weight_state, bias_input, bias_state] = self.0.all();
        let (h, c) = input.lstm_cell(
            &[&state.0[0], &state.0[1]],
            weight_input,
            weight_state,
            Some(bias_input),
            Some(bias_state),
        );
        (h.shallow_clone(), State(vec![h, c]))
    }

    fn act(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        if !on_cpu(input) {
            return tch::no_grad(|| self.step(input, state));
        }
        recurrent_cpu::step::<LstmCell>(self.0.all(), input, state)
    }

    fn scan(&self, input: &Tensor, packing: &Packing, state: &State) -> Scan {
        if on_cpu(input) {
            return recurrent_cpu::scan::<LstmCell>(self.0.all(), input, packing, state);
        }
        let initial = [state.0[0].unsqueeze(0), state.0[1].unsqueeze(0)];
        let (output, h, c) = Tensor::lstm_data(
            input,
            &packing.batch_sizes_tensor(),
            &initial.each_ref(),
            &self.0.all(),
            true,
            1,
            0.0,
            true,
            false,
        );
        let state = State(vec![h.squeeze_dim(0), c.squeeze_dim(0)]);
        Scan { output, state, computed_steps: packing.rows(), backward: None }
    }
}
