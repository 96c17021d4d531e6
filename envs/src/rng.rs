//! Random streams: one for each episode and purpose, the same on every machine.

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The generator of every stream: named and portable, so that a seed means the same episode everywhere.
pub type EpisodeRng = ChaCha8Rng;

/// What the numbers of a stream are used for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u64)]
pub enum Purpose {
    /// The environment, in training episodes.
    TrainEnv = 1,
    /// The actions, in training episodes.
    TrainAction = 2,
    /// The environment, in evaluation episodes.
    EvalEnv = 3,
    /// The actions, in evaluation episodes.
    EvalAction = 4,
    /// The learner's shuffling of minibatches.
    Shuffle = 5,
    /// The first weights.
    Weights = 6,
    /// Resampling of results, for the intervals of reports.
    Resample = 7,
}

/// The stream of `purpose` in episode `(epoch, index)` of the run seeded with `run_seed`.
///
/// The four numbers are the 256-bit key of the cipher, so two different streams never share their numbers.
pub fn stream(run_seed: u64, epoch: u64, index: u64, purpose: Purpose) -> EpisodeRng {
    let mut key = [0; 32];
    for (word, part) in key.chunks_exact_mut(8).zip([run_seed, epoch, index, purpose as u64]) {
        word.copy_from_slice(&part.to_le_bytes());
    }
    ChaCha8Rng::from_seed(key)
}

/// Uniform in `0..n`, without bias. Written out here so that a seed's episode does not hang on a library's choice of
/// algorithm (this one: Lemire, "Fast Random Integer Generation in an Interval", 2019).
///
/// # Panics
/// If `n` is 0.
#[inline]
pub fn below(rng: &mut EpisodeRng, n: u32) -> u32 {
    let mut product = u64::from(rng.next_u32()) * u64::from(n);
    if (product as u32) < n {
        let threshold = n.wrapping_neg() % n;
        while (product as u32) < threshold {
            product = u64::from(rng.next_u32()) * u64::from(n);
        }
    }
    (product >> 32) as u32
}

/// Uniform in `[low, high)`.
#[inline]
pub fn uniform(rng: &mut EpisodeRng, low: f64, high: f64) -> f64 {
    low + (high - low) * rng.random::<f64>()
}
