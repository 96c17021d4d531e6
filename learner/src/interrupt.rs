//! Ctrl-C and SIGTERM: the first asks the run to end cleanly, the second ends the process at once.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context;
use tokio::signal::unix::{SignalKind, signal};

/// The exit status of a run that was interrupted.
pub const EXIT_INTERRUPTED: u8 = 130;

/// Whether the user has asked to stop.
#[derive(Clone, Debug, Default)]
pub struct Interrupt {
    requested: Arc<AtomicBool>,
}

impl Interrupt {
    /// Starts listening for signals, on a thread of its own.
    ///
    /// # Errors
    /// The signals cannot be listened for.
    pub fn listen() -> anyhow::Result<Self> {
        let interrupt = Self::default();
        let requested = interrupt.requested.clone();
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let (mut ctrl_c, mut terminate) = {
            let _guard = runtime.enter();
            (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?)
        };
        let listen = move || {
            runtime.block_on(async {
                loop {
                    tokio::select! { _ = ctrl_c.recv() => {}, _ = terminate.recv() => {} }
                    if requested.swap(true, Ordering::SeqCst) {
                        // Not exit(): that would take libtorch apart while another thread is using it.
                        signal_hook::low_level::exit(i32::from(EXIT_INTERRUPTED));
                    }
                    tracing::info!("interrupted: saving and stopping; once more stops at once");
                }
            });
        };
        std::thread::Builder::new().name("signals".to_owned()).spawn(listen).context("no thread for signals")?;
        Ok(interrupt)
    }

    /// Asks to stop, too, when standard input ends: whoever has started this program and holds the other end is gone.
    ///
    /// # Errors
    /// There is no thread to wait for that.
    pub fn with_parent(&self) -> anyhow::Result<()> {
        let requested = self.requested.clone();
        let wait = move || {
            // Nothing is expected; an error is an end, too.
            let _ = std::io::copy(&mut std::io::stdin().lock(), &mut std::io::sink());
            requested.store(true, Ordering::SeqCst);
        };
        std::thread::Builder::new().name("parent".to_owned()).spawn(wait).context("no thread for the parent")?;
        Ok(())
    }

    /// Whether a signal has come.
    pub fn requested(&self) -> bool {
        self.requested.load(Ordering::SeqCst)
    }
}
