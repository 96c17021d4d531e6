//! How often something may happen: a bucket of tokens.

use popgym_proto::limits::Rate;
use tokio::time::Instant;

/// Fills with a [`Rate`] and is full at first.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bucket {
    rate: Rate,
    tokens: f64,
    at: Instant,
}

impl Bucket {
    pub(super) fn new(rate: Rate, now: Instant) -> Self {
        Self { rate, tokens: f64::from(rate.burst), at: now }
    }

    /// Takes a token, if there is one.
    pub(super) fn take(&mut self, now: Instant) -> bool {
        self.fill(now);
        let any = self.tokens >= 1.0;
        if any {
            self.tokens -= 1.0;
        }
        any
    }

    /// Takes as many tokens, or all there are.
    pub(super) fn drain(&mut self, count: u32, now: Instant) {
        self.fill(now);
        self.tokens = (self.tokens - f64::from(count)).max(0.0);
    }

    /// Whether it is as good as a new one.
    pub(super) fn is_full(&mut self, now: Instant) -> bool {
        self.fill(now);
        self.tokens >= f64::from(self.rate.burst)
    }

    fn fill(&mut self, now: Instant) {
        let seconds = now.saturating_duration_since(self.at).as_secs_f64();
        self.tokens = (self.tokens + seconds * f64::from(self.rate.per_second)).min(f64::from(self.rate.burst));
        self.at = self.at.max(now);
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use popgym_proto::limits;

    use super::*;

    /// Tokens that can be taken within a second, asked for every millisecond.
    fn taken_within_a_second(bucket: &mut Bucket, from: Instant) -> usize {
        (0..1000).filter(|&i| bucket.take(from + Duration::from_millis(i))).count()
    }

    #[test]
    fn first_the_burst_then_the_rate() {
        let now = Instant::now();
        let mut bucket = Bucket::new(Rate { burst: 20, per_second: 5 }, now);
        assert!((24..=25).contains(&taken_within_a_second(&mut bucket, now)));
        for second in 1..5 {
            assert!((4..=6).contains(&taken_within_a_second(&mut bucket, now + Duration::from_secs(second))));
        }
        // Rest fills it, but never beyond the burst.
        let rested = now + Duration::from_hours(1);
        assert!(bucket.is_full(rested));
        assert!((24..=25).contains(&taken_within_a_second(&mut bucket, rested)));
    }

    #[test]
    fn a_fine_takes_what_there_is_and_no_more() {
        let now = Instant::now();
        let mut bucket = Bucket::new(Rate { burst: 10, per_second: 1 }, now);
        bucket.drain(4, now);
        assert!(!bucket.is_full(now));
        bucket.drain(100, now);
        assert!(!bucket.take(now));
        assert!(bucket.take(now + Duration::from_secs(1)));
    }

    #[test]
    fn honest_actors_never_come_near_the_limits() {
        let now = Instant::now();
        // A heartbeat every 5 s for an hour, four of them at once now and then.
        let mut heartbeats = Bucket::new(limits::HEARTBEATS, now);
        for i in 0..720 {
            let late = 3_u32.saturating_sub(i % 10);
            assert!(heartbeats.take(now + limits::HEARTBEAT_INTERVAL * (i + late)));
        }
        // All actors behind one address lose their learner, twice within five minutes.
        let mut attempts = Bucket::new(limits::ATTEMPTS, now);
        for minute in [0, 5] {
            let at = now + Duration::from_mins(minute);
            assert!((0..2 * limits::MAX_SESSIONS).all(|_| attempts.take(at)));
        }
    }
}
