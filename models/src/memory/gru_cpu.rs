//! The GRU's cell on the CPU, for the loops of `recurrent_cpu.rs`:
//!
//! ```text
//! r = sigmoid(a_r + s_r + c_r)    q = sigmoid(a_q + s_q + c_q)
//! m = s_n + c_n                   n = tanh(a_n + r m)
//! h' = n + q (h - n)
//!
//! dn = dh' (1 - q) (1 - n^2)      dq = dh' (h - n) q (1 - q)    dr = dn m r (1 - r)
//! da = [dr, dq, dn]               ds = [dr, dq, dn r]           dh = dh' q
//! ```

// Only inlined code is compiled for the caller's instruction set.
#![allow(clippy::inline_always)]

use super::elementwise::{in_blocks, sigmoid, tanh};
use super::recurrent_cpu::{Backward, Cell, Forward};

/// Gates in the order r, q, n.
pub(super) struct GruCell;

impl Cell for GruCell {
    const GATES: usize = 3;
    const TWO_PARTS: bool = true;
    const CARRIES_CELL: bool = false;

    /// Turns `a` into r, q, n and the last third of `s` into m.
    #[inline(always)]
    fn forward(Forward { hidden, a, s, c, h, next_h, .. }: Forward<'_>) {
        let (c_rq, c_n) = c.split_at(2 * hidden);
        let gates = a.chunks_exact_mut(3 * hidden).zip(s.chunks_exact_mut(3 * hidden));
        for ((a, s), (h, next)) in gates.zip(h.chunks_exact(hidden).zip(next_h.chunks_exact_mut(hidden))) {
            let (rq, n) = a.split_at_mut(2 * hidden);
            let (s_rq, m) = s.split_at_mut(2 * hidden);
            for ((rq, s), c) in rq.iter_mut().zip(s_rq).zip(c_rq) {
                *rq = sigmoid(*rq + (*s + c));
            }
            let (r, q) = rq.split_at(hidden);
            for (m, c) in m.iter_mut().zip(c_n) {
                *m += c;
            }
            in_blocks(n, m, r, |n, m, r| *n = tanh(*n + r * *m));
            for (((next, h), n), q) in next.iter_mut().zip(h).zip(n).zip(q) {
                *next = *n + q * (h - *n);
            }
        }
    }

    #[inline(always)]
    fn backward(Backward { hidden, a, s, h, grad_output, dh, .. }: Backward<'_>) {
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
                in_blocks(n, dh, q, |n, dh, q| *n = *dh * (1.0 - q) * (1.0 - *n * *n));
                let dn = n;
                dr.copy_from_slice(r);
                in_blocks(dr, m, dn, |r, m, dn| {
                    let ds = dn * *r;
                    *r = dn * *m * (*r * (1.0 - *r));
                    *m = ds;
                });
                for (dh, q) in dh.iter_mut().zip(q) {
                    *dh *= q;
                }
            }
            a[..2 * hidden].copy_from_slice(&s[..2 * hidden]);
        }
    }
}
