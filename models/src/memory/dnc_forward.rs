//! One step of the DNC's memory cells, on many rows (equations in `dnc.rs`, shapes in `dnc_cells.rs`).

// Only inlined code is compiled for the caller's instruction set.
#![allow(clippy::inline_always)]

use super::dnc_cells::{
    FIELDS, Interface, SMALL, Sizes, Trace, add_product, dot, keep_from_zero, part, part_mut, rising, softmax, sum,
    transpose,
};
use super::elementwise::widest;

/// A time step's rows.
pub(super) struct Rows<'a> {
    /// The state before.
    pub(super) before: [&'a [f32]; FIELDS],
    /// The state after, to be written.
    pub(super) after: [&'a mut [f32]; FIELDS],
    /// The controller's numbers; becomes what they mean.
    pub(super) xi: &'a mut [f32],
    /// Rows of the controller's output and the read vectors, of which the latter are to be written.
    pub(super) z: &'a mut [f32],
    /// To be written: a trace for each row, or one for all.
    pub(super) trace: &'a mut [f32],
}

/// Room for one row.
pub(super) struct Scratch {
    /// The memory before and after, and the link, transposed.
    before: Vec<f32>,
    after: Vec<f32>,
    link: Vec<f32>,
    /// Usages kept from zero, and allocations.
    usage: Vec<f32>,
    allocation: Vec<f32>,
    ranks: Vec<u32>,
    order: Vec<usize>,
}

impl Scratch {
    pub(super) fn new(s: Sizes) -> Self {
        let zeros = |n| vec![0.0; n];
        let (cells, memory) = (s.cells, s.cells * s.width);
        Self {
            before: zeros(memory),
            after: zeros(memory),
            link: zeros(cells * cells),
            usage: zeros(cells),
            allocation: zeros(cells),
            ranks: vec![0; cells],
            order: vec![0; cells],
        }
    }
}

widest! {
    /// One time step of some rows.
    pub(super) fn step(s: Sizes, rows: Rows<'_>, scratch: &mut Scratch) = of_any_size
}

#[inline(always)]
fn of_any_size(s: Sizes, rows: Rows<'_>, scratch: &mut Scratch) {
    // Constant sizes make loops without a remainder.
    if s == Sizes::PAPER { all(Sizes::PAPER, rows, scratch) } else { all(s, rows, scratch) }
}

#[inline(always)]
fn all(s: Sizes, rows: Rows<'_>, scratch: &mut Scratch) {
    let Rows { before, mut after, xi, z, trace } = rows;
    let count = xi.len() / s.interface();
    let z_width = z.len() / count;
    for i in 0..count {
        let mut xi = Interface::new(s, part_mut(xi, i, s.interface()));
        xi.activate();
        let at = i * s.trace() % trace.len();
        let mut trace = Trace::new(s, &mut trace[at..][..s.trace()]);
        let (before, mut after) = (s.row(before, i), s.row_mut(&mut after, i));
        let reads = &mut part_mut(z, i, z_width)[z_width - s.reads()..];
        let reads = &mut reads[..s.reads()];
        write(s, before, &mut after, &xi, &mut trace, scratch);
        connect(s, before, &mut after);
        read(s, before[3], after, &xi, &mut trace, reads, scratch);
    }
}

/// Usage, write weights and memory.
#[inline(always)]
fn write(
    s: Sizes,
    before: [&[f32]; FIELDS],
    after: &mut [&mut [f32]; FIELDS],
    xi: &Interface<&mut [f32]>,
    trace: &mut Trace<&mut [f32]>,
    scratch: &mut Scratch,
) {
    let [memory, _, _, read_weights, write_weights, usage] = before;
    let [next_memory, _, _, _, w, next_usage] = after;
    use_cells(usage, write_weights, read_weights, xi.free_gates, next_usage);

    let u = &mut scratch.usage[..s.cells];
    keep_from_zero(next_usage, u);
    let order = &mut scratch.order[..s.cells];
    rising(u, &mut scratch.ranks[..s.cells], order);
    let allocation = &mut scratch.allocation[..s.cells];
    let mut before = 1.0;
    for &mut i in order {
        allocation[i] = (1.0 - u[i]) * before;
        before *= u[i];
    }

    let transposed = &mut scratch.before[..s.cells * s.width];
    transpose(memory, transposed, s.width);
    let (likeness, content) = (&mut *trace.write_likeness, &mut *trace.write_content);
    lengths(transposed, trace.lengths[0]);
    find(transposed, trace.lengths[0], xi.write_key, xi.write_strength, likeness, content);
    let [allocation_gate, write_gate] = [xi.gates[0], xi.gates[1]];
    for ((w, a), content) in w.iter_mut().zip(&*allocation).zip(content) {
        *w = write_gate * (allocation_gate * a + (1.0 - allocation_gate) * *content);
    }

    for ((next, memory), w) in next_memory.chunks_exact_mut(s.width).zip(memory.chunks_exact(s.width)).zip(&**w) {
        for (((next, memory), erase), value) in next.iter_mut().zip(memory).zip(&*xi.erase).zip(&*xi.write_vector) {
            *next = memory * (1.0 - w * erase) + w * value;
        }
    }
}

/// The next usage.
#[inline(always)]
fn use_cells(usage: &[f32], write_weights: &[f32], read_weights: &[f32], free: &[f32], next: &mut [f32]) {
    for ((next, usage), w) in next.iter_mut().zip(usage).zip(write_weights) {
        *next = usage + (1.0 - usage) * w;
    }
    for (free, weights) in free.iter().zip(read_weights.chunks_exact(next.len())) {
        for (next, weight) in next.iter_mut().zip(weights) {
            *next *= 1.0 - free * weight;
        }
    }
}

/// The next link and precedence.
#[inline(always)]
fn connect(s: Sizes, before: [&[f32]; FIELDS], after: &mut [&mut [f32]; FIELDS]) {
    let [_, link, precedence, ..] = before;
    let [_, next_link, next_precedence, _, w, _] = after;
    let (n, w) = (s.cells, &w[..s.cells]);
    for (i, (next, link)) in next_link.chunks_exact_mut(n).zip(link.chunks_exact(n)).enumerate() {
        let down = w[i];
        for (((next, link), across), precedence) in next.iter_mut().zip(link).zip(w).zip(precedence) {
            *next = (1.0 - (down + across)) * link + down * precedence;
        }
        next[i] = 0.0;
    }
    let kept = 1.0 - sum!(n, i => w[i]);
    for ((next, precedence), w) in next_precedence.iter_mut().zip(precedence).zip(w) {
        *next = kept * precedence + w;
    }
}

/// Read weights and read vectors.
#[inline(always)]
fn read(
    s: Sizes,
    read_weights: &[f32],
    after: [&mut [f32]; FIELDS],
    xi: &Interface<&mut [f32]>,
    trace: &mut Trace<&mut [f32]>,
    reads: &mut [f32],
    scratch: &mut Scratch,
) {
    let [memory, link, _, next_weights, ..] = after;
    let (n, transposed) = (s.cells, &mut scratch.link[..s.cells * s.cells]);
    transpose(link, transposed, n);
    trace.backward.fill(0.0);
    add_product(trace.backward, read_weights, link, n);
    trace.forward.fill(0.0);
    add_product(trace.forward, read_weights, transposed, n);

    let transposed = &mut scratch.after[..s.cells * s.width];
    transpose(memory, transposed, s.width);
    lengths(transposed, trace.lengths[1]);
    find(transposed, trace.lengths[1], xi.read_keys, xi.read_strengths, trace.likeness, trace.content);
    for (head, next) in next_weights.chunks_exact_mut(n).enumerate() {
        let modes = part(xi.modes, head, 3);
        let [backward, forward, content] = [&trace.backward, &trace.forward, &trace.content].map(|x| part(x, head, n));
        for (((next, backward), forward), content) in next.iter_mut().zip(backward).zip(forward).zip(content) {
            *next = modes[0] * backward + modes[1] * forward + modes[2] * content;
        }
    }
    reads.fill(0.0);
    add_product(reads, next_weights, memory, s.width);
}

/// Lengths of the cells of a transposed memory.
#[inline(always)]
fn lengths(transposed: &[f32], lengths: &mut [f32]) {
    lengths.fill(0.0);
    for numbers in transposed.chunks_exact(lengths.len()) {
        for (length, number) in lengths.iter_mut().zip(numbers) {
            *length += number * number;
        }
    }
    for length in lengths {
        *length = length.sqrt();
    }
}

/// Likeness of each cell to each key, and weights over the cells made of it.
#[inline(always)]
fn find(
    transposed: &[f32],
    lengths: &[f32],
    keys: &[f32],
    strengths: &[f32],
    likeness: &mut [f32],
    content: &mut [f32],
) {
    let n = lengths.len();
    likeness.fill(0.0);
    add_product(likeness, keys, transposed, n);
    let heads = likeness.chunks_exact_mut(n).zip(content.chunks_exact_mut(n)).zip(strengths);
    for (((likeness, content), strength), key) in heads.zip(keys.chunks_exact(transposed.len() / n)) {
        let key_length = dot(key, key).sqrt();
        for (likeness, length) in likeness.iter_mut().zip(lengths) {
            *likeness /= length * key_length + SMALL;
        }
        for (content, likeness) in content.iter_mut().zip(&*likeness) {
            *content = strength * likeness;
        }
        softmax(content);
    }
}
