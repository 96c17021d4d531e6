//! Elman's cell on the CPU, for the loops of `recurrent_cpu.rs`:
//!
//! ```text
//! h' = tanh(a + s + c)    da = ds = dh' (1 - h'^2)    dh = 0
//! ```

// Only inlined code is compiled for the caller's instruction set.
#![allow(clippy::inline_always)]

use super::elementwise::tanh;
use super::recurrent_cpu::{Backward, Cell, Forward};

pub(super) struct ElmanCell;

impl Cell for ElmanCell {
    const GATES: usize = 1;
    const TWO_PARTS: bool = false;
    const CARRIES_CELL: bool = false;

    #[inline(always)]
    fn forward(Forward { hidden, a, s, c, next_h, .. }: Forward<'_>) {
        for ((a, s), next) in a.chunks_exact(hidden).zip(s.chunks_exact(hidden)).zip(next_h.chunks_exact_mut(hidden)) {
            for (((next, a), s), c) in next.iter_mut().zip(a).zip(s).zip(c) {
                *next = tanh(*a + (*s + c));
            }
        }
    }

    #[inline(always)]
    fn backward(Backward { a, next_h, grad_output, dh, .. }: Backward<'_>) {
        for (((da, dh), grad), h) in a.iter_mut().zip(&*dh).zip(grad_output).zip(next_h) {
            *da = (dh + grad) * (1.0 - h * h);
        }
        dh.fill(0.0);
    }
}
