//! The HTTP port that both programs have beside their work: metrics for Prometheus, and whether they live and are ready.
//!
//! | path | answer |
//! |---|---|
//! | `/metrics` | all metrics of the program and its process, in Prometheus' text format |
//! | `/healthz` | 200: the process lives |
//! | `/readyz` | 200: it can do its work now ([`set_ready`]); else 503 |
//!
//! A program adds pages of its own. Whoever reaches the port can read all of it, and change nothing.

use std::net::{SocketAddr, TcpListener};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use axum::Router;
use axum::http::{HeaderMap, StatusCode, header};
use axum::routing::get;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use metrics_exporter_prometheus::{PrometheusBuilder, PrometheusHandle};
use metrics_process::Collector;
use tokio::sync::Semaphore;

use crate::limits;

/// How often distributions that nobody scrapes are made smaller.
const UPKEEP_INTERVAL: Duration = Duration::from_secs(5);

/// Prometheus' own interval, for as long as there has been one scrape only. No program waits much longer for one more.
const SCRAPE_INTERVAL: Duration = Duration::from_mins(1);

/// What a scrape may be late.
const SCRAPE_SLACK: Duration = Duration::from_secs(10);

/// A header that Prometheus sends, and those who scrape in its place; nobody who only has a look does.
const SCRAPER: &str = "x-prometheus-scrape-timeout-seconds";

/// Limits of the buckets of durations, in seconds.
const BUCKETS: [f64; 13] = [0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 25.0, 50.0, 100.0, 250.0, 500.0, 1000.0];

static READY: AtomicBool = AtomicBool::new(false);

/// When the metrics were last scraped, and the longest time between two scrapes.
static SCRAPED: Mutex<Option<(Instant, Duration)>> = Mutex::new(None);

/// Whether the program can do its work from now on: a learner is open to actors, an actor has a session.
pub fn set_ready(ready: bool) {
    READY.store(ready, Ordering::Relaxed);
}

/// Waits until the metrics are scraped once more, where they are scraped at all: for what is known only at the end.
/// `interrupted` is asked ten times a second.
pub fn wait_for_scrape(interrupted: impl Fn() -> bool) {
    let last_scrape = || *SCRAPED.lock().unwrap_or_else(PoisonError::into_inner);
    let Some((last, interval)) = last_scrape() else { return };
    let interval = if interval.is_zero() { SCRAPE_INTERVAL } else { interval.min(SCRAPE_INTERVAL) };
    let until = last + interval + SCRAPE_SLACK;
    tracing::info!("waiting for one more scrape of the metrics");
    while Instant::now() < until && !interrupted() {
        std::thread::sleep(Duration::from_millis(100));
        if last_scrape().is_some_and(|(at, _)| at != last) {
            // The answer is on its way.
            std::thread::sleep(Duration::from_millis(500));
            break;
        }
    }
}

fn scraped() {
    let mut scraped = SCRAPED.lock().unwrap_or_else(PoisonError::into_inner);
    let now = Instant::now();
    *scraped = Some((now, scraped.map_or(Duration::ZERO, |(last, longest)| longest.max(now - last))));
}

/// Makes this process's metrics known and serves them at `address`, with `pages`, from a thread of its own; once a process.
///
/// # Errors
/// An address that cannot be listened on, or metrics that go elsewhere already.
pub fn serve(address: SocketAddr, pages: Router) -> Result<(), String> {
    let problem = |error: &dyn std::fmt::Display| format!("cannot serve metrics at {address}: {error}");
    let listener = TcpListener::bind(address).map_err(|error| problem(&error))?;
    listener.set_nonblocking(true).map_err(|error| problem(&error))?;
    let recorder = PrometheusBuilder::new().set_buckets(&BUCKETS).and_then(PrometheusBuilder::install_recorder);
    let handle = recorder.map_err(|error| problem(&error))?;
    let process = Collector::default();
    process.describe();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime = runtime.map_err(|error| problem(&error))?;
    let upkeep = handle.clone();
    let router = router(handle, process).merge(pages);
    let thread = std::thread::Builder::new().name("monitor".to_owned()).spawn(move || {
        runtime.block_on(async {
            tokio::spawn(async move {
                loop {
                    tokio::time::sleep(UPKEEP_INTERVAL).await;
                    upkeep.run_upkeep();
                }
            });
            match tokio::net::TcpListener::from_std(listener) {
                Ok(listener) => accept(listener, router).await,
                Err(error) => tracing::error!("no metrics at {address}: {error}"),
            }
        });
    });
    thread.map(drop).map_err(|error| problem(&error))
}

fn router(handle: PrometheusHandle, process: Collector) -> Router {
    let metrics = move |headers: HeaderMap| {
        process.collect();
        let text = typed_by_name(&handle.render());
        if headers.contains_key(SCRAPER) {
            scraped();
        }
        std::future::ready(([(header::CONTENT_TYPE, "text/plain; version=0.0.4")], text))
    };
    let ready = || async {
        if READY.load(Ordering::Relaxed) {
            (StatusCode::OK, "ready\n")
        } else {
            (StatusCode::SERVICE_UNAVAILABLE, "not ready\n")
        }
    };
    Router::new()
        .route("/metrics", get(metrics))
        .route("/healthz", get(|| async { "alive\n" }))
        .route("/readyz", get(ready))
}

/// Gauges that are named like counters are counters: those of the `metrics` crate hold whole numbers alone, and seconds are
/// none.
fn typed_by_name(text: &str) -> String {
    text.replace("_total gauge\n", "_total counter\n")
}

/// Serves connections, as many at a time as [`limits::MONITOR_CONNECTIONS`]; none is waited for longer than a moment.
async fn accept(listener: tokio::net::TcpListener, router: Router) {
    let permits = Arc::new(Semaphore::new(limits::MONITOR_CONNECTIONS));
    loop {
        let Ok(permit) = permits.clone().acquire_owned().await else { return };
        let Ok((stream, _)) = listener.accept().await else {
            // Out of descriptors, most likely.
            tokio::time::sleep(Duration::from_millis(100)).await;
            continue;
        };
        let service = TowerToHyperService::new(router.clone());
        tokio::spawn(async move {
            let mut http = http1::Builder::new();
            let http = http.timer(TokioTimer::new()).header_read_timeout(limits::HELLO_DEADLINE);
            let connection = http.serve_connection(TokioIo::new(stream), service);
            // Who stays longer connects anew. Errors are the peer's.
            let _ = tokio::time::timeout(limits::MONITOR_CONNECTION_AGE, connection).await;
            drop(permit);
        });
    }
}
