//! The last few inputs of every step: what `frame_stack` and `tcn` see.
//!
//! The state holds the inputs of the last `size - 1` steps, `[rows, size - 1, inputs]`, the oldest first, zeros before the
//! start.

use tch::{Device, Kind, Tensor};

use super::State;
use crate::packing::Packing;

/// How many steps a window may span.
pub(super) fn check_window(key: &str, value: i64) -> Result<i64, String> {
    if (2..=1024).contains(&value) { Ok(value) } else { Err(format!("`{key}` is {value}, allowed is 2..=1024")) }
}

/// The state of no input yet.
pub(super) fn initial_state(rows: i64, size: i64, input_width: i64, device: Device) -> State {
    State(vec![Tensor::zeros([rows, size - 1, input_width], (Kind::Float, device))])
}

/// One step: the window `[rows, size, inputs]` that ends with `input [rows, inputs]`, and the next state.
pub(super) fn slide(input: &Tensor, state: &State, size: i64) -> (Tensor, State) {
    let window = Tensor::cat(&[&state.0[0], &input.unsqueeze(1)], 1);
    let next = window.narrow(1, 1, size - 1);
    (window, State(vec![next]))
}

/// All windows of a scan.
///
/// The state's rows are put before the packed ones, as if every sequence had begun `size - 1` steps earlier; that, too, is
/// a packed layout, in which what is some steps older stands in runs: the rows of steps with equally many sequences.
pub(super) struct Windows {
    /// `[size - 1 rows a sequence + packed rows, inputs]`.
    pub rows: Tensor,
    /// Where each step's rows start, and how many they are.
    steps: Vec<(i64, i64)>,
    size: usize,
    lengths: Vec<i64>,
}

impl Windows {
    pub(super) fn new(input: &Tensor, packing: &Packing, state: &State, size: i64) -> Self {
        let before = state.0[0].transpose(0, 1).reshape([-1, input.size()[1]]);
        let sequences = packing.sequences();
        let mut steps: Vec<(i64, i64)> = (0..size - 1).map(|t| (t * sequences, sequences)).collect();
        let first = (size - 1) * sequences;
        steps.extend(packing.steps().map(|now| (first + now.start as i64, now.len() as i64)));
        let rows = Tensor::cat(&[&before, input], 0);
        Self { rows, steps, size: size as usize, lengths: packing.lengths().to_vec() }
    }

    /// Windows of what was made of each of [`Windows::rows`] (`[.., width]`): `[packed rows, size width]`.
    pub(super) fn of(&self, rows: &Tensor) -> Tensor {
        let ages: Vec<Tensor> = (0..self.size).map(|frame| self.frame(rows, frame)).collect();
        Tensor::cat(&ages, 1)
    }

    /// The row of each packed row's window that stands at `frame`. Not an index: the gradient of one is added row by row.
    fn frame(&self, rows: &Tensor, frame: usize) -> Tensor {
        let alive = self.steps[self.size - 1..].iter().map(|&(_, alive)| alive);
        // Runs of rows that are taken, and of those between them.
        let (mut sizes, mut taken, mut end) = (Vec::new(), Vec::new(), 0);
        for (&(start, _), alive) in self.steps[frame..].iter().zip(alive) {
            if start == end && taken.last() == Some(&(sizes.len() as i64 - 1)) {
                *sizes.last_mut().expect("a run") += alive;
            } else {
                if start > end {
                    sizes.push(start - end);
                }
                taken.push(sizes.len() as i64);
                sizes.push(alive);
            }
            end = start + alive;
        }
        let left = rows.size()[0] - end;
        if left > 0 {
            sizes.push(left);
        }
        let parts = rows.split_with_sizes(&sizes, 0);
        match taken[..] {
            // Sequences of equal length: nothing to copy.
            [run] => parts[run as usize].shallow_clone(),
            _ => Tensor::cat(&taken.iter().map(|&run| &parts[run as usize]).collect::<Vec<_>>(), 0),
        }
    }

    /// The state after each sequence's last step.
    pub(super) fn last_state(&self) -> State {
        let last = self.lengths.iter().zip(0..).flat_map(|(&length, place)| {
            self.steps[length as usize..][..self.size - 1].iter().map(move |&(start, _)| start + place)
        });
        let last = Tensor::from_slice(&last.collect::<Vec<i64>>()).to_device(self.rows.device());
        let rows = self.rows.index_select(0, &last);
        State(vec![rows.view([-1, self.size as i64 - 1, self.rows.size()[1]])])
    }
}
