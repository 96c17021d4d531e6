//! A memory of one's own: leaky integrators. Each unit forgets at a pace that it learns.
//!
//! ```text
//! h' = d * h + (1 - d) * tanh(W x + b),   d = sigmoid(a)
//! y  = LeakyReLU(V [x; h'] + c)
//! ```
//!
//! The state is `h [rows, hidden]`. Only `step` is written; whole sequences follow from it.

use popgym_models::State;
use popgym_models::memory::{HiddenSize, Memory, MemoryKind};
use tch::nn::{Init, Linear, LinearConfig, Module as _, Path, linear};
use tch::{Device, Kind, Tensor};

/// Leaky integrators.
#[derive(Debug)]
pub(crate) struct Decay {
    hidden_size: i64,
    input: Linear,
    output: Linear,
    pace: Tensor,
}

impl MemoryKind for Decay {
    const NAME: &'static str = "decay";
    const PAPER_NAME: &'static str = "Decay";
    const PAPER: &'static str = "this example";
    type Options = HiddenSize;

    fn new(path: &Path<'_>, input_width: i64, options: &HiddenSize) -> Result<Self, String> {
        let hidden_size = options.hidden_size;
        if !(1..=4096).contains(&hidden_size) {
            return Err(format!("`hidden_size` is {hidden_size}, allowed is 1..=4096"));
        }
        let config = LinearConfig::default();
        Ok(Self {
            hidden_size,
            input: linear(path / "input", input_width, hidden_size, config),
            output: linear(path / "output", input_width + hidden_size, hidden_size, config),
            // Half-lives of 1 to 100 steps.
            pace: path.var("pace", &[hidden_size], Init::Uniform { lo: 0.0, up: 5.0 }),
        })
    }
}

impl Memory for Decay {
    fn output_width(&self) -> i64 {
        self.hidden_size
    }

    fn initial_state(&self, rows: i64, device: Device) -> State {
        State(vec![Tensor::zeros([rows, self.hidden_size], (Kind::Float, device))])
    }

    fn step(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        let next = self.input.forward(input).tanh().lerp_tensor(&state.0[0], &self.pace.sigmoid());
        let output = self.output.forward(&Tensor::cat(&[input, &next], 1)).leaky_relu();
        (output, State(vec![next]))
    }
}
