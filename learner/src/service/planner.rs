//! How many leases to have outstanding, and who gets them. Pure: numbers in, numbers out.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use popgym_proto::limits;
use serde::Serialize;

/// What makes a batch complete.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Target {
    /// The shortest prefix with at least so many steps.
    Steps(u64),
    /// The first so many episodes.
    Episodes(u64),
}

impl Target {
    /// Whether a prefix of `episodes` episodes and `steps` steps is a batch.
    pub fn reached(self, episodes: u64, steps: u64) -> bool {
        match self {
            Self::Steps(target) => steps >= target,
            Self::Episodes(target) => episodes >= target,
        }
    }
}

/// The mean length of an episode, in steps: an expectation that gives way to what is seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LengthEstimate {
    steps: f64,
    episodes: f64,
}

impl LengthEstimate {
    /// Episodes that an epoch before counts for. An epoch's short episodes arrive first, so a mean over what has arrived
    /// is too low; the epoch before is not biased so, and changes little from one to the next.
    const PREVIOUS_EPOCH: f64 = 64.0;

    /// Nothing is known but that no episode is longer.
    pub fn unknown(max_steps: u32) -> Self {
        Self { steps: f64::from(max_steps), episodes: 1.0 }
    }

    /// An episode of `steps` steps was seen.
    pub fn see(&mut self, steps: usize) {
        self.steps += steps as f64;
        self.episodes += 1.0;
    }

    /// The expectation for the next epoch, after one with a batch of this mean length.
    pub fn next_epoch(mean_steps: f64) -> Self {
        Self { steps: Self::PREVIOUS_EPOCH * mean_steps, episodes: Self::PREVIOUS_EPOCH }
    }

    /// Steps an episode, at least 1.
    pub fn mean(self) -> f64 {
        (self.steps / self.episodes).max(1.0)
    }
}

/// Where an epoch stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress {
    /// Episodes received, whatever their index.
    pub received: u64,
    /// Their steps.
    pub received_steps: u64,
    /// Episodes leased and not received.
    pub outstanding: u64,
}

/// How many further leases it takes for the batch, given that each lease becomes an episode of about `length` steps.
///
/// All leased episodes are received in the end, so the prefix reaches the target when received and outstanding ones
/// together do. No margin: what turns out to be missing is leased as soon as that is known, and a surplus would be
/// thrown away.
pub fn further_leases(target: Target, progress: Progress, length: LengthEstimate) -> u64 {
    let further = match target {
        Target::Steps(target) => {
            let expected = progress.received_steps as f64 + progress.outstanding as f64 * length.mean();
            ((target as f64 - expected) / length.mean()).ceil().max(0.0) as u64
        }
        Target::Episodes(target) => target.saturating_sub(progress.received + progress.outstanding),
    };
    // Whatever the estimate says, an epoch that is not complete has an episode under way.
    if progress.outstanding == 0 { further.max(1) } else { further }
}

/// An actor as the planner sees it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Seat {
    /// Whose it is.
    pub session: u64,
    /// Episodes it steps at a time.
    pub slots: u32,
    /// Leases it holds.
    pub held: usize,
}

impl Seat {
    /// Most leases that it may hold: half as many again as it has slots, so that a slot does not stay empty for a round
    /// trip.
    fn capacity(self) -> usize {
        (self.slots as usize + self.slots as usize / 2 + 1).min(limits::MAX_LEASES)
    }

    /// Leases a slot, in 2^-16.
    fn load(self) -> u64 {
        ((self.held as u64) << 16) / u64::from(self.slots.max(1))
    }
}

/// Who gets the next `count` leases: a session for each, in the order of the leases. Always the least loaded, so slots
/// fill evenly; fewer than `count` where all are full.
pub fn assign(count: usize, seats: impl IntoIterator<Item = Seat>) -> Vec<u64> {
    let room = |seat: &Seat| seat.held < seat.capacity();
    // The session's number makes equal loads definite.
    let entry = |seat: Seat| Reverse((seat.load(), seat.session, seat.slots, seat.held));
    let mut heap: BinaryHeap<_> = seats.into_iter().filter(room).map(entry).collect();
    let mut sessions = Vec::new();
    while sessions.len() < count
        && let Some(Reverse((_, session, slots, held))) = heap.pop()
    {
        sessions.push(session);
        let seat = Seat { session, slots, held: held + 1 };
        if room(&seat) {
            heap.push(entry(seat));
        }
    }
    sessions
}

#[cfg(test)]
mod tests {
    use super::*;

    fn progress(received: u64, received_steps: u64, outstanding: u64) -> Progress {
        Progress { received, received_steps, outstanding }
    }

    #[test]
    fn episodes_of_one_length_leave_no_surplus() {
        let length = LengthEstimate::next_epoch(51.0);
        let leased = further_leases(Target::Steps(65_536), progress(0, 0, 0), length);
        assert_eq!(leased, 65_536_u64.div_ceil(51));
        assert_eq!(further_leases(Target::Steps(65_536), progress(0, 0, leased), length), 0);
        assert_eq!(further_leases(Target::Steps(65_536), progress(100, 5_100, leased - 100), length), 0);
    }

    #[test]
    fn a_target_in_episodes_is_exact() {
        let length = LengthEstimate::unknown(10);
        assert_eq!(further_leases(Target::Episodes(30), progress(0, 0, 0), length), 30);
        assert_eq!(further_leases(Target::Episodes(30), progress(10, 1, 15), length), 5);
        assert_eq!(further_leases(Target::Episodes(30), progress(10, 1, 20), length), 0);
    }

    #[test]
    fn short_episodes_are_made_up_for() {
        let mut length = LengthEstimate::unknown(200);
        for _ in 0..20 {
            length.see(20);
        }
        assert!(length.mean() < 30.0);
        assert!(further_leases(Target::Steps(10_000), progress(20, 400, 30), length) > 250);
    }

    #[test]
    fn something_is_always_under_way() {
        let length = LengthEstimate::next_epoch(1000.0);
        assert_eq!(further_leases(Target::Steps(100), progress(3, 100, 0), length), 1);
    }

    #[test]
    fn leases_are_spread_by_slots() {
        let seats =
            [(1, 128, 0), (2, 64, 0), (3, 128, 100)].map(|(session, slots, held)| Seat { session, slots, held });
        let sessions = assign(96, seats);
        let count = |of: u64| sessions.iter().filter(|&&session| session == of).count();
        assert_eq!((count(1), count(2), count(3)), (64, 32, 0));
    }

    #[test]
    fn full_actors_get_nothing() {
        let seats = [Seat { session: 1, slots: 4, held: 0 }, Seat { session: 2, slots: 4, held: 7 }];
        assert_eq!(assign(100, seats), vec![1; 7]);
        assert_eq!(assign(100, []), Vec::<u64>::new());
    }
}
