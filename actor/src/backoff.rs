//! How long to wait before the next attempt: exponential, with jitter.

use std::hash::{BuildHasher as _, RandomState};
use std::time::Duration;

/// Waits that double from `first` up to `longest`. Each is drawn from the upper half of its range, so that a hundred
/// actors that lost their learner together do not come back together.
#[derive(Clone, Debug)]
pub struct Backoff {
    first: Duration,
    longest: Duration,
    attempts: u32,
}

impl Backoff {
    /// Waits of about `first`, 2 `first`, 4 `first`, ... and at most `longest`.
    ///
    /// # Errors
    /// If `first` is zero or longer than `longest`.
    pub fn new(first: Duration, longest: Duration) -> anyhow::Result<Self> {
        anyhow::ensure!(
            !first.is_zero() && first <= longest,
            "backoff from {first:?} to {longest:?}: the first wait must be more than 0 and at most the longest"
        );
        Ok(Self { first, longest, attempts: 0 })
    }

    /// How long to wait now: uniform within `[w/2, w)`, where `w` is this attempt's longest wait.
    pub fn next_wait(&mut self) -> Duration {
        let longest = self.first.saturating_mul(2_u32.saturating_pow(self.attempts)).min(self.longest);
        self.attempts = self.attempts.saturating_add(1);
        // A fresh `RandomState` is seeded from the system: good enough to spread waits, and needs no generator.
        let random = RandomState::new().hash_one(self.attempts) >> 11;
        let uniform = random as f64 / (1_u64 << 53) as f64;
        longest.mul_f64(0.5 + 0.5 * uniform)
    }

    /// The next wait is the first again.
    pub fn reset(&mut self) {
        self.attempts = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waits_double_up_to_the_longest_and_differ() {
        let second = Duration::from_secs(1);
        let mut backoff = Backoff::new(second, 8 * second).unwrap();
        let mut waits = Vec::new();
        for longest in [1, 2, 4, 8, 8, 8] {
            let wait = backoff.next_wait();
            assert!(wait >= longest * second / 2 && wait <= longest * second, "{wait:?} of {longest} s");
            waits.push(wait);
        }
        assert!(waits[3] != waits[4] || waits[4] != waits[5]);
        backoff.reset();
        assert!(backoff.next_wait() <= second);
    }

    #[test]
    fn nonsense_is_refused() {
        let second = Duration::from_secs(1);
        assert!(Backoff::new(Duration::ZERO, second).is_err());
        assert!(Backoff::new(2 * second, second).is_err());
    }
}
