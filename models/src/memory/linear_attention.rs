//! Attention without a softmax: what `fart` and `fwp` share.
//!
//! ```text
//! x~ = LayerNorm(x)
//! k = W_k x~    q = W_q x~    v = W_v x~              then each memory's own feature map of k and q
//! o_t = sum_{s <= t} (q_t . k_s) v_s = q_t S_t        S_t = S_{t-1} + k_t v_t^T
//! y = W_u (relu(L2 relu(L1 o)) + L3 x~) + b
//! ```
//!
//! `key, query, value [key size, inputs]` without biases, `first, second [key size, key size]` (L1, L2),
//! `shortcut [key size, inputs]` (L3), `output [hidden, key size]` (W_u), all with biases.

use tch::nn::{Init, Path};
use tch::{Kind, Tensor};

use crate::chunks::Chunks;
use crate::init::{Linear, uniform};
use crate::packing::Packing;

/// Steps that attend to each other directly; those of earlier chunks are seen through their sum.
const CHUNK: i64 = 64;

/// All layers around the sums.
#[derive(Debug)]
pub(super) struct Layers {
    input_width: i64,
    norm_weight: Tensor,
    norm_bias: Tensor,
    key: Tensor,
    query: Tensor,
    value: Tensor,
    first: Linear,
    second: Linear,
    shortcut: Linear,
    output: Linear,
}

impl Layers {
    pub(super) fn new(path: &Path<'_>, input_width: i64, key_size: i64, hidden_size: i64) -> Self {
        let projection = |name: &str| path.var(name, &[key_size, input_width], uniform(input_width));
        let linear = |name: &str, inputs, outputs| Linear::new(&(path / name), inputs, outputs, uniform(inputs));
        Self {
            input_width,
            norm_weight: path.var("norm_weight", &[input_width], Init::Const(1.0)),
            norm_bias: path.var("norm_bias", &[input_width], Init::Const(0.0)),
            key: projection("key"),
            query: projection("query"),
            value: projection("value"),
            first: linear("first", key_size, key_size),
            second: linear("second", key_size, key_size),
            shortcut: linear("shortcut", input_width, key_size),
            output: linear("output", key_size, hidden_size),
        }
    }

    /// `x [rows, inputs]` to x~ and `[k, q, v]`, each `[rows, key size]`.
    pub(super) fn project(&self, x: &Tensor) -> (Tensor, [Tensor; 3]) {
        let norm = x.layer_norm([self.input_width], Some(&self.norm_weight), Some(&self.norm_bias), 1e-5, false);
        let weight = Tensor::cat(&[&self.key, &self.query, &self.value], 0);
        let kqv = norm.linear(&weight, None::<&Tensor>).chunk(3, 1).try_into().expect("three equal parts");
        (norm, kqv)
    }

    /// `o [rows, key size]` and x~ to y.
    pub(super) fn finish(&self, o: &Tensor, norm: &Tensor) -> Tensor {
        let inner = self.second.forward(&self.first.forward(o).relu()).relu();
        self.output.forward(&(inner + self.shortcut.forward(norm)))
    }
}

/// One step: `q, k [rows, keys]`, `v [rows, values]`, `sums [rows, keys, values]` to o and the next sums.
pub(super) fn step(q: &Tensor, k: &Tensor, v: &Tensor, sums: &Tensor) -> (Tensor, Tensor) {
    let sums = sums + k.unsqueeze(2) * v.unsqueeze(1);
    ((q.unsqueeze(2) * &sums).sum_dim_intlist(1, false, None::<Kind>), sums)
}

/// Whole sequences: packed `q, k [rows, keys]`, `v [rows, values]`, first sums `[sequences, keys, values]` to o, the last
/// sums, and the number of steps computed.
///
/// Within a chunk `o = tril(Q K^T) V + Q S`, with S the sum before the chunk: memory grows with rows times chunk, not with
/// rows times keys times values.
pub(super) fn scan(q: &Tensor, k: &Tensor, v: &Tensor, packing: &Packing, sums: &Tensor) -> (Tensor, Tensor, i64) {
    let chunks = Chunks::new(packing, CHUNK, q.device());
    let (keys, values) = (q.size()[1], v.size()[1]);
    let parts = chunks.cut(&Tensor::cat(&[q, k, v], 1)).split_with_sizes([keys, keys, values], 2);
    let [q, k, v] = &parts[..] else { unreachable!("three sizes were asked for") };
    let added = k.transpose(1, 2).bmm(v);
    let (before, after) = chunks.carry(sums, &added, 0, |sums, added| sums + added);
    let scores = q.bmm(&k.transpose(1, 2)).tril(0);
    let o = scores.bmm(v).baddbmm(q, &before, 1.0, 1.0);
    (chunks.join(&o), after, chunks.rows())
}
