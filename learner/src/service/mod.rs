//! The service for actors: leases out, episodes in, a batch that does not depend on timing.
//!
//! | module | what it holds |
//! |---|---|
//! | `session` | one actor: handshake, checks, deadlines |
//! | `coordinator` | the single owner of sessions, leases and episodes |
//! | [`planner`] | how many leases, and to whom (pure) |
//! | `metrics` | what Prometheus sees |
//!
//! All of it runs on threads of its own. The trainer's thread opens an epoch, collects its batch, and at the end
//! finishes.

use std::cell::Cell;
use std::net::{SocketAddr, TcpListener};
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::Duration;

use anyhow::Context as _;
use bytes::Bytes;
use popgym_proto::{Episode, EpisodeSpec, Fingerprint, RunSpec, WeightSet, limits, transport, wire};
use tokio::sync::{Semaphore, mpsc, oneshot};
use tokio_stream::Stream;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status, Streaming};

mod coordinator;
mod metrics;
pub mod planner;
mod session;

pub use planner::Target;

use coordinator::{Coordinator, Event, Shared};
use session::Terms;

/// Threads of the network. One serves hundreds of actors; the second keeps heartbeats going while the first checks a
/// large message.
const NETWORK_THREADS: usize = 2;

/// How often a wait for episodes looks whether it was interrupted.
const INTERRUPT_INTERVAL: Duration = Duration::from_millis(50);

/// The batch of an epoch.
#[derive(Clone, Debug, PartialEq)]
pub struct Collected {
    /// The epoch.
    pub epoch: u64,
    /// The version it was sampled with.
    pub version: u64,
    /// Episodes `0..n` in the order of their numbers: the shortest prefix that reaches the target.
    pub episodes: Vec<Episode>,
    /// Their steps.
    pub steps: u64,
    /// Episodes that were received beyond the prefix, and dropped.
    pub surplus_episodes: u64,
    /// Their steps.
    pub surplus_steps: u64,
    /// From the opening of the epoch to its last episode.
    pub seconds: f64,
}

/// A running service.
pub struct Service {
    runtime: tokio::runtime::Runtime,
    events: mpsc::Sender<Event>,
    results: Receiver<Collected>,
    shared: Arc<Shared>,
    address: SocketAddr,
    /// The epoch that was opened last.
    open: Cell<Option<u64>>,
}

impl Service {
    /// Serves actors on `listener`. `episodes` is what their episodes look like, `fingerprint` what they must build.
    ///
    /// # Errors
    /// Specifications beyond the wire's limits, or a system that refuses threads or the socket.
    pub fn start(
        listener: TcpListener,
        spec: RunSpec,
        episodes: EpisodeSpec,
        fingerprint: Fingerprint,
    ) -> anyhow::Result<Self> {
        spec.check().context("the run's specification")?;
        episodes.check().context("the run's episodes")?;
        metrics::describe();
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(NETWORK_THREADS)
            .thread_name("network")
            .enable_all()
            .build()?;
        let address = listener.local_addr()?;
        listener.set_nonblocking(true)?;
        let (events, inbox) = mpsc::channel(limits::COORDINATOR_QUEUE);
        let (results_in, results) = std::sync::mpsc::channel();
        let shared = Arc::new(Shared::default());
        runtime.spawn(Coordinator::new(spec.max_episode_steps, results_in, shared.clone()).run(inbox));
        let endpoint = Endpoint {
            terms: Arc::new(Terms { spec, episodes, fingerprint }),
            events: events.clone(),
            permits: Arc::new(Semaphore::new(limits::MAX_SESSIONS)),
            sessions: AtomicU64::new(0),
        };
        let listener = runtime.block_on(async { tokio::net::TcpListener::from_std(listener) })?;
        runtime.spawn(async move {
            let (health, health_service) = tonic_health::server::health_reporter();
            health.set_service_status(wire::learner_server::SERVICE_NAME, tonic_health::ServingStatus::Serving).await;
            let server = transport::server().add_service(health_service).add_service(transport::service(endpoint));
            if let Err(error) = server.serve_with_incoming(transport::incoming(listener)).await {
                tracing::error!("the service for actors has ended: {error}");
            }
        });
        Ok(Self { runtime, events, results, shared, address, open: Cell::new(None) })
    }

    /// Where it listens.
    pub fn addr(&self) -> SocketAddr {
        self.address
    }

    /// Actors that are connected and ready.
    pub fn actors(&self) -> usize {
        self.shared.actors.load(Ordering::Relaxed)
    }

    /// Opens `epoch` for sampling with `weights` (safetensors) of `version`. An epoch that was open before is void.
    ///
    /// # Errors
    /// Weights that cannot travel, or a service that has died.
    pub fn open(&self, epoch: u64, version: u64, weights: Bytes, target: Target) -> anyhow::Result<()> {
        let weights = WeightSet::new(version, weights)?;
        self.open.set(Some(epoch));
        self.events.blocking_send(Event::Open { epoch, weights, target }).context("the service for actors has died")
    }

    /// Waits for the batch of the epoch that was opened last. `None`: `interrupted` said so (asked twenty times a
    /// second), nothing is open, or the service has died.
    pub fn collect(&self, interrupted: impl Fn() -> bool) -> Option<Collected> {
        let open = self.open.get()?;
        loop {
            match self.results.recv_timeout(INTERRUPT_INTERVAL) {
                Ok(collected) if collected.epoch == open => {
                    self.open.set(None);
                    return Some(collected);
                }
                Err(RecvTimeoutError::Timeout) if interrupted() => return None,
                // `Ok`: of an epoch that was opened over.
                Ok(_) | Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return None,
            }
        }
    }

    /// Tells all actors that the run is complete, and why, and waits a bounded time until they have gone. A service that
    /// is dropped instead leaves them waiting for a learner to return.
    pub fn finish(self, reason: &str) {
        let (gone, all_gone) = oneshot::channel();
        let reason = reason.chars().take(limits::MAX_REASON_CHARS).collect();
        if self.events.blocking_send(Event::Finish { reason, gone }).is_ok() {
            let wait = async { tokio::time::timeout(limits::FINISH_DEADLINE, all_gone).await };
            if self.runtime.block_on(wait).is_err() {
                tracing::warn!(actors = self.actors(), "not all actors have gone in time");
            }
        }
        self.runtime.shutdown_timeout(Duration::from_secs(1));
    }
}

/// The gRPC face.
struct Endpoint {
    terms: Arc<Terms>,
    events: mpsc::Sender<Event>,
    permits: Arc<Semaphore>,
    sessions: AtomicU64,
}

#[tonic::async_trait]
impl wire::learner_server::Learner for Endpoint {
    type SessionStream = Pin<Box<dyn Stream<Item = Result<wire::FromLearner, Status>> + Send>>;

    async fn session(
        &self,
        request: Request<Streaming<wire::FromActor>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let Ok(permit) = self.permits.clone().try_acquire_owned() else {
            let full = format!("this learner has {} actors, which is the most it takes", limits::MAX_SESSIONS);
            return Err(Status::resource_exhausted(full));
        };
        let id = self.sessions.fetch_add(1, Ordering::Relaxed);
        let (replies, stream) = mpsc::channel(limits::STREAM_QUEUE);
        let serve = session::serve(id, self.terms.clone(), request.into_inner(), replies, self.events.clone());
        tokio::spawn(async move {
            serve.await;
            drop(permit);
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(stream))))
    }
}

#[cfg(test)]
mod tests;
