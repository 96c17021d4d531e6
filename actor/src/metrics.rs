//! What Prometheus sees of an actor. All names start with `popgym_actor_`.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use metrics::{counter, describe_counter, describe_gauge, gauge};
use popgym_proto::monitor;

/// What the worker's time goes to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activity {
    /// Drawing actions, stepping environments, storing the steps.
    Env,
    /// The policy.
    Inference,
    /// Observations to input vectors.
    Encoding,
    /// Episodes to messages, and waiting for the network to take them.
    Sending,
    /// Waiting for leases or weights.
    Idle,
}

const ACTIVITIES: [(Activity, &str); 5] = [
    (Activity::Env, "env"),
    (Activity::Inference, "inference"),
    (Activity::Encoding, "encoding"),
    (Activity::Sending, "sending"),
    (Activity::Idle, "idle"),
];

/// How often the numbers of the hot loop are handed over.
const FLUSH_INTERVAL: Duration = Duration::from_millis(250);

/// Serves metrics at `listen`, if given, from a thread of its own.
///
/// # Errors
/// An address that cannot be listened on.
pub fn install(listen: Option<SocketAddr>) -> anyhow::Result<()> {
    let Some(address) = listen else { return Ok(()) };
    monitor::serve(address, axum::Router::new()).map_err(anyhow::Error::msg)?;
    describe_counter!("popgym_actor_steps_total", "Environment steps");
    describe_counter!("popgym_actor_episodes_total", "Episodes finished and sent");
    describe_counter!("popgym_actor_sent_bytes_total", "Bytes of the episodes' columns");
    describe_counter!("popgym_actor_reconnects_total", "Sessions that were lost");
    describe_gauge!(
        "popgym_actor_activity_seconds_total",
        "Seconds of the worker's thread by activity; it only grows (a gauge because the crate's counters are integers)"
    );
    describe_gauge!("popgym_actor_weights_version", "Version of the weights in use");
    describe_gauge!("popgym_actor_epoch", "Epoch that is being sampled");
    describe_gauge!("popgym_actor_live_rows", "Episodes being stepped");
    // Prometheus sees no increase from nothing to 1.
    counter!("popgym_actor_reconnects_total").increment(0);
    Ok(())
}

/// A session was lost and another will be tried.
pub fn reconnecting() {
    counter!("popgym_actor_reconnects_total").increment(1);
}

/// A new epoch is being sampled.
pub fn opened(epoch: u64, version: u64) {
    gauge!("popgym_actor_epoch").set(epoch as f64);
    gauge!("popgym_actor_weights_version").set(version as f64);
}

/// The hot loop's own sums, handed over four times a second.
#[derive(Debug)]
pub struct Tally {
    seconds: [f64; ACTIVITIES.len()],
    steps: u64,
    episodes: u64,
    bytes: u64,
    lap_began: Instant,
    flushed: Instant,
}

impl Default for Tally {
    fn default() -> Self {
        let now = Instant::now();
        let seconds = [0.0; ACTIVITIES.len()];
        Self { seconds, steps: 0, episodes: 0, bytes: 0, lap_began: now, flushed: now }
    }
}

impl Tally {
    /// The time since the last lap went to `activity`.
    pub fn lap(&mut self, activity: Activity) {
        let now = Instant::now();
        self.seconds[activity as usize] += (now - self.lap_began).as_secs_f64();
        self.lap_began = now;
    }

    /// So many environment steps more.
    pub fn steps(&mut self, steps: usize) {
        self.steps += steps as u64;
    }

    /// So many episodes more, of `bytes` in all.
    pub fn sent(&mut self, episodes: usize, bytes: usize) {
        self.episodes += episodes as u64;
        self.bytes += bytes as u64;
    }

    /// Seconds of `activity` since the last hand-over.
    pub fn seconds(&self, activity: Activity) -> f64 {
        self.seconds[activity as usize]
    }

    /// Hands the sums over, if it is time (or `now`).
    pub fn flush(&mut self, live_rows: usize, now: bool) {
        if !now && self.lap_began - self.flushed < FLUSH_INTERVAL {
            return;
        }
        for (activity, label) in ACTIVITIES {
            gauge!("popgym_actor_activity_seconds_total", "activity" => label)
                .increment(self.seconds[activity as usize]);
        }
        counter!("popgym_actor_steps_total").increment(self.steps);
        counter!("popgym_actor_episodes_total").increment(self.episodes);
        counter!("popgym_actor_sent_bytes_total").increment(self.bytes);
        gauge!("popgym_actor_live_rows").set(live_rows as f64);
        *self = Self { lap_began: self.lap_began, flushed: self.lap_began, ..Self::default() };
    }
}
