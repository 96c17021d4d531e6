//! Who is here, for whoever wants to look.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use serde::Serialize;

/// An actor that is connected.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ActorView {
    /// Its name; no two have the same.
    pub name: String,
    /// Episodes that it steps at a time.
    pub slots: u32,
    /// Episodes that it holds leases of.
    pub leases: usize,
    /// Episodes accepted from it since it connected.
    pub episodes: u64,
    /// Their steps.
    pub steps: u64,
    /// Seconds since it connected.
    pub connected_seconds: f64,
    /// Seconds since its last episode, if there was one.
    pub silent_seconds: Option<f64>,
}

/// The actors that are connected: their number at this moment, and how they stood a few seconds ago at most.
#[derive(Debug, Default)]
pub struct Roster {
    count: AtomicUsize,
    actors: Mutex<Vec<ActorView>>,
}

impl Roster {
    /// How many are connected.
    pub fn count(&self) -> usize {
        self.count.load(Ordering::Relaxed)
    }

    /// Each of them, in the order in which they came.
    pub fn actors(&self) -> Vec<ActorView> {
        self.actors.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    pub(super) fn set_count(&self, count: usize) {
        self.count.store(count, Ordering::Relaxed);
    }

    pub(super) fn set_actors(&self, actors: Vec<ActorView>) {
        *self.actors.lock().unwrap_or_else(PoisonError::into_inner) = actors;
    }
}
