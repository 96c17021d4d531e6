//! The LSTM's cell on the CPU, for the loops of `recurrent_cpu.rs` (its `c` is called k here, the bias is c):
//!
//! ```text
//! i, f, o = sigmoid(a + s + c)    g = tanh(a + s + c)
//! k' = f k + i g                  t = tanh(k')             h' = o t
//!
//! do = dh' t o (1 - o)            dk' += dh' o (1 - t^2)
//! di = dk' g i (1 - i)            df = dk' k f (1 - f)     dg = dk' i (1 - g^2)
//! da = ds = [di, df, dg, do]      dk = dk' f               dh = 0
//! ```

// Only inlined code is compiled for the caller's instruction set.
#![allow(clippy::inline_always)]

use super::elementwise::{in_blocks, sigmoid, tanh};
use super::recurrent_cpu::{Backward, Cell, Forward};

/// Gates in the order i, f, g, o.
pub(super) struct LstmCell;

impl Cell for LstmCell {
    const GATES: usize = 4;
    const TWO_PARTS: bool = false;
    const CARRIES_CELL: bool = true;

    /// Turns `a` into i, f, g, o.
    #[inline(always)]
    fn forward(Forward { hidden, a, s, c, cell, next_h, next_cell, .. }: Forward<'_>) {
        let gates = a.chunks_exact_mut(4 * hidden).zip(s.chunks_exact(4 * hidden));
        let next = next_h.chunks_exact_mut(hidden).zip(next_cell.chunks_exact_mut(hidden));
        for ((a, s), (cell, (next_h, next_cell))) in gates.zip(cell.chunks_exact(hidden).zip(next)) {
            for (gate, (a, (s, c))) in
                a.chunks_exact_mut(hidden).zip(s.chunks_exact(hidden).zip(c.chunks_exact(hidden))).enumerate()
            {
                if gate == 2 {
                    for ((a, s), c) in a.iter_mut().zip(s).zip(c) {
                        *a = tanh(*a + (*s + c));
                    }
                } else {
                    for ((a, s), c) in a.iter_mut().zip(s).zip(c) {
                        *a = sigmoid(*a + (*s + c));
                    }
                }
            }
            let [i, f, g, o] = [0, 1, 2, 3].map(|gate| &a[gate * hidden..(gate + 1) * hidden]);
            for ((((next, cell), i), f), g) in next_cell.iter_mut().zip(cell).zip(i).zip(f).zip(g) {
                *next = f * cell + i * g;
            }
            for ((next_h, next_cell), o) in next_h.iter_mut().zip(&*next_cell).zip(o) {
                *next_h = o * tanh(*next_cell);
            }
        }
    }

    #[inline(always)]
    fn backward(Backward { hidden, a, s, cell, grad_output, dh, dcell, .. }: Backward<'_>) {
        let gates = a.chunks_exact_mut(4 * hidden).zip(s.chunks_exact_mut(4 * hidden));
        let gradients = dh.chunks_exact_mut(hidden).zip(dcell.chunks_exact_mut(hidden));
        let given = cell.chunks_exact(hidden).zip(grad_output.chunks_exact(hidden));
        for ((a, room), ((dh, dcell), (cell, grad_output))) in gates.zip(gradients.zip(given)) {
            let (i_f, g_o) = a.split_at_mut(2 * hidden);
            let ((i, f), (g, o)) = (i_f.split_at_mut(hidden), g_o.split_at_mut(hidden));
            let (t, room) = room.split_at_mut(hidden);
            let (di, room) = room.split_at_mut(hidden);
            let df = &mut room[..hidden];
            for (dh, grad) in dh.iter_mut().zip(grad_output) {
                *dh += grad;
            }
            for ((((t, cell), i), f), g) in t.iter_mut().zip(cell).zip(&*i).zip(&*f).zip(&*g) {
                *t = tanh(f * cell + i * g);
            }
            for (((dcell, dh), t), o) in dcell.iter_mut().zip(&*dh).zip(&*t).zip(&*o) {
                *dcell += dh * o * (1.0 - t * t);
            }
            for ((o, dh), t) in o.iter_mut().zip(&*dh).zip(&*t) {
                *o = dh * t * (*o * (1.0 - *o));
            }
            for (((di, dcell), g), i) in di.iter_mut().zip(&*dcell).zip(&*g).zip(&*i) {
                *di = dcell * g * (i * (1.0 - i));
            }
            in_blocks(g, dcell, i, |g, dcell, i| *g = *dcell * i * (1.0 - *g * *g));
            for (((df, dcell), cell), f) in df.iter_mut().zip(&*dcell).zip(cell).zip(&*f) {
                *df = dcell * cell * (f * (1.0 - f));
            }
            for (dcell, f) in dcell.iter_mut().zip(&*f) {
                *dcell *= f;
            }
            i.copy_from_slice(di);
            f.copy_from_slice(df);
            dh.fill(0.0);
        }
    }
}
