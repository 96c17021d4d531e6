//! One step of S4D's state on the CPU, in one pass over it. Equations: `s4d.rs`.

// Only inlined code is compiled for the caller's instruction set.
#![allow(clippy::inline_always)]

use tch::Tensor;

use super::elementwise::{floats, floats_mut, widest};

/// Modes of a channel that this loop is written for: the paper's.
pub(super) const MODES: usize = 8;

/// A number for each mode of a channel.
type Modes = [f32; MODES];

/// Real and imaginary parts of Abar, Bbar and C, and D, with a row a channel.
struct System<'a> {
    a: [&'a [Modes]; 2],
    b: [&'a [Modes]; 2],
    c: [&'a [Modes]; 2],
    skip: &'a [f32],
}

/// Without gradients: `u [rows, hidden]`, the state's parts `[rows, hidden, 8]`, and the system's `a, b, c [hidden, 8]` (real
/// and imaginary part) and `skip [hidden]` to v and the next state's parts.
pub(super) fn step(u: &Tensor, state: [&Tensor; 2], system: [[&Tensor; 2]; 3], skip: &Tensor) -> (Tensor, [Tensor; 2]) {
    let (u, state) = (u.contiguous(), state.map(Tensor::contiguous));
    let system = system.map(|parts| parts.map(Tensor::contiguous));
    let [a, b, c] = system.each_ref().map(|parts| parts.each_ref().map(|part| modes(floats(part))));
    let mut v = u.empty_like();
    let mut next = state.each_ref().map(Tensor::empty_like);
    let [re, im] = &mut next;
    advance(
        &System { a, b, c, skip: floats(skip) },
        floats(&u),
        [modes(floats(&state[0])), modes(floats(&state[1]))],
        floats_mut(&mut v),
        [floats_mut(re).as_chunks_mut().0, floats_mut(im).as_chunks_mut().0],
    );
    (v, next)
}

fn modes(numbers: &[f32]) -> &[Modes] {
    numbers.as_chunks().0
}

widest! {
    /// v and next state of some rows.
    fn advance(system: &System<'_>, u: &[f32], state: [&[Modes]; 2], v: &mut [f32], next: [&mut [Modes]; 2]) = advance_rows
}

#[inline(always)]
fn advance_rows(system: &System<'_>, u: &[f32], state: [&[Modes]; 2], v: &mut [f32], next: [&mut [Modes]; 2]) {
    let hidden = system.skip.len();
    let [next_re, next_im] = next.map(|part| part.chunks_exact_mut(hidden));
    let [re, im] = state.map(|part| part.chunks_exact(hidden));
    let rows = u.chunks_exact(hidden).zip(v.chunks_exact_mut(hidden));
    for ((((u, v), re), im), (next_re, next_im)) in rows.zip(re).zip(im).zip(next_re.zip(next_im)) {
        for channel in 0..hidden {
            let [[a_re, a_im], [b_re, b_im], [c_re, c_im]] =
                [system.a, system.b, system.c].map(|parts| parts.map(|part| &part[channel]));
            let (u, re, im) = (u[channel], &re[channel], &im[channel]);
            let (next_re, next_im) = (&mut next_re[channel], &mut next_im[channel]);
            let mut seen = [0.0; MODES];
            for n in 0..MODES {
                next_re[n] = (re[n] * a_re[n] - im[n] * a_im[n]) + u * b_re[n];
                next_im[n] = (re[n] * a_im[n] + im[n] * a_re[n]) + u * b_im[n];
                seen[n] = next_re[n] * c_re[n] - next_im[n] * c_im[n];
            }
            // Halves, so that the additions are vectors, too.
            let four: [f32; 4] = std::array::from_fn(|n| seen[n] + seen[n + 4]);
            let sum = (four[0] + four[2]) + (four[1] + four[3]);
            v[channel] = 2.0 * sum + u * system.skip[channel];
        }
    }
}
