//! Whether, on this machine, a row's result depends on the other rows of its batch.
//!
//! A run is reproducible only if it does not. Matrix products choose their kernels by size, so this is measured, not
//! assumed, for the memory at hand.

use popgym_models::{Policy, State};
use tch::Tensor;

/// Numbers of rows that are compared, beside the actor's own slots: below, at and above the kernels' blocks.
const SIZES: [i64; 7] = [16, 17, 24, 32, 48, 64, 100];

/// Steps that are compared: from the first step's zero state, and from states that differ.
const STEPS: usize = 3;

/// Whether a row's distribution parameters and next state are the same to the last bit in batches of 16 to `slots` rows
/// and wherever the row stands.
pub fn rows_are_independent(policy: &Policy, slots: u32) -> bool {
    let sizes = SIZES.into_iter().filter(|&n| n < i64::from(slots)).chain([i64::from(slots).max(SIZES[0])]);
    let sizes: Vec<i64> = sizes.collect();
    let most = sizes.iter().copied().max().unwrap_or(SIZES[0]);
    let features = random_features(most, policy.encoder().width());
    let all: Vec<i64> = (0..most).collect();
    let reference = play(policy, &features, &all);
    let backwards: Vec<i64> = all.iter().rev().copied().collect();
    let prefixes = sizes.iter().map(|&n| all[..n as usize].to_vec());
    let suffixes = sizes.iter().map(|&n| backwards[..n as usize].to_vec());
    prefixes.chain(suffixes).all(|rows| {
        let expected = reference.iter().map(|tensor| tensor.index_select(0, &Tensor::from_slice(&rows)));
        play(policy, &features, &rows).iter().zip(expected).all(|(got, expected)| same_bits(got, &expected))
    })
}

/// Parameters of each step and the last state, of the batch that consists of these rows of `features`.
fn play(policy: &Policy, features: &[Tensor], rows: &[i64]) -> Vec<Tensor> {
    let index = Tensor::from_slice(rows);
    let mut state: State = policy.initial_state(rows.len() as i64);
    let mut results = Vec::new();
    for step in features {
        let (params, next) = policy.act(&step.index_select(0, &index), &state);
        results.push(params);
        state = next;
    }
    results.extend(state.0);
    results
}

/// Equal element by element; NaN is never equal.
fn same_bits(a: &Tensor, b: &Tensor) -> bool {
    a.equal(b)
}

/// Input vectors of [`STEPS`] steps, uniform in [-1, 1): a fixed sequence, so that the answer does not vary.
fn random_features(rows: i64, width: usize) -> Vec<Tensor> {
    let mut x = 0x9e37_79b9_7f4a_7c15_u64;
    let mut next = || {
        // Xorshift: any fixed sequence without structure will do.
        x ^= x << 13;
        x ^= x >> 7;
        x ^= x << 17;
        (x >> 40) as f32 / (1 << 23) as f32 - 1.0
    };
    let values = |next: &mut dyn FnMut() -> f32| (0..rows as usize * width).map(|_| next()).collect::<Vec<f32>>();
    (0..STEPS).map(|_| Tensor::from_slice(&values(&mut next)).view([rows, width as i64])).collect()
}
