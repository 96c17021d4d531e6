//! Sequences of unequal length without padding.
//!
//! Packed rows stand time step by time step, the sequences of each step in order of falling length: all first steps,
//! all second steps, and so on, like PyTorch's `PackedSequence`. A sequence that has ended is simply no longer there.

use std::ops::Range;

use tch::{Device, Tensor};

/// How sequences of given lengths are packed.
#[derive(Debug)]
pub struct Packing {
    /// Lengths in packed order (falling).
    lengths: Vec<i64>,
    /// For each place in packed order, which sequence (in the caller's order) stands there.
    order: Vec<usize>,
    /// Number of sequences that are alive at each time step.
    batch_sizes: Vec<i64>,
}

impl Packing {
    /// A packing of sequences with these lengths, each 1 or more.
    pub fn new(lengths: &[i64]) -> Self {
        debug_assert!(!lengths.is_empty() && lengths.iter().all(|&length| length > 0));
        let mut order: Vec<usize> = (0..lengths.len()).collect();
        order.sort_by_key(|&sequence| std::cmp::Reverse(lengths[sequence]));
        let sorted: Vec<i64> = order.iter().map(|&sequence| lengths[sequence]).collect();
        let batch_sizes = (0..sorted[0]).map(|t| sorted.partition_point(|&length| length > t) as i64).collect();
        Self { lengths: sorted, order, batch_sizes }
    }

    /// Number of sequences.
    pub fn sequences(&self) -> i64 {
        self.lengths.len() as i64
    }

    /// Lengths in packed order, falling.
    pub fn lengths(&self) -> &[i64] {
        &self.lengths
    }

    /// For each place in packed order, the sequence's number in the caller's order.
    pub fn order(&self) -> &[usize] {
        &self.order
    }

    /// Number of packed rows: the sum of the lengths.
    pub fn rows(&self) -> i64 {
        self.batch_sizes.iter().sum()
    }

    /// Number of sequences alive at each time step, falling.
    pub fn batch_sizes(&self) -> &[i64] {
        &self.batch_sizes
    }

    /// The packed rows of each time step.
    pub fn steps(&self) -> impl Iterator<Item = Range<usize>> {
        self.batch_sizes.iter().scan(0, |start, &alive| {
            let first = *start;
            *start += alive as usize;
            Some(first..*start)
        })
    }

    /// The time step of each packed row, `[rows]`.
    pub(crate) fn times(&self, device: Device) -> Tensor {
        let times = self.batch_sizes.iter().zip(0..).flat_map(|(&alive, t)| std::iter::repeat_n(t, alive as usize));
        Tensor::from_slice(&times.collect::<Vec<i64>>()).to_device(device)
    }

    /// The batch sizes as PyTorch's packed operators want them: i64 on the CPU.
    pub fn batch_sizes_tensor(&self) -> Tensor {
        Tensor::from_slice(&self.batch_sizes)
    }

    /// The packed row of each sequence's last step, in packed order.
    pub(crate) fn last_rows(&self) -> Tensor {
        let starts: Vec<i64> =
            self.batch_sizes.iter().scan(0, |sum, &alive| Some(std::mem::replace(sum, *sum + alive))).collect();
        let rows = self.lengths.iter().zip(0..).map(|(&length, place)| starts[length as usize - 1] + place);
        Tensor::from_slice(&rows.collect::<Vec<i64>>())
    }

    /// For each packed row, its row in a storage where sequence `i` (the caller's order) occupies the rows from
    /// `starts[i]` on: the index for `index_select`.
    pub fn gather_index(&self, starts: &[i64], device: Device) -> Tensor {
        let mut index = Vec::with_capacity(self.rows() as usize);
        for (t, &alive) in self.batch_sizes.iter().enumerate() {
            index.extend(self.order[..alive as usize].iter().map(|&sequence| starts[sequence] + t as i64));
        }
        Tensor::from_slice(&index).to_device(device)
    }

    /// Cuts the packing into spans of at most `steps` time steps (0: one span). Each span is a packing of its own of the
    /// sequences still alive at its start, whose rows are a contiguous range of this one's rows.
    pub fn spans(&self, steps: i64) -> Vec<Span> {
        let steps = if steps == 0 { self.lengths[0] } else { steps };
        let mut first_row = 0;
        self.batch_sizes
            .chunks(steps as usize)
            .enumerate()
            .map(|(i, batch_sizes)| {
                let start = i as i64 * steps;
                let alive = batch_sizes[0] as usize;
                let packing = Packing {
                    lengths: self.lengths[..alive].iter().map(|length| (length - start).min(steps)).collect(),
                    order: (0..alive).collect(),
                    batch_sizes: batch_sizes.to_vec(),
                };
                let span = Span { first_row, packing };
                first_row += span.packing.rows();
                span
            })
            .collect()
    }
}

/// A range of time steps of a [`Packing`].
#[derive(Debug)]
pub struct Span {
    /// Its first row in the whole packing.
    pub first_row: i64,
    /// The packing of its rows, sequences in the whole packing's order.
    pub packing: Packing,
}
