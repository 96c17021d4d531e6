//! A layer of independent units on the CPU: one matrix product for all rows, and loops over time that have none.
//!
//! ```text
//! z = W x + b                               all rows at once
//! h' = relu(z + (u * h + c))                step by step
//! d = (dh' + d loss/d output) [h' > 0]      step by step, backwards; dh = d * u, du = sum d * h
//! dW = d^T x    db = dc = sum d    dx = d W    all rows at once
//! ```
//!
//! `u` is the clamped vector; the clamp's gradient, 0 beyond its bounds, is libtorch's.

// Only inlined code is compiled for the caller's instruction set.
#![allow(clippy::inline_always)]

use tch::{Kind, Tensor};

use super::elementwise::{floats, floats_mut, widest};
use super::indrnn::Layer;
use super::trajectory::{Step, Trajectory};
use super::{Backward, Scan, State, add_gradients};
use crate::packing::Packing;

/// One time step of a layer, without gradients: `input [rows, inputs]`, `state [rows, hidden]` to the next state.
pub(super) fn step(layer: &Layer, input: &Tensor, state: &Tensor) -> Tensor {
    tch::no_grad(|| {
        let (u, state) = (layer.clamped(), state.contiguous());
        let mut next = layer.bias_input.addmm(input, &layer.weight.tr());
        forward(floats_mut(&mut next), floats(&u), floats(&layer.bias_state), floats(&state));
        next
    })
}

/// Both layers over whole sequences: packed `input [rows, inputs]`. If `input` wants gradients, what the backward needs is
/// kept.
pub(super) fn scan(layers: [&Layer; 2], input: &Tensor, packing: &Packing, initial: &State) -> Scan {
    let keep = input.requires_grad();
    tch::no_grad(|| {
        let first = Run::new(layers[0], input, packing, &initial.0[0]);
        let between = first.states.after();
        let second = Run::new(layers[1], &between, packing, &initial.0[1]);
        let output = second.states.after();
        let last = packing.last_rows();
        let state = State([&between, &output].map(|x| x.index_select(0, &last)).into());
        let backward = keep.then(|| {
            let steps = Step::all(packing);
            Box::new(move |grad_output: &Tensor| {
                let grad_between = second.backward(&steps, grad_output);
                first.backward(&steps, &grad_between)
            }) as Backward
        });
        Scan { output, state, computed_steps: packing.rows(), backward }
    })
}

/// One layer over whole sequences.
struct Run {
    /// Its parameters; the tensors are the memory's own.
    layer: Layer,
    input: Tensor,
    states: Trajectory,
}

impl Run {
    fn new(layer: &Layer, input: &Tensor, packing: &Packing, initial: &Tensor) -> Self {
        let mut states = Trajectory::new(packing, initial);
        let _ = layer.bias_input.addmm_out(&states.after(), input, &layer.weight.tr());
        let u = layer.clamped();
        for step in Step::all(packing) {
            let (h, next) = states.slices(&step);
            forward(next, floats(&u), floats(&layer.bias_state), h);
        }
        let [weight, bias_input, recurrent, bias_state] =
            [&layer.weight, &layer.bias_input, &layer.recurrent, &layer.bias_state].map(Tensor::shallow_clone);
        Self { layer: Layer { weight, bias_input, recurrent, bias_state }, input: input.detach(), states }
    }

    /// From d loss / d states to d loss / d input; adds to the parameters' gradients.
    fn backward(mut self, steps: &[Step], grad_output: &Tensor) -> Tensor {
        let Layer { weight, bias_input, bias_state, .. } = &self.layer;
        let u = self.layer.clamped();
        let (gradients, grad_input) = tch::no_grad(|| {
            let mut d = grad_output.contiguous().copy();
            let hidden = u.numel();
            let mut dh = vec![0.0; steps[0].now.len() * hidden];
            let mut du = Tensor::zeros_like(&u);
            for step in steps.iter().rev() {
                let (h, next) = self.states.slices(step);
                let d = &mut floats_mut(&mut d)[step.now.start * hidden..step.now.end * hidden];
                backward(d, &mut dh[..step.now.len() * hidden], floats_mut(&mut du), floats(&u), h, next);
            }
            let sum = d.sum_dim_intlist(0, false, Kind::Float);
            ([d.tr().mm(&self.input), sum.shallow_clone(), du, sum], d.mm(weight))
        });
        add_gradients(&[weight, bias_input, &u, bias_state], &gradients);
        grad_input
    }
}

widest! {
    /// Turns `z` of some rows into their next states.
    fn forward(z: &mut [f32], u: &[f32], c: &[f32], h: &[f32]) = forward_rows
}

#[inline(always)]
fn forward_rows(z: &mut [f32], u: &[f32], c: &[f32], h: &[f32]) {
    for (z, h) in z.chunks_exact_mut(u.len()).zip(h.chunks_exact(u.len())) {
        for (((z, u), c), h) in z.iter_mut().zip(u).zip(c).zip(h) {
            let sum = *z + (u * h + c);
            // A NaN stays one, as in libtorch.
            *z = if sum < 0.0 { 0.0 } else { sum };
        }
    }
}

widest! {
    /// Gradients of some rows. Turns `d` from d loss / d output into d loss / dz, `dh` of the state after the step into that
    /// before it, and adds to `du`.
    fn backward(d: &mut [f32], dh: &mut [f32], du: &mut [f32], u: &[f32], h: &[f32], next: &[f32]) = backward_rows
}

#[inline(always)]
fn backward_rows(d: &mut [f32], dh: &mut [f32], du: &mut [f32], u: &[f32], h: &[f32], next: &[f32]) {
    let hidden = u.len();
    let gradients = d.chunks_exact_mut(hidden).zip(dh.chunks_exact_mut(hidden));
    for ((d, dh), (h, next)) in gradients.zip(h.chunks_exact(hidden).zip(next.chunks_exact(hidden))) {
        for ((d, dh), next) in d.iter_mut().zip(&*dh).zip(next) {
            *d = if *next > 0.0 { *d + dh } else { 0.0 };
        }
        for ((dh, d), u) in dh.iter_mut().zip(&*d).zip(u) {
            *dh = d * u;
        }
        for ((du, d), h) in du.iter_mut().zip(&*d).zip(h) {
            *du += d * h;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::elementwise::numbers;
    use super::{backward, backward_rows, forward, forward_rows};

    #[test]
    fn every_instruction_set_gives_the_same_bits() {
        for hidden in [1, 3, 8, 16, 19, 64, 255, 256] {
            let [z, h, grad, dh] = [0, 1, 2, 3].map(|seed| numbers(3 * hidden, seed));
            let [u, c, du] = [4, 5, 6].map(|seed| numbers(hidden, seed));
            let run = |wide: bool| {
                let (mut next, mut d, mut dh, mut du) = (z.clone(), grad.clone(), dh.clone(), du.clone());
                (if wide { forward } else { forward_rows })(&mut next, &u, &c, &h);
                (if wide { backward } else { backward_rows })(&mut d, &mut dh, &mut du, &u, &h, &next);
                [next, d, dh, du].map(|x| x.iter().map(|x| x.to_bits()).collect::<Vec<_>>())
            };
            assert_eq!(run(true), run(false), "hidden {hidden}");
        }
    }
}
