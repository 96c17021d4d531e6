//! `fart`: linear attention with the feature map ELU + 1 ("Transformers are RNNs: fast autoregressive transformers with linear
//! attention", Katharopoulos et al., 2020; paper: FART).
//!
//! ```text
//! x~ = LayerNorm(x)    k = ELU(W_k x~) + 1    q = ELU(W_q x~) + 1    v = W_v x~
//! S' = S + k v^T       Z' = Z + k
//! o = q S' / (q . Z' + 1e-5)
//! y = W_u (relu(L2 relu(L1 o)) + L3 x~) + b
//! ```
//!
//! Parameters: `linear_attention.rs`. State: `S [rows, keys, keys]` (a row for each key) and `Z [rows, keys]`.
//!
//! The equations are those of POPGym 1.0.7; the paper's results come from an older form, with another denominator and
//! without the layers L1 to L3. Upstream clamps the sums of a batch's new terms to +-1e20 when it adds them up in one piece.
//! After a LayerNorm terms are no larger than the weights, so nothing comes near it; a clamp would only make the result
//! depend on how a sequence is cut, and is left out.

use serde::{Deserialize, Serialize};
use tch::nn::Path;
use tch::{Device, Kind, Tensor};

use super::linear_attention::{self, Layers};
use super::{Memory, MemoryKind, Scan, State};
use crate::packing::Packing;

/// Keeps the denominator away from zero.
const EPSILON: f64 = 1e-5;

/// Linear attention.
#[derive(Debug)]
pub struct Fart {
    hidden_size: i64,
    key_size: i64,
    layers: Layers,
}

/// The options of [`Fart`].
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FartOptions {
    /// Width of the output, 1 to 4,096; the paper's is 256.
    pub hidden_size: i64,
    /// Width of keys, queries and values, whose square is the size of the state, 1 to 512; POPGym's is 15 (16 in the paper).
    pub key_size: i64,
}

impl Default for FartOptions {
    fn default() -> Self {
        Self { hidden_size: 256, key_size: 15 }
    }
}

impl MemoryKind for Fart {
    const NAME: &'static str = "fart";
    const PAPER_NAME: &'static str = "FART";
    const PAPER: &'static str = "Katharopoulos et al., 2020";
    type Options = FartOptions;

    fn new(path: &Path<'_>, input_width: i64, options: &FartOptions) -> Result<Self, String> {
        let hidden_size = super::check_hidden_size(options.hidden_size)?;
        let key_size = super::check_size("key_size", options.key_size, 512)?;
        Ok(Self { hidden_size, key_size, layers: Layers::new(path, input_width, key_size, hidden_size) })
    }
}

/// ELU + 1.
fn positive(x: &Tensor) -> Tensor {
    x.elu() + 1.0
}

impl Memory for Fart {
    fn output_width(&self) -> i64 {
        self.hidden_size
    }

    fn initial_state(&self, rows: i64, device: Device) -> State {
        let zeros = |shape: &[i64]| Tensor::zeros(shape, (Kind::Float, device));
        State(vec![zeros(&[rows, self.key_size, self.key_size]), zeros(&[rows, self.key_size])])
    }

    fn positional(&self) -> bool {
        true
    }

    fn step(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        let (norm, [k, q, v]) = self.layers.project(input);
        let (k, q) = (positive(&k), positive(&q));
        let (o, sums) = linear_attention::step(&q, &k, &v, &state.0[0]);
        let keys = &state.0[1] + k;
        let scale = (q * &keys).sum_dim_intlist(1, true, None::<Kind>) + EPSILON;
        (self.layers.finish(&(o / scale), &norm), State(vec![sums, keys]))
    }

    fn scan(&self, input: &Tensor, packing: &Packing, state: &State) -> Scan {
        let (norm, [k, q, v]) = self.layers.project(input);
        let (k, q) = (positive(&k), positive(&q));
        // Z is the sum for a value that is always one.
        let v = Tensor::cat(&[&v, &v.new_ones([v.size()[0], 1], (v.kind(), v.device()))], 1);
        let sums = Tensor::cat(&[&state.0[0], &state.0[1].unsqueeze(2)], 2);
        let (o, last, computed_steps) = linear_attention::scan(&q, &k, &v, packing, &sums);
        let scale = o.narrow(1, self.key_size, 1) + EPSILON;
        let output = self.layers.finish(&(o.narrow(1, 0, self.key_size) / scale), &norm);
        let state = State(vec![last.narrow(2, 0, self.key_size), last.select(2, self.key_size)]);
        Scan { output, state, computed_steps, backward: None }
    }
}
