//! How libtorch's threads wait for one another.
//!
//! Between two parallel loops they spin. Left alone they spin for milliseconds, and where anything else runs on the
//! same cores the one that holds a core spins for the one that waits for it: beside two busy processes on two cores an
//! update took 4 to 13 times as long. With a bounded spin (some microseconds, longer than the usual wait) they are as fast on
//! idle cores, and give way on busy ones. Neither changes the order of sums. The runtime reads its settings
//! when it is loaded, before `main`: so the program starts itself once more with them set.

use std::os::unix::process::CommandExt;
use std::process::Command;

/// Each setting, with the variables of the user's own that stand in its place: OpenMP's bounded spin; and that MKL keeps to
/// the number of threads it is told, because that number decides the order of sums.
const SETTINGS: [(&str, &str, &[&str]); 2] =
    [("GOMP_SPINCOUNT", "10000", &["GOMP_SPINCOUNT", "OMP_WAIT_POLICY"]), ("MKL_DYNAMIC", "FALSE", &["MKL_DYNAMIC"])];

/// Replaces this process by itself with the settings in its environment, unless they are there. Where that fails, the
/// program goes on as it is, only slower.
pub fn settle() {
    let is_set = |name: &&str| std::env::var_os(name).is_some();
    let mut missing = SETTINGS.iter().filter(|(_, _, own)| !own.iter().any(is_set)).peekable();
    if missing.peek().is_none() {
        return;
    }
    let Ok(program) = std::env::current_exe() else { return };
    let mut arguments = std::env::args_os();
    let mut command = Command::new(program);
    if let Some(name) = arguments.next() {
        command.arg0(name);
    }
    let error = command.args(arguments).envs(missing.map(|(name, value, _)| (name, value))).exec();
    tracing::warn!("cannot start again with bounded spinning: {error}");
}
