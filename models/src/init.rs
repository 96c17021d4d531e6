//! First weights (reference: the paper's code; PyTorch's default for linear layers).

use tch::Tensor;
use tch::nn::{Init, Path};

/// A linear layer `y = x W^T + b`.
#[derive(Debug)]
pub(crate) struct Linear {
    weight: Tensor,
    bias: Tensor,
}

impl Linear {
    /// `weight [outputs, inputs]` drawn from `init`, `bias [outputs]` uniform within `+-1/sqrt(inputs)`.
    pub(crate) fn new(path: &Path<'_>, inputs: i64, outputs: i64, init: Init) -> Self {
        Self {
            weight: path.var("weight", &[outputs, inputs], init),
            bias: path.var("bias", &[outputs], uniform(inputs)),
        }
    }

    /// Weight and bias.
    pub(crate) fn parameters(&self) -> [&Tensor; 2] {
        [&self.weight, &self.bias]
    }

    /// `x [rows, inputs]` to `[rows, outputs]`.
    pub(crate) fn forward(&self, x: &Tensor) -> Tensor {
        x.linear(&self.weight, Some(&self.bias))
    }
}

/// Orthogonal with gain 1 (Saxe et al., 2014).
pub(crate) const ORTHOGONAL: Init = Init::Orthogonal { gain: 1.0 };

/// Uniform within `+-1/sqrt(fan_in)`: PyTorch's default for the weights and biases of linear and recurrent layers.
pub(crate) fn uniform(fan_in: i64) -> Init {
    let bound = 1.0 / (fan_in as f64).sqrt();
    Init::Uniform { lo: -bound, up: bound }
}

/// Normal with mean 0 and standard deviation 0.01, for the last layer of a head: a nearly uniform first policy.
pub(crate) const SMALL_NORMAL: Init = Init::Randn { mean: 0.0, stdev: 0.01 };

/// Leaky ReLU with slope 0.01, in place: at these sizes a fresh tensor costs about as much as the function.
pub(crate) fn leaky_relu(mut x: Tensor) -> Tensor {
    x.leaky_relu_()
}
