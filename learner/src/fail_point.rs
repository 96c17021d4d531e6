//! Places where a test has the program die, as by SIGKILL: between two writes, and in the middle of one.
//!
//! In a build with debug assertions `POPGYM_FAIL_POINT=12` kills the process at the twelfth such place that it comes to, after a
//! line on standard error with the place's name. Other builds have no such places.

#[cfg(debug_assertions)]
use std::sync::LazyLock;
#[cfg(debug_assertions)]
use std::sync::atomic::{AtomicU64, Ordering};

/// The environment variable.
#[cfg(debug_assertions)]
const VARIABLE: &str = "POPGYM_FAIL_POINT";

#[cfg(debug_assertions)]
static LAST: LazyLock<Option<u64>> = LazyLock::new(|| std::env::var(VARIABLE).ok()?.parse().ok());
#[cfg(debug_assertions)]
static REACHED: AtomicU64 = AtomicU64::new(0);

/// Dies here if it is time to.
pub(crate) fn reached(place: &str) {
    reached_with(place, || ());
}

/// Does the `first` half of something and dies, if it is time to.
#[cfg(debug_assertions)]
pub(crate) fn reached_with(place: &str, first: impl FnOnce()) {
    if LAST.is_some_and(|last| REACHED.fetch_add(1, Ordering::SeqCst) + 1 == last) {
        first();
        eprintln!("{VARIABLE}: {place}");
        // Nothing of ours runs after it, as after SIGKILL.
        std::process::abort();
    }
}

#[cfg(not(debug_assertions))]
pub(crate) fn reached_with(_: &str, _: impl FnOnce()) {}
