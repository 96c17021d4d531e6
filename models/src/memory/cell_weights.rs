//! The weights that elman, lstm and gru have in common, in PyTorch's layout.

use tch::Tensor;
use tch::nn::Path;

use super::{HiddenSize, check_hidden_size};
use crate::init::uniform;

/// Gates lie one after the other along the first dimension. All start uniform within `+-1/sqrt(hidden)`.
#[derive(Debug)]
pub(super) struct CellWeights {
    pub(super) hidden_size: i64,
    /// `[gates hidden, inputs]`.
    input: Tensor,
    /// `[gates hidden, hidden]`.
    state: Tensor,
    /// `[gates hidden]`, as is `bias_state`.
    bias_input: Tensor,
    bias_state: Tensor,
}

impl CellWeights {
    pub(super) fn new(path: &Path<'_>, gates: i64, input_width: i64, options: &HiddenSize) -> Result<Self, String> {
        let hidden_size = check_hidden_size(options.hidden_size)?;
        let init = uniform(hidden_size);
        let rows = gates * hidden_size;
        Ok(Self {
            hidden_size,
            input: path.var("weight_input", &[rows, input_width], init),
            state: path.var("weight_state", &[rows, hidden_size], init),
            bias_input: path.var("bias_input", &[rows], init),
            bias_state: path.var("bias_state", &[rows], init),
        })
    }

    /// `W`, `U`, `b`, `c`, in the order of libtorch's own functions.
    pub(super) fn all(&self) -> [&Tensor; 4] {
        [&self.input, &self.state, &self.bias_input, &self.bias_state]
    }
}
