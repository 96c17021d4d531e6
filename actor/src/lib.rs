//! popgym-rs's actor: steps environments, runs recurrent inference, streams whole episodes to the learner.
//!
//! | module | what it holds |
//! |---|---|
//! | [`args`] | the command line |
//! | [`session`] | one connection: hello, welcome, ready, then epochs and leases in, episodes out |
//! | [`door`] | the way to the learner: address, TLS, token |
//! | [`backoff`] | how long to wait before the next attempt |
//! | [`worker`] | the thread of libtorch: takes what the session hears, hands back episodes |
//! | [`rollout`] | the hot loop: slots, rows, one step of all live episodes |
//! | [`invariance`] | whether a row's result depends on the number of rows, on this machine |
//! | [`metrics`] | what Prometheus sees |
//!
//! Two threads: the network's (tokio) and libtorch's. Bounded channels between them: while the network is behind, the
//! rollout waits for it.
//!
//! An actor holds nothing that is worth saving: if it dies, its leases are leased again.
#![forbid(unsafe_code)]

use std::ffi::OsString;
use std::io::IsTerminal as _;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use clap::Parser as _;
use tokio::signal::unix::{SignalKind, signal};
use tracing::info;
use tracing_subscriber::EnvFilter;

pub mod args;
pub mod backoff;
pub mod door;
pub mod invariance;
pub mod metrics;
pub mod rollout;
pub mod session;
pub mod worker;

pub use args::Args;
pub use rollout::Rollout;

use backoff::Backoff;
use session::{End, Identity};
use worker::Worker;

/// Waits before the first attempt to reconnect and, at most, before any.
const BACKOFF: (Duration, Duration) = (Duration::from_millis(200), Duration::from_secs(3));

/// Runs an actor until its run is complete, with these environments and memories. `args` as from
/// [`std::env::args_os`]; a user's own `main` adds to the registries and calls this.
///
/// Exit codes: 0, the run is complete (or the parent has gone); 1, failure, with the reason in one line on standard
/// error; 2, wrong usage.
pub fn run(
    envs: popgym_envs::Registry,
    memories: popgym_models::memory::Registry,
    args: impl IntoIterator<Item = OsString>,
) -> ExitCode {
    let args = match Args::try_parse_from(args) {
        Ok(args) => args,
        Err(usage) => {
            // Nothing better to do if standard error is closed.
            let _ = usage.print();
            return ExitCode::from(u8::try_from(usage.exit_code()).unwrap_or(2));
        }
    };
    if let Err(problem) = args.validate() {
        eprintln!("error: {problem}");
        return ExitCode::from(2);
    }
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    // Fails only where the caller has set up logging already, which is then what it wants.
    let _ = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal())
        .try_init();
    match start(envs, memories, &args) {
        Ok(()) => ExitCode::SUCCESS,
        Err(reason) => {
            eprintln!("error: {reason:#}");
            ExitCode::FAILURE
        }
    }
}

fn start(envs: popgym_envs::Registry, memories: popgym_models::memory::Registry, args: &Args) -> anyhow::Result<()> {
    if args.nice > 0 {
        // Before any thread is started: on Linux each thread has its own, inherited priority.
        rustix::process::nice(args.nice)?;
    }
    metrics::install(args.metrics_listen)?;
    let worker = Worker::spawn(envs, memories, args.slots)?;
    let network = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let result = network.block_on(async {
        tokio::select! {
            result = stay_connected(args, &worker) => result,
            () = parent_gone(args.with_parent) => Ok(()),
            () = terminated() => Err(anyhow::anyhow!("terminated")),
        }
    });
    // Ends the worker's thread before the process: libtorch must not be torn down under it.
    worker.join();
    result
}

/// Session after session, until the run is complete.
async fn stay_connected(args: &Args, worker: &Worker) -> anyhow::Result<()> {
    let patience = Duration::from_secs(args.retry_seconds);
    let mut identity = Identity::new(args);
    let mut backoff = Backoff::new(BACKOFF.0, BACKOFF.1)?;
    let (mut give_up_at, mut announced, mut known) = (Instant::now() + patience, false, false);
    loop {
        let (reason, welcomed) = match session::run(args, identity.hello(), worker, known).await {
            End::Complete(reason) => {
                info!("run complete: {reason}");
                return Ok(());
            }
            End::Failed(reason) => anyhow::bail!(reason),
            End::Lost { reason, welcomed } => (reason, welcomed),
        };
        if welcomed {
            known = true;
            metrics::reconnecting();
            backoff.reset();
            (give_up_at, announced) = (Instant::now() + patience, false);
        }
        let left = give_up_at.saturating_duration_since(Instant::now());
        if left.is_zero() {
            anyhow::bail!("no learner at {} within {} s: {reason}", args.learner, args.retry_seconds);
        }
        if !announced {
            info!("no learner at {} ({reason}); trying again for {} s", args.learner, args.retry_seconds);
            announced = true;
        }
        tokio::time::sleep(backoff.next_wait().min(left)).await;
    }
}

/// Resolves at SIGTERM, if this is the first process of a container: the system ends any other one by itself, but not
/// that one.
async fn terminated() {
    let signals = (std::process::id() == 1).then(|| signal(SignalKind::terminate()).ok()).flatten();
    let Some(mut signals) = signals else { return std::future::pending().await };
    signals.recv().await;
}

/// Resolves when standard input ends, which is when the process that holds its other end has gone. Never if not `asked`.
async fn parent_gone(asked: bool) {
    let (ended, end) = tokio::sync::oneshot::channel::<()>();
    let waits = asked
        && std::thread::Builder::new()
            .name("parent".to_owned())
            .spawn(move || {
                // An error on standard input means the same as its end.
                let _ = std::io::copy(&mut std::io::stdin().lock(), &mut std::io::sink());
                drop(ended);
            })
            .is_ok();
    if waits {
        let _ = end.await;
    } else {
        std::future::pending::<()>().await;
    }
}
