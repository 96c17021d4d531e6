//! The LMU over whole sequences on the CPU: a backward of its own.
//!
//! The forward follows `lmu.rs` product by product. The backward needs one product a step. With `v = [m, h]` and `p` what
//! the tanh is taken of, `[m', p] = G v + ...`:
//!
//! ```text
//! G = [     A + B e_m              B e_h      ]
//!     [W_m (A + B e_m)     W_h + W_m B e_h    ]
//! ```
//!
//! and `D = [dm', dp]`, in which dm' does not hold what comes through p of the same step:
//!
//! ```text
//! dp = dh' (1 - h'^2),   dv = D G             step by step
//! dW_x = dp^T x    dW_h = dp^T h    dW_m = dp^T m'            all rows at once, like all that follows
//! du = (dm' + dp W_m) B
//! de_x = du^T x    de_h = du^T h    de_m = du^T m             dx = dp W_x + du e_x
//! ```

// Only inlined code is compiled for the caller's instruction set.
#![allow(clippy::inline_always)]

use tch::{Kind, Tensor};

use super::elementwise::{floats, floats_mut, widest};
use super::lmu::Parameters;
use super::trajectory::{Step, Trajectory, narrow};
use super::{Backward, Scan, State, add_gradients};
use crate::packing::Packing;

/// Whole sequences: packed `input [rows, inputs]`. If `input` wants gradients, what the backward needs is kept.
pub(super) fn scan(parameters: &Parameters, input: &Tensor, packing: &Packing, initial: &State) -> Scan {
    let keep = input.requires_grad();
    tch::no_grad(|| {
        let (memory, hidden) = (parameters.window.size()[0], parameters.weight_state.size()[0]);
        let p = parameters;
        let g = combined(p);
        let v = Trajectory::new(packing, &Tensor::cat(&[&initial.0[1], &initial.0[0]], 1));
        let _ = v.after().narrow(1, 0, memory).zero_();
        v.after().narrow(1, memory, hidden).copy_(&input.mm(&parameters.weight_input.tr()));
        let u = dot(input, &p.encoder_input);
        let steps = Step::all(packing);
        for step in &steps {
            let (before, after) = (v.before(step), v.after_step(step));
            let (m, h) = (before.narrow(1, 0, memory), before.narrow(1, memory, hidden));
            let next = (after.narrow(1, 0, memory), after.narrow(1, memory, hidden));
            advance(p, &narrow(&u, &step.now), (&m, &h), next);
        }
        let output = v.after().narrow(1, memory, hidden).contiguous();
        let last = v.after().index_select(0, &packing.last_rows());
        let state = State(vec![last.narrow(1, memory, hidden).contiguous(), last.narrow(1, 0, memory).contiguous()]);
        let backward = keep.then(|| {
            let tape = Tape { parameters: parameters.shallow_clone(), input: input.detach(), steps, g, v };
            Box::new(move |grad_output: &Tensor| tape.backward(grad_output)) as Backward
        });
        Scan { output, state, computed_steps: packing.rows(), backward }
    })
}

/// One time step, without gradients.
pub(super) fn act(p: &Parameters, input: &Tensor, state: &State) -> (Tensor, State) {
    tch::no_grad(|| {
        let (h, m) = (&state.0[0], &state.0[1]);
        let (next_m, next_h) = (m.zeros_like(), input.mm(&p.weight_input.tr()));
        advance(p, &dot(input, &p.encoder_input), (m, h), (next_m.shallow_clone(), next_h.shallow_clone()));
        (next_h.shallow_clone(), State(vec![next_h, next_m]))
    })
}

/// From m and h to m', which is 0 before, and h', which is W_x x before; `u` is e_x . x.
fn advance(p: &Parameters, u: &Tensor, (m, h): (&Tensor, &Tensor), (mut next_m, mut next_h): (Tensor, Tensor)) {
    // Not copied: products with a transposed view add up in another order, and are several times as accurate.
    let [window, w_h, w_m] = [&p.window, &p.weight_state, &p.weight_memory].map(Tensor::tr);
    let u = u + dot(h, &p.encoder_state) + dot(m, &p.encoder_memory);
    let _ = next_m.addmm_(m, &window).addmm_(&u, &p.window_input);
    let _ = next_h.addmm_(h, &w_h).addmm_(&next_m, &w_m).tanh_();
}

/// `e . x` of each row, as in `lmu.rs`.
fn dot(x: &Tensor, e: &Tensor) -> Tensor {
    (x * e).sum_dim_intlist(1, true, None::<Kind>)
}

/// G, computed in f64.
fn combined(parameters: &Parameters) -> Tensor {
    let wide = |x: &Tensor| x.to_kind(Kind::Double);
    let (b, w_m) = (wide(&parameters.window_input).tr(), wide(&parameters.weight_memory));
    let from_m = wide(&parameters.window) + b.mm(&wide(&parameters.encoder_memory));
    let from_h = b.mm(&wide(&parameters.encoder_state));
    let p = Tensor::cat(&[w_m.mm(&from_m), wide(&parameters.weight_state) + w_m.mm(&from_h)], 1);
    Tensor::cat(&[Tensor::cat(&[from_m, from_h], 1), p], 0).to_kind(Kind::Float)
}

/// What the backward needs.
struct Tape {
    parameters: Parameters,
    input: Tensor,
    steps: Vec<Step>,
    g: Tensor,
    v: Trajectory,
}

impl Tape {
    /// From d loss / d output to d loss / d input; adds to the parameters' gradients.
    fn backward(mut self, grad_output: &Tensor) -> Tensor {
        let (gradients, grad_input) = tch::no_grad(|| {
            let d = self.backward_in_time(&grad_output.contiguous());
            let p = &self.parameters;
            let (memory, hidden) = (p.window.size()[0], p.weight_state.size()[0]);
            let halves = |x: &Tensor| (x.narrow(1, 0, memory), x.narrow(1, memory, hidden));
            let (dm, dp) = halves(&d);
            let (m, h) = halves(&self.v.all_before(&self.steps));
            let next_m = self.v.after().narrow(1, 0, memory);
            let du = dm.addmm(&dp, &p.weight_memory).mm(&p.window_input.tr());
            let gradients = [
                du.tr().mm(&self.input),
                du.tr().mm(&h),
                du.tr().mm(&m),
                dp.tr().mm(&self.input),
                dp.tr().mm(&h),
                dp.tr().mm(&next_m),
            ];
            (gradients, dp.mm(&p.weight_input).addmm_(&du, &p.encoder_input))
        });
        add_gradients(&self.parameters.learned(), &gradients);
        grad_input
    }

    /// `D`, `[rows, memory + hidden]`.
    fn backward_in_time(&mut self, grad_output: &Tensor) -> Tensor {
        let hidden = self.parameters.weight_state.size()[0] as usize;
        let memory = self.parameters.window.size()[0] as usize;
        let mut d = Tensor::zeros_like(&self.v.after());
        for step in self.steps.iter().rev() {
            let now = &step.now;
            let next = self.v.slices(step).1;
            let rows = &mut floats_mut(&mut d)[now.start * (memory + hidden)..now.end * (memory + hidden)];
            backward(rows, &floats(grad_output)[now.start * hidden..now.end * hidden], next, memory, hidden);
            if let Some(before) = self.v.rows_before(step) {
                let _ = narrow(&d, now).mm_out(&narrow(&d, &before), &self.g);
            }
        }
        d
    }
}

widest! {
    /// Turns `[dm', dh']` of some rows, without what comes from the output, into `[dm', dp]`; `next` is `[m', h']`.
    fn backward(d: &mut [f32], grad_output: &[f32], next: &[f32], memory: usize, hidden: usize) = backward_rows
}

#[inline(always)]
fn backward_rows(d: &mut [f32], grad_output: &[f32], next: &[f32], memory: usize, hidden: usize) {
    let width = memory + hidden;
    let rows = d.chunks_exact_mut(width).zip(next.chunks_exact(width)).zip(grad_output.chunks_exact(hidden));
    for ((d, next), grad) in rows {
        for ((d, grad), h) in d[memory..].iter_mut().zip(grad).zip(&next[memory..]) {
            *d = (*d + grad) * (1.0 - h * h);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::elementwise::numbers;
    use super::{backward, backward_rows};

    #[test]
    fn every_instruction_set_gives_the_same_bits() {
        for (memory, hidden) in [(1, 1), (3, 19), (8, 64), (256, 255), (255, 256)] {
            let [next, d] = [0, 1].map(|seed| numbers(3 * (memory + hidden), seed));
            let grad = numbers(3 * hidden, 2);
            let run = |wide: bool| {
                let mut d = d.clone();
                (if wide { backward } else { backward_rows })(&mut d, &grad, &next, memory, hidden);
                d.iter().map(|x| x.to_bits()).collect::<Vec<_>>()
            };
            assert_eq!(run(true), run(false), "memory {memory}, hidden {hidden}");
        }
    }
}
