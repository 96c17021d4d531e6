//! The states of packed sequences over time, for the loops of recurrent memories on the CPU.

use std::ops::Range;

use tch::{Device, Kind, Tensor};

use super::elementwise::floats_mut;
use crate::packing::Packing;

/// The packed rows of a time step, and where in a [`Trajectory`] their states before it stand.
pub(super) struct Step {
    pub(super) now: Range<usize>,
    pub(super) before: Range<usize>,
}

impl Step {
    /// All steps of a packing.
    pub(super) fn all(packing: &Packing) -> Vec<Self> {
        let mut start = 0;
        packing
            .steps()
            .map(|now| {
                let before = start..start + now.len();
                start = now.start + packing.sequences() as usize;
                Self { now, before }
            })
            .collect()
    }
}

/// States before the first step and after each, in one tensor: `[sequences + rows, hidden]`.
pub(super) struct Trajectory {
    states: Tensor,
    sequences: usize,
    width: usize,
}

impl Trajectory {
    /// Only the states before the first step are set.
    pub(super) fn new(packing: &Packing, initial: &Tensor) -> Self {
        let (sequences, width) = (packing.sequences(), initial.size()[1] as usize);
        let states = empty(sequences + packing.rows(), width);
        states.narrow(0, 0, sequences).copy_(initial);
        Self { states, sequences: sequences as usize, width }
    }

    /// Before a step.
    pub(super) fn before(&self, step: &Step) -> Tensor {
        narrow(&self.states, &step.before)
    }

    /// After a step.
    pub(super) fn after_step(&self, step: &Step) -> Tensor {
        narrow(&self.states, &(step.now.start + self.sequences..step.now.end + self.sequences))
    }

    /// The packed rows of the step before for the sequences that are alive in this one; none before the first step.
    pub(super) fn rows_before(&self, step: &Step) -> Option<Range<usize>> {
        let start = step.before.start.checked_sub(self.sequences)?;
        Some(start..start + step.now.len())
    }

    /// Before each step, a row for each packed row.
    pub(super) fn all_before(&self, steps: &[Step]) -> Tensor {
        let rows = self.states.size()[0] as usize - self.sequences;
        if rows == self.sequences * steps.len() {
            return narrow(&self.states, &(0..rows));
        }
        Tensor::cat(&steps.iter().map(|step| self.before(step)).collect::<Vec<_>>(), 0)
    }

    /// After each step, a row for each packed row.
    pub(super) fn after(&self) -> Tensor {
        let rows = self.sequences..self.states.size()[0] as usize;
        narrow(&self.states, &rows)
    }

    /// The numbers before and after a step.
    pub(super) fn slices(&mut self, step: &Step) -> (&[f32], &mut [f32]) {
        let start = (step.now.start + self.sequences) * self.width;
        let before_step = step.before.start * self.width..step.before.end * self.width;
        let (before, after) = floats_mut(&mut self.states).split_at_mut(start);
        (&before[before_step], &mut after[..step.now.len() * self.width])
    }
}

/// Some rows of a tensor.
pub(super) fn narrow(tensor: &Tensor, rows: &Range<usize>) -> Tensor {
    tensor.narrow(0, rows.start as i64, rows.len() as i64)
}

/// f32 numbers yet to be written, `[rows, width]`, on the CPU.
pub(super) fn empty(rows: i64, width: usize) -> Tensor {
    Tensor::empty([rows, width as i64], (Kind::Float, Device::Cpu))
}
