//! `frame_stack`: the last few inputs side by side (paper: Fr.Stack; Mnih et al., 2015).
//!
//! ```text
//! f_i = W x_i + b                          i = t - 3 .. t; x_i = 0 before the start, so that f_i = b
//! y = LeakyReLU(W2 LeakyReLU(W1 [f_{t-3}, f_{t-2}, f_{t-1}, f_t] + b1) + b2)
//! ```
//!
//! `frame.weight [hidden / stack, inputs]` (rounded up), `first.weight [hidden, stack frame width]`,
//! `second.weight [hidden, hidden]`. State: the last `stack_size - 1` inputs `[rows, stack - 1, inputs]`, oldest first.
//!
//! A scan projects every input once, not once for each window that it is in.

use serde::{Deserialize, Serialize};
use tch::nn::Path;
use tch::{Device, Tensor};

use super::windows::{self, Windows};
use super::{Memory, MemoryKind, Scan, State};
use crate::init::{Linear, leaky_relu, uniform};
use crate::packing::Packing;

/// A stack of frames.
#[derive(Debug)]
pub struct FrameStack {
    hidden_size: i64,
    stack_size: i64,
    input_width: i64,
    frame: Linear,
    first: Linear,
    second: Linear,
}

/// The options of [`FrameStack`].
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FrameStackOptions {
    /// Width of the output, 1 to 4,096; the paper's is 256. A frame gets `hidden_size / stack_size` numbers, rounded up.
    pub hidden_size: i64,
    /// Number of inputs seen at once, the present one included: 2 to 1,024; the paper's is 4.
    pub stack_size: i64,
}

impl Default for FrameStackOptions {
    fn default() -> Self {
        Self { hidden_size: 256, stack_size: 4 }
    }
}

impl MemoryKind for FrameStack {
    const NAME: &'static str = "frame_stack";
    const PAPER_NAME: &'static str = "Fr.Stack";
    const PAPER: &'static str = "Mnih et al., 2015";
    type Options = FrameStackOptions;

    fn new(path: &Path<'_>, input_width: i64, options: &FrameStackOptions) -> Result<Self, String> {
        let hidden_size = super::check_hidden_size(options.hidden_size)?;
        let stack_size = windows::check_window("stack_size", options.stack_size)?;
        let frame_width = (hidden_size + stack_size - 1) / stack_size;
        let stack_width = frame_width * stack_size;
        Ok(Self {
            hidden_size,
            stack_size,
            input_width,
            frame: Linear::new(&(path / "frame"), input_width, frame_width, uniform(input_width)),
            first: Linear::new(&(path / "first"), stack_width, hidden_size, uniform(stack_width)),
            second: Linear::new(&(path / "second"), hidden_size, hidden_size, uniform(hidden_size)),
        })
    }
}

impl FrameStack {
    /// `[rows, stack width]` to the output.
    fn layers(&self, frames: &Tensor) -> Tensor {
        leaky_relu(self.second.forward(&leaky_relu(self.first.forward(frames))))
    }
}

impl Memory for FrameStack {
    fn output_width(&self) -> i64 {
        self.hidden_size
    }

    fn initial_state(&self, rows: i64, device: Device) -> State {
        windows::initial_state(rows, self.stack_size, self.input_width, device)
    }

    fn positional(&self) -> bool {
        true
    }

    fn step(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        let (window, next) = windows::slide(input, state, self.stack_size);
        (self.layers(&self.frame.forward(&window).flatten(1, 2)), next)
    }

    fn scan(&self, input: &Tensor, packing: &Packing, state: &State) -> Scan {
        let windows = Windows::new(input, packing, state, self.stack_size);
        let output = self.layers(&windows.of(&self.frame.forward(&windows.rows)));
        Scan { output, state: windows.last_state(), computed_steps: packing.rows(), backward: None }
    }
}
