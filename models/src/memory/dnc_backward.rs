//! Gradients of one step of the DNC's memory cells, on many rows: `dnc_forward.rs` from its end to its start.
//!
//! With `d` for d loss / d, and D for d of the memory after the step; what is not a plain product or sum:
//!
//! ```text
//! z = s t, t = d / (|M| |k| + 1e-6), c = softmax z     content: dd = s dz / (|M| |k| + 1e-6), d|M| = -dd t |k|
//! a_j = (1 - u_j) P_j, P_j = prod_(i before j) u_i     allocation: du_j = P_j (S_j - da_j),
//!                                                      S of the one before = da_j (1 - u_j) + u_j S_j: no division
//! U' = U1 prod_r k_r                                   each k_r's gradient is a product of the others: no division
//! ```
//!
//! The length of a cell or key of zeros has a gradient of zero, as in libtorch.

// Only inlined code is compiled for the caller's instruction set.
#![allow(clippy::inline_always)]

use super::dnc_cells::{
    FIELDS, Interface, SMALL, Sizes, Trace, add_outer, add_product, dot, keep_from_zero, part, part_mut, rising,
    softmax_backward, sum, transpose,
};
use super::elementwise::widest;

/// A time step's rows.
pub(super) struct Rows<'a> {
    /// The state before.
    pub(super) before: [&'a [f32]; FIELDS],
    /// The state after.
    pub(super) after: [&'a [f32]; FIELDS],
    /// The interface; becomes the gradients of the controller's numbers.
    pub(super) xi: &'a mut [f32],
    /// Gradients of the controller's output and the read vectors.
    pub(super) grad_z: &'a [f32],
    /// What the forward left; of no use any more.
    pub(super) trace: &'a mut [f32],
    /// Gradients of the state after; becomes those of the state before.
    pub(super) gradients: [&'a mut [f32]; FIELDS],
}

/// Room for one row.
pub(super) struct Scratch {
    /// The memory or the link, transposed.
    transposed: Vec<f32>,
    xi: Vec<f32>,
    /// Gradients of contents, then of likenesses.
    content: Vec<f32>,
    read_weights: Vec<f32>,
    /// Gradients of the write weights.
    w: Vec<f32>,
    /// Some numbers for each cell.
    cells: [Vec<f32>; 4],
    ranks: Vec<u32>,
    order: Vec<usize>,
}

impl Scratch {
    pub(super) fn new(s: Sizes) -> Self {
        let zeros = |n| vec![0.0; n];
        Self {
            transposed: zeros(s.cells * s.cells.max(s.width)),
            xi: zeros(s.interface()),
            content: zeros(s.heads * s.cells),
            read_weights: zeros(s.heads * s.cells),
            w: zeros(s.cells),
            cells: [0; 4].map(|_| zeros(s.cells)),
            ranks: vec![0; s.cells],
            order: vec![0; s.cells],
        }
    }
}

widest! {
    /// Gradients of one time step of some rows.
    pub(super) fn step(s: Sizes, rows: Rows<'_>, scratch: &mut Scratch) = of_any_size
}

#[inline(always)]
fn of_any_size(s: Sizes, rows: Rows<'_>, scratch: &mut Scratch) {
    if s == Sizes::PAPER { all(Sizes::PAPER, rows, scratch) } else { all(s, rows, scratch) }
}

#[inline(always)]
fn all(s: Sizes, rows: Rows<'_>, scratch: &mut Scratch) {
    let Rows { before, after, xi, grad_z, trace, mut gradients } = rows;
    let count = xi.len() / s.interface();
    let z_width = grad_z.len() / count;
    for i in 0..count {
        let mut xi = Interface::new(s, part_mut(xi, i, s.interface()));
        let mut grad_xi = std::mem::take(&mut scratch.xi);
        grad_xi.fill(0.0);
        let mut d = Interface::new(s, &mut grad_xi[..s.interface()]);
        let mut trace = Trace::new(s, part_mut(trace, i, s.trace()));
        let (before, after) = (s.row(before, i), s.row(after, i));
        let mut gradients = s.row_mut(&mut gradients, i);
        let grad_reads = &part(grad_z, i, z_width)[z_width - s.reads()..][..s.reads()];
        read(s, before[3], after, grad_reads, &xi, &mut d, &mut trace, &mut gradients, scratch);
        connect(s, before, after[4], &mut gradients, &mut scratch.w[..s.cells]);
        write(s, before, after, &xi, &mut d, &trace, &mut gradients, scratch);
        xi.chain(&d);
        scratch.xi = grad_xi;
    }
}

impl Interface<&mut [f32]> {
    /// From gradients of what the numbers mean to those of the numbers, in place of the meanings.
    #[inline(always)]
    fn chain(&mut self, d: &Self) {
        let tanh = [(&mut *self.read_keys, &d.read_keys), (&mut *self.write_key, &d.write_key)];
        for (y, d) in tanh.into_iter().chain([(&mut *self.write_vector, &d.write_vector)]) {
            for (y, d) in y.iter_mut().zip(&**d) {
                *y = d * (1.0 - *y * *y);
            }
        }
        let sigmoid = [(&mut *self.erase, &d.erase), (&mut *self.free_gates, &d.free_gates)];
        for (y, d) in sigmoid.into_iter().chain([(&mut *self.gates, &d.gates)]) {
            for (y, d) in y.iter_mut().zip(&**d) {
                *y = d * (*y * (1.0 - *y));
            }
        }
        for (y, d) in [(&mut *self.read_strengths, &d.read_strengths), (&mut *self.write_strength, &d.write_strength)] {
            // Softplus: 1 - exp(-y).
            for (y, d) in y.iter_mut().zip(&**d) {
                *y = d * -(-*y).exp_m1();
            }
        }
        for (y, d) in self.modes.chunks_exact_mut(3).zip(d.modes.chunks_exact(3)) {
            let mean = dot(y, d);
            for (y, d) in y.iter_mut().zip(d) {
                *y *= d - mean;
            }
        }
    }
}

/// Read vectors and read weights. Leaves in `scratch` the gradients of the read weights before.
#[allow(clippy::too_many_arguments)]
#[inline(always)]
fn read(
    s: Sizes,
    read_weights: &[f32],
    after: [&[f32]; FIELDS],
    grad_reads: &[f32],
    xi: &Interface<&mut [f32]>,
    d: &mut Interface<&mut [f32]>,
    trace: &mut Trace<&mut [f32]>,
    gradients: &mut [&mut [f32]; FIELDS],
    scratch: &mut Scratch,
) {
    let [memory, link, _, weights, ..] = after;
    let [d_memory, d_link, _, d_weights, ..] = gradients;
    let n = s.cells;
    let transposed = &mut scratch.transposed[..n * s.width];
    transpose(memory, transposed, s.width);
    add_product(d_weights, grad_reads, transposed, n);
    add_outer(d_memory, weights, grad_reads, s.width);

    let d_content = &mut scratch.content[..s.heads * n];
    for (head, d_weights) in d_weights.chunks_exact(n).enumerate() {
        let modes = part(xi.modes, head, 3);
        let forms =
            [part_mut(trace.backward, head, n), part_mut(trace.forward, head, n), part_mut(trace.content, head, n)];
        for (d, form) in part_mut(d.modes, head, 3).iter_mut().zip(&forms) {
            *d = dot(form, d_weights);
        }
        let [backward, forward, _] = forms;
        for (mode, d) in modes.iter().zip([backward, forward, part_mut(d_content, head, n)]) {
            for (d, d_weight) in d.iter_mut().zip(d_weights) {
                *d = mode * d_weight;
            }
        }
    }
    let slopes = &mut scratch.cells[0][..n];
    let found = Found { lengths: trace.lengths[1], likeness: trace.likeness, content: trace.content };
    found.backward(memory, xi.read_keys, xi.read_strengths, d_content, d.read_keys, d.read_strengths, d_memory, slopes);

    let (d_backward, d_forward) = (&*trace.backward, &*trace.forward);
    add_outer(d_link, read_weights, d_backward, n);
    add_outer(d_link, d_forward, read_weights, n);
    let transposed = &mut scratch.transposed[..n * n];
    transpose(link, transposed, n);
    let before = &mut scratch.read_weights[..s.heads * n];
    before.fill(0.0);
    add_product(before, d_backward, transposed, n);
    add_product(before, d_forward, link, n);
}

/// What a search by content found.
struct Found<'a> {
    lengths: &'a [f32],
    likeness: &'a [f32],
    content: &'a [f32],
}

impl Found<'_> {
    /// From the gradients of `content`, which become those of the scalar products, to those of keys, strengths and memory.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn backward(
        &self,
        memory: &[f32],
        keys: &[f32],
        strengths: &[f32],
        d_content: &mut [f32],
        d_keys: &mut [f32],
        d_strengths: &mut [f32],
        d_memory: &mut [f32],
        slopes: &mut [f32],
    ) {
        let (n, lengths) = (slopes.len(), self.lengths);
        let width = memory.len() / n;
        slopes.fill(0.0);
        for (head, d) in d_content.chunks_exact_mut(n).enumerate() {
            let (likeness, key) = (part(self.likeness, head, n), part(keys, head, width));
            softmax_backward(part(self.content, head, n), d);
            d_strengths[head] = dot(d, likeness);
            let key_length = dot(key, key).sqrt();
            for (((d, length), likeness), slope) in d.iter_mut().zip(lengths).zip(likeness).zip(&mut *slopes) {
                *d *= strengths[head] / (length * key_length + SMALL);
                *slope -= *d * likeness * key_length;
            }
            let d_length = -sum!(n, i => d[i] * likeness[i] * lengths[i]);
            let slope = if key_length > 0.0 { d_length / key_length } else { 0.0 };
            for (d, key) in part_mut(d_keys, head, width).iter_mut().zip(key) {
                *d = slope * key;
            }
        }
        add_product(d_keys, d_content, memory, width);
        for (slope, length) in slopes.iter_mut().zip(lengths) {
            *slope = if *length > 0.0 { *slope / length } else { 0.0 };
        }
        let cells = d_memory.chunks_exact_mut(width).zip(memory.chunks_exact(width));
        for ((d, cell), slope) in cells.zip(slopes) {
            for (d, number) in d.iter_mut().zip(cell) {
                *d += *slope * number;
            }
        }
        add_outer(d_memory, d_content, keys, width);
    }
}

/// Link and precedence. Sets `d_w`.
#[inline(always)]
fn connect(s: Sizes, before: [&[f32]; FIELDS], w: &[f32], gradients: &mut [&mut [f32]; FIELDS], d_w: &mut [f32]) {
    let [_, link, precedence, ..] = before;
    let [_, d_link, d_precedence, _, d_next_w, _] = gradients;
    let n = s.cells;
    let (kept, mean) = (1.0 - sum!(n, i => w[i]), dot(d_precedence, precedence));
    for ((d_w, next), d_precedence) in d_w.iter_mut().zip(&**d_next_w).zip(&mut **d_precedence) {
        *d_w = next + (*d_precedence - mean);
        *d_precedence *= kept;
    }
    for (i, (d, link)) in d_link.chunks_exact_mut(n).zip(link.chunks_exact(n)).enumerate() {
        d[i] = 0.0;
        let down = w[i];
        d_w[i] += sum!(n, j => d[j] * (precedence[j] - link[j]));
        for ((d_w, d), link) in d_w.iter_mut().zip(&*d).zip(link) {
            *d_w -= d * link;
        }
        for ((d_precedence, d), across) in d_precedence.iter_mut().zip(d).zip(w) {
            *d_precedence += down * *d;
            *d *= 1.0 - (down + across);
        }
    }
}

/// Memory, write weights and usage.
#[allow(clippy::too_many_arguments)]
#[inline(always)]
fn write(
    s: Sizes,
    before: [&[f32]; FIELDS],
    after: [&[f32]; FIELDS],
    xi: &Interface<&mut [f32]>,
    d: &mut Interface<&mut [f32]>,
    trace: &Trace<&mut [f32]>,
    gradients: &mut [&mut [f32]; FIELDS],
    scratch: &mut Scratch,
) {
    let (n, width) = (s.cells, s.width);
    let [memory, _, _, read_weights, write_weights, usage] = before;
    let [_, _, _, _, w, next_usage] = after;
    let [d_memory, _, _, d_read_weights, d_write_weights, d_usage] = gradients;
    let d_w = &mut scratch.w[..n];
    let cells = d_memory.chunks_exact_mut(width).zip(memory.chunks_exact(width));
    for ((d_cell, cell), (d_w, w)) in cells.zip(d_w.iter_mut().zip(w)) {
        *d_w += sum!(width, k => d_cell[k] * (xi.write_vector[k] - xi.erase[k] * cell[k]));
        for ((d_erase, d_cell), cell) in d.erase.iter_mut().zip(&*d_cell).zip(cell) {
            *d_erase -= w * d_cell * cell;
        }
        for (d_value, d_cell) in d.write_vector.iter_mut().zip(&*d_cell) {
            *d_value += w * d_cell;
        }
        for (d_cell, erase) in d_cell.iter_mut().zip(&*xi.erase) {
            *d_cell *= 1.0 - w * erase;
        }
    }

    let [slopes, u, products, d_allocation] = &mut scratch.cells;
    let (slopes, u, products, d_allocation) =
        (&mut slopes[..n], &mut u[..n], &mut products[..n], &mut d_allocation[..n]);
    keep_from_zero(next_usage, u);
    let order = &mut scratch.order[..n];
    rising(u, &mut scratch.ranks[..n], order);
    let mut product = 1.0;
    for &mut i in &mut *order {
        products[i] = product;
        product *= u[i];
    }
    let [allocation_gate, write_gate] = [xi.gates[0], xi.gates[1]];
    let d_content = &mut scratch.content[..n];
    let content = &*trace.write_content;
    let allocated = sum!(n, i => d_w[i] * ((1.0 - u[i]) * products[i]));
    let found = dot(d_w, content);
    d.gates[0] = write_gate * (allocated - found);
    d.gates[1] = allocation_gate * allocated + (1.0 - allocation_gate) * found;
    for ((d_w, d_allocation), d_content) in d_w.iter().zip(&mut *d_allocation).zip(&mut *d_content) {
        *d_allocation = write_gate * allocation_gate * d_w;
        *d_content = write_gate * (1.0 - allocation_gate) * d_w;
    }
    let found = Found { lengths: trace.lengths[0], likeness: trace.write_likeness, content };
    found.backward(memory, xi.write_key, xi.write_strength, d_content, d.write_key, d.write_strength, d_memory, slopes);

    let mut later = 0.0;
    for &mut i in order.iter_mut().rev() {
        d_usage[i] += (1.0 - SMALL) * products[i] * (later - d_allocation[i]);
        later = d_allocation[i] * (1.0 - u[i]) + u[i] * later;
    }
    d_read_weights.copy_from_slice(&scratch.read_weights[..s.heads * n]);
    use_cells([usage, write_weights, read_weights], xi.free_gates, d.free_gates, d_read_weights, d_usage, u);
    for ((d_weight, d_usage), (weight, usage)) in
        d_write_weights.iter_mut().zip(&mut **d_usage).zip(write_weights.iter().zip(usage))
    {
        *d_weight = *d_usage * (1.0 - usage);
        *d_usage *= 1.0 - weight;
    }
}

/// Free gates and read weights before; `d_usage` becomes the gradient of the usage before the gates free any.
#[inline(always)]
fn use_cells(
    [usage, write_weights, read_weights]: [&[f32]; 3],
    free: &[f32],
    d_free: &mut [f32],
    d_read_weights: &mut [f32],
    d_usage: &mut [f32],
    others: &mut [f32],
) {
    let n = usage.len();
    for (head, d_free) in d_free.iter_mut().enumerate() {
        for (((others, d), usage), w) in others.iter_mut().zip(&*d_usage).zip(usage).zip(write_weights) {
            *others = d * (usage + (1.0 - usage) * w);
        }
        for (other, (free, weights)) in free.iter().zip(read_weights.chunks_exact(n)).enumerate() {
            if other != head {
                for (others, weight) in others.iter_mut().zip(weights) {
                    *others *= 1.0 - free * weight;
                }
            }
        }
        *d_free = -dot(others, part(read_weights, head, n));
        for (d, others) in part_mut(d_read_weights, head, n).iter_mut().zip(&*others) {
            *d -= others * free[head];
        }
    }
    for (free, weights) in free.iter().zip(read_weights.chunks_exact(n)) {
        for (d, weight) in d_usage.iter_mut().zip(weights) {
            *d *= 1.0 - free * weight;
        }
    }
}
