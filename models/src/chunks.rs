//! Packed sequences cut into chunks of equally many steps, for operators that want a rectangle.
//!
//! Chunks stand in the order of time: first the first chunks of all sequences, then the second chunks of those that are
//! long enough, and so on, each group in packed order. Only the last chunk of a sequence may be padded, with zeros at its end.

use tch::{Device, Tensor};

use crate::packing::Packing;

/// A packing's chunks.
#[derive(Debug)]
pub(crate) struct Chunks {
    size: i64,
    /// Number of chunks at each place in time, falling.
    alive: Vec<i64>,
    /// Steps in the last chunk of each sequence, in packed order.
    last_lengths: Vec<i64>,
    /// The chunk that is each sequence's last.
    last: Vec<i64>,
    /// For each step of each chunk its packed row; a row past the end for padding.
    cut: Tensor,
    /// For each packed row its step in the chunks.
    join: Tensor,
}

impl Chunks {
    /// Chunks of at most `longest` steps, as short as their number allows.
    pub(crate) fn new(packing: &Packing, longest: i64, device: Device) -> Self {
        let (lengths, rows) = (packing.lengths(), packing.rows());
        let size = div_ceil(lengths[0], div_ceil(lengths[0], longest));
        let alive: Vec<i64> = packing.batch_sizes().iter().copied().step_by(size as usize).collect();
        let mut cut = vec![rows; (alive.iter().sum::<i64>() * size) as usize];
        let mut join = vec![0; rows as usize];
        let mut first_chunk = 0;
        for (t, now) in packing.steps().enumerate() {
            let (place_in_time, step) = (t / size as usize, t as i64 % size);
            for (chunk, row) in (first_chunk..).zip(now) {
                let at = chunk * size + step;
                cut[at as usize] = row as i64;
                join[row] = at;
            }
            if step == size - 1 {
                first_chunk += alive[place_in_time];
            }
        }
        let last = lengths.iter().zip(0..).map(|(length, place)| {
            let place_in_time = (length - 1) / size;
            alive[..place_in_time as usize].iter().sum::<i64>() + place
        });
        let last = last.collect();
        let last_lengths = lengths.iter().map(|length| (length - 1) % size + 1).collect();
        let index = |rows: &[i64]| Tensor::from_slice(rows).to_device(device);
        Self { size, last_lengths, last, cut: index(&cut), join: index(&join), alive }
    }

    /// Steps of a chunk.
    pub(crate) fn size(&self) -> i64 {
        self.size
    }

    /// Steps of all chunks, padding included.
    pub(crate) fn rows(&self) -> i64 {
        self.size * self.alive.iter().sum::<i64>()
    }

    /// Packed `x [rows, width]` to chunks `[chunks, size, width]`.
    pub(crate) fn cut(&self, x: &Tensor) -> Tensor {
        let width = x.size()[1];
        with_zero_row(x).index_select(0, &self.cut).view([-1, self.size, width])
    }

    /// Chunks `[chunks, size, width]` to packed rows `[rows, width]`.
    pub(crate) fn join(&self, chunks: &Tensor) -> Tensor {
        chunks.reshape([-1, chunks.size()[2]]).index_select(0, &self.join)
    }

    /// Carries a state from chunk to chunk: `initial` (sequences along `dim`) and what each chunk adds (chunks along `dim`)
    /// to the state before each chunk, and the state after each sequence's last one. `next` is the state after a chunk.
    pub(crate) fn carry(
        &self,
        initial: &Tensor,
        added: &Tensor,
        dim: i64,
        next: impl Fn(&Tensor, &Tensor) -> Tensor,
    ) -> (Tensor, Tensor) {
        let mut before = Vec::new();
        let mut after = Vec::new();
        let mut state = initial.shallow_clone();
        for (&alive, added) in self.alive.iter().zip(added.split_with_sizes(&self.alive[..], dim)) {
            if !before.is_empty() {
                state = state.narrow(dim, 0, alive);
            }
            before.push(state.shallow_clone());
            state = next(&state, &added);
            after.push(state.shallow_clone());
        }
        let last = Tensor::from_slice(&self.last).to_device(initial.device());
        (Tensor::cat(&before, dim), Tensor::cat(&after, dim).index_select(dim, &last))
    }
}

fn with_zero_row(x: &Tensor) -> Tensor {
    Tensor::cat(&[x, &x.new_zeros([1, x.size()[1]], (x.kind(), x.device()))], 0)
}

fn div_ceil(a: i64, b: i64) -> i64 {
    (a + b - 1) / b
}
