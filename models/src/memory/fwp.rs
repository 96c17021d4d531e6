//! `fwp`: fast weight programmer (Schlag et al., 2021; paper: FWP). Sums of outer products are the weights of a layer.
//!
//! ```text
//! x~ = LayerNorm(x)    k = f(W_k x~)    q = f(W_q x~)    v = W_v x~          f(a) = relu(a) / (1e-5 + sum relu(a))
//! S' = S + v k^T
//! o = S' q
//! y = W_u (relu(L2 relu(L1 o)) + L3 x~) + b
//! ```
//!
//! Parameters: `linear_attention.rs`. State: `S [rows, keys, keys]` (a row for each value).
//!
//! The equations are those of POPGym 1.0.7; the paper's results come from an older form that matched queries with values
//! instead of keys, and had no layers L1 to L3. Neither has Schlag et al.'s delta rule, and the feature map is a
//! normalised ReLU, not their DPFP. Upstream's clamp of the sums to +-1e20 is left out, as in `fart.rs`.

use serde::{Deserialize, Serialize};
use tch::nn::Path;
use tch::{Device, Kind, Tensor};

use super::linear_attention::{self, Layers};
use super::{Memory, MemoryKind, Scan, State};
use crate::packing::Packing;

/// Keeps the norm of a key away from zero.
const EPSILON: f64 = 1e-5;

/// A layer whose weights are a sum.
#[derive(Debug)]
pub struct Fwp {
    hidden_size: i64,
    key_size: i64,
    layers: Layers,
}

/// The options of [`Fwp`].
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FwpOptions {
    /// Width of the output, 1 to 4,096; the paper's is 256.
    pub hidden_size: i64,
    /// Width of keys, queries and values, whose square is the size of the state, 1 to 512; the paper's is 16.
    pub key_size: i64,
}

impl Default for FwpOptions {
    fn default() -> Self {
        Self { hidden_size: 256, key_size: 16 }
    }
}

impl MemoryKind for Fwp {
    const NAME: &'static str = "fwp";
    const PAPER_NAME: &'static str = "FWP";
    const PAPER: &'static str = "Schlag et al., 2021";
    type Options = FwpOptions;

    fn new(path: &Path<'_>, input_width: i64, options: &FwpOptions) -> Result<Self, String> {
        let hidden_size = super::check_hidden_size(options.hidden_size)?;
        let key_size = super::check_size("key_size", options.key_size, 512)?;
        Ok(Self { hidden_size, key_size, layers: Layers::new(path, input_width, key_size, hidden_size) })
    }
}

/// Non-negative parts that add up to almost one.
fn shares(x: &Tensor) -> Tensor {
    let x = x.relu();
    let sum = x.sum_dim_intlist(1, true, None::<Kind>);
    x / (sum + EPSILON)
}

impl Memory for Fwp {
    fn output_width(&self) -> i64 {
        self.hidden_size
    }

    fn initial_state(&self, rows: i64, device: Device) -> State {
        State(vec![Tensor::zeros([rows, self.key_size, self.key_size], (Kind::Float, device))])
    }

    fn positional(&self) -> bool {
        true
    }

    fn step(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        let (norm, [k, q, v]) = self.layers.project(input);
        let (o, sums) = linear_attention::step(&shares(&q), &shares(&k), &v, &state.0[0].transpose(1, 2));
        (self.layers.finish(&o, &norm), State(vec![sums.transpose(1, 2)]))
    }

    fn scan(&self, input: &Tensor, packing: &Packing, state: &State) -> Scan {
        let (norm, [k, q, v]) = self.layers.project(input);
        let sums = state.0[0].transpose(1, 2);
        let (o, last, computed_steps) = linear_attention::scan(&shares(&q), &shares(&k), &v, packing, &sums);
        let (output, state) = (self.layers.finish(&o, &norm), State(vec![last.transpose(1, 2)]));
        Scan { output, state, computed_steps, backward: None }
    }
}
