//! `tcn`: one causal convolution over time (paper: TCN; Bai et al., 2018, with one layer and no dilation).
//!
//! ```text
//! y = sum_{j = 0..3} W_j x_{t - 3 + j} + b          x = 0 before the start; no activation
//! ```
//!
//! `weight [hidden, inputs, window]` (oldest input first, as PyTorch's convolutions have it), `bias [hidden]`. State: the
//! last `window - 1` inputs `[rows, window - 1, inputs]`, oldest first.
//!
//! A scan is one product of all windows and the weight: no slower than the convolution of a padded batch, and without its padding.

use serde::{Deserialize, Serialize};
use tch::nn::Path;
use tch::{Device, Tensor};

use super::windows::{self, Windows};
use super::{Memory, MemoryKind, Scan, State};
use crate::init::uniform;
use crate::packing::Packing;

/// A causal convolution.
#[derive(Debug)]
pub struct Tcn {
    hidden_size: i64,
    window: i64,
    input_width: i64,
    weight: Tensor,
    bias: Tensor,
}

/// The options of [`Tcn`].
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TcnOptions {
    /// Width of the output, 1 to 4,096; the paper's is 256.
    pub hidden_size: i64,
    /// Number of inputs seen at once, the present one included: 2 to 1,024; the paper's is 4.
    pub window: i64,
}

impl Default for TcnOptions {
    fn default() -> Self {
        Self { hidden_size: 256, window: 4 }
    }
}

impl MemoryKind for Tcn {
    const NAME: &'static str = "tcn";
    const PAPER_NAME: &'static str = "TCN";
    const PAPER: &'static str = "Bai et al., 2018";
    type Options = TcnOptions;

    fn new(path: &Path<'_>, input_width: i64, options: &TcnOptions) -> Result<Self, String> {
        let hidden_size = super::check_hidden_size(options.hidden_size)?;
        let window = windows::check_window("window", options.window)?;
        let init = uniform(input_width * window);
        Ok(Self {
            hidden_size,
            window,
            input_width,
            weight: path.var("weight", &[hidden_size, input_width, window], init),
            bias: path.var("bias", &[hidden_size], init),
        })
    }
}

impl Tcn {
    /// `windows [rows, window inputs]`, the oldest input first, to the output.
    fn convolve(&self, windows: &Tensor) -> Tensor {
        let weight = self.weight.transpose(1, 2).reshape([self.hidden_size, -1]);
        windows.linear(&weight, Some(&self.bias))
    }
}

impl Memory for Tcn {
    fn output_width(&self) -> i64 {
        self.hidden_size
    }

    fn initial_state(&self, rows: i64, device: Device) -> State {
        windows::initial_state(rows, self.window, self.input_width, device)
    }

    fn positional(&self) -> bool {
        true
    }

    fn step(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        let (window, next) = windows::slide(input, state, self.window);
        (self.convolve(&window.flatten(1, 2)), next)
    }

    fn scan(&self, input: &Tensor, packing: &Packing, state: &State) -> Scan {
        let windows = Windows::new(input, packing, state, self.window);
        let output = self.convolve(&windows.of(&windows.rows));
        Scan { output, state: windows.last_state(), computed_steps: packing.rows(), backward: None }
    }
}
