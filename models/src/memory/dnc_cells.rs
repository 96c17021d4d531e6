//! The memory cells of the DNC in plain Rust: what both directions share. A row here is one sequence's memory.
//!
//! Matrices are row-major; `[rows, columns]` in a comment is a slice's shape. All is made of two products of small
//! matrices, elementwise loops and short sums, compiled once for the paper's sizes, where a row of cells is a whole vector.

// Only inlined code is compiled for the caller's instruction set.
#![allow(clippy::inline_always)]

use super::elementwise::{exp, sigmoid, tanh};

pub(super) const SMALL: f32 = super::dnc::SMALL as f32;

/// How many cells, how wide, how many read heads.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) struct Sizes {
    pub(super) cells: usize,
    pub(super) width: usize,
    pub(super) heads: usize,
}

/// Memory, link, precedence, read weights, write weights, usage.
pub(super) const FIELDS: usize = 6;

impl Sizes {
    /// The paper's.
    pub(super) const PAPER: Self = Self { cells: 16, width: 16, heads: 4 };

    /// Numbers a row has of each field of the state.
    #[inline(always)]
    pub(super) fn fields(self) -> [usize; FIELDS] {
        let n = self.cells;
        [n * self.width, n * n, n, self.heads * n, n, n]
    }

    /// Numbers of all read vectors.
    #[inline(always)]
    pub(super) fn reads(self) -> usize {
        self.heads * self.width
    }

    /// Numbers of what the controller tells the memory.
    #[inline(always)]
    pub(super) fn interface(self) -> usize {
        self.reads() + 3 * self.width + 5 * self.heads + 3
    }

    /// Numbers of a [`Trace`].
    #[inline(always)]
    pub(super) fn trace(self) -> usize {
        4 * self.cells * (1 + self.heads)
    }

    /// Row `i` of each field.
    #[inline(always)]
    pub(super) fn row(self, fields: [&[f32]; FIELDS], i: usize) -> [&[f32]; FIELDS] {
        let [a, b, c, d, e, f] = fields;
        let [p, q, r, s, t, u] = self.fields();
        [part(a, i, p), part(b, i, q), part(c, i, r), part(d, i, s), part(e, i, t), part(f, i, u)]
    }

    /// Row `i` of each field, to be written.
    #[inline(always)]
    pub(super) fn row_mut<'a>(self, fields: &'a mut [&mut [f32]; FIELDS], i: usize) -> [&'a mut [f32]; FIELDS] {
        let [a, b, c, d, e, f] = fields;
        let [p, q, r, s, t, u] = self.fields();
        [
            part_mut(a, i, p),
            part_mut(b, i, q),
            part_mut(c, i, r),
            part_mut(d, i, s),
            part_mut(e, i, t),
            part_mut(f, i, u),
        ]
    }
}

/// The `i`th piece of `width` numbers.
#[inline(always)]
pub(super) fn part(x: &[f32], i: usize, width: usize) -> &[f32] {
    &x[i * width..][..width]
}

/// The `i`th piece of `width` numbers, to be written.
#[inline(always)]
pub(super) fn part_mut(x: &mut [f32], i: usize, width: usize) -> &mut [f32] {
    &mut x[i * width..][..width]
}

/// The parts of an interface row (see `dnc.rs`), to be read or written.
pub(super) struct Interface<T> {
    pub(super) read_keys: T,
    pub(super) read_strengths: T,
    pub(super) write_key: T,
    pub(super) write_strength: T,
    pub(super) erase: T,
    pub(super) write_vector: T,
    pub(super) free_gates: T,
    /// Allocation gate and write gate.
    pub(super) gates: T,
    pub(super) modes: T,
}

impl<'a> Interface<&'a mut [f32]> {
    #[inline(always)]
    pub(super) fn new(s: Sizes, xi: &'a mut [f32]) -> Self {
        let (read_keys, xi) = xi.split_at_mut(s.reads());
        let (read_strengths, xi) = xi.split_at_mut(s.heads);
        let (write_key, xi) = xi.split_at_mut(s.width);
        let (write_strength, xi) = xi.split_at_mut(1);
        let (erase, xi) = xi.split_at_mut(s.width);
        let (write_vector, xi) = xi.split_at_mut(s.width);
        let (free_gates, xi) = xi.split_at_mut(s.heads);
        let (gates, modes) = xi.split_at_mut(2);
        Self { read_keys, read_strengths, write_key, write_strength, erase, write_vector, free_gates, gates, modes }
    }

    /// From the controller's numbers to what they mean.
    #[inline(always)]
    pub(super) fn activate(&mut self) {
        for keys in [&mut *self.read_keys, &mut *self.write_key, &mut *self.write_vector] {
            for x in keys {
                *x = tanh(*x);
            }
        }
        for gates in [&mut *self.erase, &mut *self.free_gates, &mut *self.gates] {
            for x in gates {
                *x = sigmoid(*x);
            }
        }
        for strength in self.read_strengths.iter_mut().chain(&mut *self.write_strength) {
            *strength = strength.max(0.0) + (-strength.abs()).exp().ln_1p();
        }
        for modes in self.modes.chunks_exact_mut(3) {
            softmax(modes);
        }
    }
}

/// What a forward step leaves for its backward.
pub(super) struct Trace<T> {
    /// Lengths of the cells before and after the step.
    pub(super) lengths: [T; 2],
    /// For the write head: cosines, and their softmax.
    pub(super) write_likeness: T,
    pub(super) write_content: T,
    /// The same for the read heads.
    pub(super) likeness: T,
    pub(super) content: T,
    /// Cells written before and after those last read.
    pub(super) backward: T,
    pub(super) forward: T,
}

impl<'a> Trace<&'a mut [f32]> {
    #[inline(always)]
    pub(super) fn new(s: Sizes, trace: &'a mut [f32]) -> Self {
        let (before, trace) = trace.split_at_mut(s.cells);
        let (after, trace) = trace.split_at_mut(s.cells);
        let (write_likeness, trace) = trace.split_at_mut(s.cells);
        let (write_content, trace) = trace.split_at_mut(s.cells);
        let (likeness, trace) = trace.split_at_mut(s.heads * s.cells);
        let (content, trace) = trace.split_at_mut(s.heads * s.cells);
        let (backward, forward) = trace.split_at_mut(s.heads * s.cells);
        Self { lengths: [before, after], write_likeness, write_content, likeness, content, backward, forward }
    }
}

/// The order of rising usage, equal ones by cell. `ranks` is scratch.
#[inline(always)]
pub(super) fn rising(usage: &[f32], ranks: &mut [u32], order: &mut [usize]) {
    ranks.fill(0);
    for (j, other) in usage.iter().enumerate() {
        for (i, (rank, usage)) in ranks.iter_mut().zip(usage).enumerate() {
            *rank += u32::from(if j < i { other <= usage } else { other < usage });
        }
    }
    for (i, rank) in ranks.iter().enumerate() {
        order[*rank as usize] = i;
    }
}

/// The usage kept away from zero, from which cells are allocated.
#[inline(always)]
pub(super) fn keep_from_zero(usage: &[f32], kept: &mut [f32]) {
    for (kept, usage) in kept.iter_mut().zip(usage) {
        *kept = SMALL + (1.0 - SMALL) * usage;
    }
}

/// Numbers that are summed side by side: what the widest vectors hold.
pub(super) const LANES: usize = 16;

/// `out [r, n] += c [r, m] a [m, n]`.
#[inline(always)]
pub(super) fn add_product(out: &mut [f32], c: &[f32], a: &[f32], n: usize) {
    let m = a.len() / n;
    for (out, c) in out.chunks_exact_mut(n).zip(c.chunks_exact(m)) {
        let mut blocks = out.chunks_exact_mut(LANES);
        for (block, out) in blocks.by_ref().enumerate() {
            let mut sum = [0.0; LANES];
            sum.copy_from_slice(out);
            for (c, a) in c.iter().zip(a.chunks_exact(n)) {
                for (sum, a) in sum.iter_mut().zip(part(a, block, LANES)) {
                    *sum += c * a;
                }
            }
            out.copy_from_slice(&sum);
        }
        let done = n / LANES * LANES;
        for (j, out) in blocks.into_remainder().iter_mut().enumerate() {
            for (c, a) in c.iter().zip(a.chunks_exact(n)) {
                *out += c * a[done + j];
            }
        }
    }
}

/// `a [m, n] += c^T [m, r] b [r, n]`.
#[inline(always)]
pub(super) fn add_outer(a: &mut [f32], c: &[f32], b: &[f32], n: usize) {
    let m = a.len() / n;
    for (i, a) in a.chunks_exact_mut(n).enumerate() {
        for (c, b) in c.chunks_exact(m).zip(b.chunks_exact(n)) {
            for (a, b) in a.iter_mut().zip(b) {
                *a += c[i] * b;
            }
        }
    }
}

/// `out [n, m] = a^T`, `a [m, n]`.
#[inline(always)]
pub(super) fn transpose(a: &[f32], out: &mut [f32], n: usize) {
    let m = a.len() / n;
    for (j, out) in out.chunks_exact_mut(m).enumerate() {
        for (i, out) in out.iter_mut().enumerate() {
            *out = a[i * n + j];
        }
    }
}

/// `sum!(n, i => term)`: a sum over a row, in an order that no instruction set changes. A macro, because a closure would
/// not be compiled for the caller's instruction set.
macro_rules! sum {
    ($n:expr, $i:ident => $term:expr) => {{
        const LANES: usize = $crate::memory::dnc_cells::LANES;
        let n: usize = $n;
        let mut lanes = [0.0_f32; LANES];
        let done = n / LANES * LANES;
        for block in (0..done).step_by(LANES) {
            for (lane, sum) in lanes.iter_mut().enumerate() {
                let $i = block + lane;
                *sum += $term;
            }
        }
        for (lane, sum) in lanes.iter_mut().enumerate().take(n - done) {
            let $i = done + lane;
            *sum += $term;
        }
        for half in [8, 4, 2, 1] {
            for lane in 0..half {
                lanes[lane] += lanes[lane + half];
            }
        }
        lanes[0]
    }};
}
pub(super) use sum;

/// Scalar product.
#[inline(always)]
pub(super) fn dot(a: &[f32], b: &[f32]) -> f32 {
    let n = a.len();
    let b = &b[..n];
    sum!(n, i => a[i] * b[i])
}

/// In place.
#[inline(always)]
pub(super) fn softmax(x: &mut [f32]) {
    let mut largest = f32::NEG_INFINITY;
    for &x in &*x {
        largest = if x > largest { x } else { largest };
    }
    for x in &mut *x {
        *x = exp(*x - largest);
    }
    let scale = 1.0 / sum!(x.len(), i => x[i]);
    for x in x {
        *x *= scale;
    }
}

/// From d loss / d softmax to d loss / d its input, in place.
#[inline(always)]
pub(super) fn softmax_backward(y: &[f32], gradient: &mut [f32]) {
    let mean = dot(y, gradient);
    for (gradient, y) in gradient.iter_mut().zip(y) {
        *gradient = y * (*gradient - mean);
    }
}
