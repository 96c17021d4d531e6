//! The GRU on the CPU: a loop over time with a backward of its own.
//!
//! libtorch's packed GRU adds to the weights' gradients at every time step, and its backward takes three times its
//! forward. Here a time step needs one matrix product forward and one backward; all else is one product for all rows.
//! For each row, with `a` the input part of the gates and `s` the state part:
//!
//! ```text
//! a = W x + b                                                 all rows at once
//! s = U h                                                     step by step, like all that follows
//! r = sigmoid(a_r + s_r + c_r)    q = sigmoid(a_q + s_q + c_q)
//! m = s_n + c_n                   n = tanh(a_n + r m)
//! h' = n + q (h - n)
//!
//! dn = dh' (1 - q) (1 - n^2)      dq = dh' (h - n) q (1 - q)    dr = dn m r (1 - r)
//! da = [dr, dq, dn]               ds = [dr, dq, dn r]
//! dh = dh' q + ds U
//! dW = da^T x    dU = ds^T h    db = sum da    dc = sum ds    dx = da W     all rows at once
//! ```
//!
//! The products are libtorch's; the rest is plain Rust (`elementwise.rs`).

// Only inlined code is compiled for the caller's instruction set.
#![allow(clippy::inline_always)]

use std::ops::Range;

use tch::{Device, Kind, Tensor};

use super::elementwise::{floats, floats_mut, sigmoid, tanh, widest};
use super::{Backward, Scan, State, add_gradients};
use crate::packing::Packing;

/// `W [3 hidden, inputs]`, `U [3 hidden, hidden]`, `b`, `c`; gates in the order r, q, n.
pub(super) type Parameters<'a> = [&'a Tensor; 4];

/// One time step, without gradients: `input [rows, inputs]` and `state [rows, hidden]` to the next state.
pub(super) fn step([w, u, b, c]: Parameters<'_>, input: &Tensor, state: &Tensor) -> Tensor {
    tch::no_grad(|| {
        let state = state.contiguous();
        let (mut a, mut s) = (b.addmm(input, &w.tr()), state.mm(&u.tr()));
        let mut next = empty(state.size()[0], state.size()[1]);
        forward(floats_mut(&mut a), floats_mut(&mut s), floats(c), floats(&state), floats_mut(&mut next));
        next
    })
}

/// Whole sequences: packed `input [rows, inputs]`, `initial [sequences, hidden]`. If `input` wants gradients, what the
/// backward needs is kept.
pub(super) fn scan(parameters: Parameters<'_>, input: &Tensor, packing: &Packing, initial: &Tensor) -> Scan {
    let keep = input.requires_grad();
    tch::no_grad(|| {
        let [w, u, b, c] = parameters;
        let hidden = initial.size()[1];
        let transposed = u.tr();
        let a = b.addmm(input, &w.tr());
        let s = empty(if keep { packing.rows() } else { packing.sequences() }, 3 * hidden);
        let output = empty(packing.rows(), hidden);
        let mut before = initial.contiguous();
        let mut states = Vec::new();
        for now in packing.steps() {
            let alive = 0..now.len();
            let h = narrow(&before, &alive);
            let (mut a, mut next) = (narrow(&a, &now), narrow(&output, &now));
            let mut s = narrow(&s, if keep { &now } else { &alive });
            let _ = h.mm_out(&s, &transposed);
            forward(floats_mut(&mut a), floats_mut(&mut s), floats(c), floats(&h), floats_mut(&mut next));
            states.push(h);
            before = next;
        }
        let last = output.index_select(0, &packing.last_rows());
        let backward = keep.then(|| {
            let tape = Tape {
                parameters: parameters.map(Tensor::shallow_clone),
                steps: packing.steps().collect(),
                input: input.detach(),
                h: Tensor::cat(&states, 0),
                a,
                s,
            };
            Box::new(move |grad_output: &Tensor| tape.backward(grad_output)) as Backward
        });
        Scan { output, state: State(vec![last]), computed_steps: packing.rows(), backward }
    })
}

/// What the backward needs, a row for each packed row.
struct Tape {
    parameters: [Tensor; 4],
    steps: Vec<Range<usize>>,
    input: Tensor,
    /// States before each step.
    h: Tensor,
    /// r, q, n; then da.
    a: Tensor,
    /// Two thirds of no use, m; then ds.
    s: Tensor,
}

impl Tape {
    /// From d loss / d output to d loss / d input; adds to the parameters' gradients.
    fn backward(self, grad_output: &Tensor) -> Tensor {
        let [w, u, b, c] = &self.parameters;
        let (gradients, grad_input) = tch::no_grad(|| {
            let grad_output = grad_output.contiguous();
            let hidden = self.h.size()[1];
            // d loss / d state after the step, but for what comes through the step's own output.
            let dh = Tensor::zeros([self.steps[0].len() as i64, hidden], (Kind::Float, Device::Cpu));
            for now in self.steps.iter().rev() {
                let (mut a, mut s, mut dh) = (narrow(&self.a, now), narrow(&self.s, now), narrow(&dh, &(0..now.len())));
                let (h, grad_output) = (narrow(&self.h, now), narrow(&grad_output, now));
                let (h, grad_output) = (floats(&h), floats(&grad_output));
                let width = hidden as usize;
                backward(floats_mut(&mut a), floats_mut(&mut s), h, grad_output, floats_mut(&mut dh), width);
                if now.start > 0 {
                    let _ = dh.addmm_(&s, u);
                }
            }
            let (da, ds) = (&self.a, &self.s);
            let sum = |x: &Tensor| x.sum_dim_intlist(0, false, Kind::Float);
            ([da.tr().mm(&self.input), ds.tr().mm(&self.h), sum(da), sum(ds)], da.mm(w))
        });
        add_gradients(&[w, u, b, c], &gradients);
        grad_input
    }
}

fn narrow(tensor: &Tensor, rows: &Range<usize>) -> Tensor {
    tensor.narrow(0, rows.start as i64, rows.len() as i64)
}

fn empty(rows: i64, width: i64) -> Tensor {
    Tensor::empty([rows, width], (Kind::Float, Device::Cpu))
}

widest! {
    /// Gates and next state of some rows. Turns `a` into r, q, n and the last third of `s` into m.
    fn forward(a: &mut [f32], s: &mut [f32], c: &[f32], h: &[f32], next: &mut [f32]) = forward_rows
}

// Loops as short as these, with one slice written and few read, are vectorised.
#[inline(always)]
fn forward_rows(a: &mut [f32], s: &mut [f32], c: &[f32], h: &[f32], next: &mut [f32]) {
    let hidden = c.len() / 3;
    let (c_rq, c_n) = c.split_at(2 * hidden);
    let gates = a.chunks_exact_mut(3 * hidden).zip(s.chunks_exact_mut(3 * hidden));
    for ((a, s), (h, next)) in gates.zip(h.chunks_exact(hidden).zip(next.chunks_exact_mut(hidden))) {
        let (rq, n) = a.split_at_mut(2 * hidden);
        let (s_rq, m) = s.split_at_mut(2 * hidden);
        for ((rq, s), c) in rq.iter_mut().zip(s_rq).zip(c_rq) {
            *rq = sigmoid(*rq + (*s + c));
        }
        let (r, q) = rq.split_at(hidden);
        for (m, c) in m.iter_mut().zip(c_n) {
            *m += c;
        }
        for ((n, m), r) in n.iter_mut().zip(m).zip(r) {
            *n = tanh(*n + r * *m);
        }
        for (((next, h), n), q) in next.iter_mut().zip(h).zip(n).zip(q) {
            *next = *n + q * (h - *n);
        }
    }
}

widest! {
    /// Gradients of the gates of some rows. Turns `a` (r, q, n) into da and `s` (its last third m) into ds, and `dh` of the
    /// state after the step, to which `grad_output` is yet to be added, into the direct part of dh before it.
    fn backward(a: &mut [f32], s: &mut [f32], h: &[f32], grad_output: &[f32], dh: &mut [f32], hidden: usize) = backward_rows
}

#[inline(always)]
fn backward_rows(a: &mut [f32], s: &mut [f32], h: &[f32], grad_output: &[f32], dh: &mut [f32], hidden: usize) {
    let gates = a.chunks_exact_mut(3 * hidden).zip(s.chunks_exact_mut(3 * hidden));
    let states = h.chunks_exact(hidden).zip(grad_output.chunks_exact(hidden)).zip(dh.chunks_exact_mut(hidden));
    for ((a, s), ((h, grad_output), dh)) in gates.zip(states) {
        for (dh, grad) in dh.iter_mut().zip(grad_output) {
            *dh += grad;
        }
        {
            let (rq, n) = a.split_at_mut(2 * hidden);
            let (r, q) = rq.split_at(hidden);
            let (dr_dq, m) = s.split_at_mut(2 * hidden);
            let (dr, dq) = dr_dq.split_at_mut(hidden);
            for ((((dq, dh), h), n), q) in dq.iter_mut().zip(&*dh).zip(h).zip(&*n).zip(q) {
                *dq = dh * (h - n) * (q * (1.0 - q));
            }
            for ((n, dh), q) in n.iter_mut().zip(&*dh).zip(q) {
                *n = dh * (1.0 - q) * (1.0 - *n * *n);
            }
            let dn = n;
            for (((dr, dn), m), r) in dr.iter_mut().zip(&*dn).zip(&*m).zip(r) {
                *dr = dn * m * (r * (1.0 - r));
            }
            for ((m, dn), r) in m.iter_mut().zip(&*dn).zip(r) {
                *m = dn * r;
            }
            for (dh, q) in dh.iter_mut().zip(q) {
                *dh *= q;
            }
        }
        a[..2 * hidden].copy_from_slice(&s[..2 * hidden]);
    }
}

#[cfg(test)]
mod tests {
    use super::{backward, backward_rows, forward, forward_rows};

    fn numbers(n: usize, seed: usize) -> Vec<f32> {
        (0..n).map(|i| ((i * 7919 + seed * 104_729) % 10_007) as f32 / 1_000.0 - 5.0).collect()
    }

    /// The machine's widest vectors, no vectors but those of every machine, and one number at a time.
    #[test]
    fn every_instruction_set_gives_the_same_bits() {
        const ROWS: usize = 3;
        for hidden in [1, 3, 8, 16, 19, 64, 255, 256] {
            let (a, s, c) = (numbers(ROWS * 3 * hidden, 0), numbers(ROWS * 3 * hidden, 1), numbers(3 * hidden, 2));
            let (h, grad) = (numbers(ROWS * hidden, 3), numbers(ROWS * hidden, 4));
            let run = |wide: bool| {
                let (mut a, mut s, mut next, mut dh) = (a.clone(), s.clone(), h.clone(), h.clone());
                (if wide { forward } else { forward_rows })(&mut a, &mut s, &c, &h, &mut next);
                let gates = a.clone();
                (if wide { backward } else { backward_rows })(&mut a, &mut s, &h, &grad, &mut dh, hidden);
                [gates, a, s, next, dh].map(|x| x.iter().map(|x| x.to_bits()).collect::<Vec<_>>())
            };
            assert_eq!(run(true), run(false), "hidden {hidden}");
            // A unit alone is the scalar tail of a loop.
            let (row, unit) = (ROWS - 1, hidden - 1);
            let at = |x: &[f32], gate: usize| x[(row * 3 + gate) * hidden + unit];
            let (mut a, mut s) = ([0, 1, 2].map(|gate| at(&a, gate)), [0, 1, 2].map(|gate| at(&s, gate)));
            let c = [0, 1, 2].map(|gate| c[gate * hidden + unit]);
            let mut next = [0.0];
            forward(&mut a, &mut s, &c, &[h[row * hidden + unit]], &mut next);
            assert_eq!(next[0].to_bits(), run(true)[3][row * hidden + unit], "hidden {hidden}");
        }
    }
}
