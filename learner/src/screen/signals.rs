//! Signals while the terminal is ours.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::Context as _;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;

use super::terminal;
use crate::interrupt::EXIT_INTERRUPTED;

/// How long the program may take to end by itself after a signal.
const GRACE: Duration = Duration::from_secs(1);

/// Whether a signal has asked the program to end.
#[derive(Clone, Debug)]
pub(crate) struct EndAsked(Arc<AtomicBool>);

impl EndAsked {
    /// Listens for SIGHUP, SIGINT and SIGTERM from now on. A program that has not ended within a second after the first, for
    /// whatever reason, is ended, and the terminal restored.
    ///
    /// # Errors
    /// The signals cannot be listened for.
    pub(crate) fn listen() -> anyhow::Result<Self> {
        let mut signals = Signals::new([SIGHUP, SIGINT, SIGTERM]).context("cannot listen for signals")?;
        let asked = Self(Arc::default());
        let ours = asked.clone();
        let listen = move || {
            if signals.forever().next().is_some() {
                ours.0.store(true, Ordering::SeqCst);
                std::thread::sleep(GRACE);
                terminal::restore();
                // Not exit(): that would take libtorch apart while another thread is using it.
                signal_hook::low_level::exit(i32::from(EXIT_INTERRUPTED));
            }
        };
        std::thread::Builder::new().name("signals".to_owned()).spawn(listen).context("no thread for signals")?;
        Ok(asked)
    }

    /// Whether one has come.
    pub(crate) fn is_set(&self) -> bool {
        self.0.load(Ordering::SeqCst)
    }
}
