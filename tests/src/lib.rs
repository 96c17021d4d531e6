//! What popgym-rs's process-level tests share: the real binaries, started in a scene of their own, watched with
//! deadlines, and gone when the test is, however it ends.
//!
//! | module | what it holds |
//! |---|---|
//! | [`process`] | one `learner` or `actor`: start, signals, log, end |
//! | [`scene`] | a temporary directory with a tiny configuration, and the runs in it |
//! | [`terminal`] | a program on a terminal of its own: keys in, the screen out |
//! | [`account`] | the checker of `events.jsonl` |
//! | [`authority`] | certificates |
//! | [`attacked`] | a run with an actor that works, and those who attack it |
//! | [`hostile`] | a client that lies |
//! | [`kustomize`] | manifests for Kubernetes, rendered |
//! | [`schemas`] | whether they are valid |
//! | [`manifests`] | the jobs in them |
//! | [`monitoring`] | dashboards, rules, the list of metrics |
//! | [`net`] | a free port, a plain HTTP request, the health service |
//!
//! Every wait has the same generous deadline: it only tells a test that hangs from one on a busy machine.
#![forbid(unsafe_code)]

use std::time::{Duration, Instant};

pub mod account;
pub mod attacked;
pub mod authority;
pub mod hostile;
pub mod kustomize;
pub mod manifests;
pub mod monitoring;
pub mod net;
pub mod process;
pub mod scene;
pub mod schemas;
pub mod terminal;

pub use account::Account;
pub use authority::Authority;
pub use process::{Outcome, Process, Program};
pub use scene::Scene;
pub use terminal::Terminal;

/// A test that waits longer than this for anything has failed.
pub const DEADLINE: Duration = Duration::from_mins(2);

/// How often a wait looks again.
pub const POLL_INTERVAL: Duration = Duration::from_millis(2);

/// Waits until `poll` has a value.
///
/// # Panics
/// With `what`, past the deadline.
pub fn until<T>(what: &str, mut poll: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + DEADLINE;
    loop {
        if let Some(value) = poll() {
            return value;
        }
        assert!(Instant::now() < deadline, "waited {DEADLINE:?} for {what}");
        std::thread::sleep(POLL_INTERVAL);
    }
}
