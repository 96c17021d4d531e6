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
/// a packed layout. Windows are rows of it.
pub(super) struct Windows {
    /// `[size - 1 rows a sequence + packed rows, inputs]`.
    pub rows: Tensor,
    size: i64,
    /// The rows of each packed row's window, oldest first.
    members: Tensor,
    /// The rows of each sequence's last `size - 1` steps.
    last: Tensor,
}

impl Windows {
    pub(super) fn new(input: &Tensor, packing: &Packing, state: &State, size: i64) -> Self {
        let before = state.0[0].transpose(0, 1).reshape([-1, input.size()[1]]);
        let sequences = packing.sequences();
        let mut starts: Vec<i64> = (0..size - 1).map(|t| t * sequences).collect();
        starts.extend(packing.steps().map(|now| now.start as i64 + (size - 1) * sequences));
        let mut members = Vec::with_capacity((packing.rows() * size) as usize);
        for (&alive, starts) in packing.batch_sizes().iter().zip(starts.windows(size as usize)) {
            members.extend((0..alive).flat_map(|place| starts.iter().map(move |start| start + place)));
        }
        let last = packing.lengths().iter().zip(0..).flat_map(|(&length, place)| {
            starts[length as usize..][..size as usize - 1].iter().map(move |start| start + place)
        });
        let index = |rows: Vec<i64>| Tensor::from_slice(&rows).to_device(input.device());
        Self { rows: Tensor::cat(&[&before, input], 0), size, last: index(last.collect()), members: index(members) }
    }

    /// Windows of what was made of each of [`Windows::rows`] (`[.., width]`): `[packed rows, size width]`.
    pub(super) fn of(&self, rows: &Tensor) -> Tensor {
        rows.index_select(0, &self.members).view([-1, self.size * rows.size()[1]])
    }

    /// The state after each sequence's last step.
    pub(super) fn last_state(&self) -> State {
        let rows = self.rows.index_select(0, &self.last);
        State(vec![rows.view([-1, self.size - 1, self.rows.size()[1]])])
    }
}
