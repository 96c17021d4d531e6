//! Secrets in files that are replaced while the learner runs: a renewed certificate, a new token.

use std::os::unix::fs::MetadataExt as _;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use tracing::{info, warn};

/// How often the files are looked at, at most.
const INTERVAL: Duration = Duration::from_secs(1);

/// What changes with a file: inode, size, and the time it was written (seconds and nanoseconds). `None`: not there.
type Stamp = Option<(u64, u64, i64, i64)>;

/// What some files hold, read again when one of them has changed. Files that are no good leave what was there before.
pub(super) struct Reloaded<T> {
    what: &'static str,
    files: Vec<PathBuf>,
    load: Box<dyn Fn() -> anyhow::Result<T> + Send + Sync>,
    state: Mutex<State<T>>,
}

struct State<T> {
    value: Arc<T>,
    stamps: Vec<Stamp>,
    looked: Instant,
}

impl<T> Reloaded<T> {
    /// `what` is the name in the log.
    pub(super) fn new(
        what: &'static str,
        files: Vec<PathBuf>,
        load: impl Fn() -> anyhow::Result<T> + Send + Sync + 'static,
    ) -> anyhow::Result<Self> {
        // Looked at before they are read, so that a change meanwhile is seen later.
        let stamps = stamps(&files);
        let state = Mutex::new(State { value: Arc::new(load()?), stamps, looked: Instant::now() });
        Ok(Self { what, files, load: Box::new(load), state })
    }

    /// What the files hold, or held when they were last good.
    pub(super) fn get(&self) -> Arc<T> {
        self.get_within(INTERVAL)
    }

    /// The same, but looks at the files in any case.
    pub(super) fn get_now(&self) -> Arc<T> {
        self.get_within(Duration::ZERO)
    }

    fn get_within(&self, interval: Duration) -> Arc<T> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        if state.looked.elapsed() >= interval {
            state.looked = Instant::now();
            let stamps = stamps(&self.files);
            if stamps != state.stamps {
                state.stamps = stamps;
                match (self.load)() {
                    Ok(value) => {
                        info!("{} has changed, and was read again", self.what);
                        state.value = Arc::new(value);
                    }
                    Err(error) => warn!("{} has changed, but the old one stays: {error:#}", self.what),
                }
            }
        }
        state.value.clone()
    }
}

fn stamps(files: &[PathBuf]) -> Vec<Stamp> {
    let stamp = |file| {
        let file = std::fs::metadata(file).ok()?;
        Some((file.ino(), file.size(), file.mtime(), file.mtime_nsec()))
    };
    files.iter().map(stamp).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_changed_file_is_read_again_and_a_bad_one_is_not_taken() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("number");
        std::fs::write(&file, "1").unwrap();
        let path = file.clone();
        let load = move || Ok(std::fs::read_to_string(&path)?.parse::<u32>()?);
        let number = Reloaded::new("the number", vec![file.clone()], load).unwrap();
        let after = |text: &str| {
            std::fs::write(&file, text).unwrap();
            number.state.lock().unwrap().looked -= INTERVAL;
            *number.get()
        };
        assert_eq!(*number.get(), 1);
        assert_eq!([after("22"), after("not a number"), after("333")], [22, 22, 333]);
        std::fs::remove_file(&file).unwrap();
        number.state.lock().unwrap().looked -= INTERVAL;
        assert_eq!(*number.get(), 333);
    }
}
