//! Ctrl-C and SIGTERM: the first asks the run to end cleanly, the second ends the process at once. After SIGTERM, with which
//! schedulers announce SIGKILL, it also ends when its time of grace is over.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::Context;
use tokio::signal::unix::{SignalKind, signal};
use tokio::time::{Instant, sleep_until};

/// The exit status of a run that was interrupted.
pub const EXIT_INTERRUPTED: u8 = 130;

/// Whether the user has asked to stop.
#[derive(Clone, Debug, Default)]
pub struct Interrupt {
    requested: Arc<AtomicBool>,
    /// Whether it was SIGTERM; set before the other.
    terminated: Arc<AtomicBool>,
    sigterm_status: u8,
}

impl Interrupt {
    /// Starts listening for signals, on a thread of its own. The process ends with status 1 where it has not ended `grace`
    /// after SIGTERM; without it there is no such end.
    ///
    /// # Errors
    /// The signals cannot be listened for.
    pub fn listen(grace: Option<Duration>) -> anyhow::Result<Self> {
        let interrupt = Self::default();
        let Self { requested, terminated, .. } = interrupt.clone();
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let (mut ctrl_c, mut terminate) = {
            let _guard = runtime.enter();
            (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?)
        };
        let listen = move || {
            runtime.block_on(async {
                let mut end = None;
                loop {
                    let by_scheduler = tokio::select! {
                        _ = ctrl_c.recv() => false,
                        _ = terminate.recv() => true,
                        () = sleep_until(end.unwrap_or_else(Instant::now)), if end.is_some() => {
                            tracing::error!("the time of grace is over: stopping at once, with the checkpoints that there are");
                            signal_hook::low_level::exit(1);
                        }
                    };
                    if requested.load(Ordering::SeqCst) {
                        // Not exit(): that would take libtorch apart while another thread is using it.
                        signal_hook::low_level::exit(i32::from(EXIT_INTERRUPTED));
                    }
                    terminated.store(by_scheduler, Ordering::SeqCst);
                    requested.store(true, Ordering::SeqCst);
                    end = grace.filter(|_| by_scheduler).map(|grace| Instant::now() + grace);
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

    /// A run that SIGTERM has ended then ends with `status`, not 0.
    #[must_use]
    pub fn with_sigterm_status(self, status: u8) -> Self {
        Self { sigterm_status: status, ..self }
    }

    /// With which status a run ends that was asked to.
    pub fn exit_status(&self) -> u8 {
        if self.terminated.load(Ordering::SeqCst) { self.sigterm_status } else { EXIT_INTERRUPTED }
    }

    /// Whether a signal has come.
    pub fn requested(&self) -> bool {
        self.requested.load(Ordering::SeqCst)
    }
}
