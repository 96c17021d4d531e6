//! The service for actors: leases out, episodes in, a batch that does not depend on timing.
//!
//! | module | what it holds |
//! |---|---|
//! | `connections` | who may connect, how many, how long without a word, and how much to no use |
//! | `allowance` | how often something may happen |
//! | `account` | what happened, in `events.jsonl` |
//! | `tls` | the learner's certificate, and its actors' |
//! | `session` | one actor: handshake, checks, deadlines |
//! | `coordinator` | the single owner of sessions, leases and episodes |
//! | [`planner`] | how many leases, and to whom (pure) |
//! | [`roster`] | which actors are here, for others to see |
//! | `metrics` | what Prometheus sees |
//!
//! All of it runs on threads of its own. The trainer's thread opens an epoch, collects its batch, and at the end
//! finishes.

use std::cell::Cell;
use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::Duration;

use anyhow::Context as _;
use bytes::Bytes;
use popgym_proto::{Episode, EpisodeSpec, Fingerprint, RunSpec, Token, WeightSet, limits, monitor, transport, wire};
use tokio::sync::{mpsc, oneshot};
use tokio_stream::Stream;
use tokio_stream::wrappers::ReceiverStream;
use tonic::service::interceptor::{InterceptedService, InterceptorLayer};
use tonic::{Request, Response, Status, Streaming};

mod account;
mod allowance;
mod connections;
mod coordinator;
mod metrics;
pub mod planner;
mod reloaded;
pub mod roster;
mod session;
mod tls;

pub use planner::Target;
pub use tls::TlsFiles;

use account::Account;
use connections::{Gate, Peer};
use coordinator::{Coordinator, Event, Farewell};
use reloaded::Reloaded;
use roster::Roster;
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

/// Where actors connect.
#[derive(Debug)]
pub struct Entrance {
    /// The socket.
    pub listener: TcpListener,
    /// `None`: without TLS.
    pub tls: Option<TlsFiles>,
}

/// A running service.
pub struct Service {
    runtime: tokio::runtime::Runtime,
    events: mpsc::Sender<Event>,
    results: Receiver<Collected>,
    roster: Arc<Roster>,
    address: SocketAddr,
    /// Sent to when the server is to end.
    closing: oneshot::Sender<()>,
    server: tokio::task::JoinHandle<()>,
    /// The epoch that was opened last.
    open: Cell<Option<u64>>,
}

impl Service {
    /// Serves actors at `entrances`, of which there is at least one; all of them show the token in `token_file`, if that is
    /// given. `account` is the file in which what happens is written down. `episodes` is what their episodes look like, `fingerprint` what they must build.
    ///
    /// # Errors
    /// Specifications beyond the wire's limits, certificates or a token that cannot be read, or a system that refuses threads
    /// or the socket.
    pub fn start(
        entrances: Vec<Entrance>,
        token_file: Option<PathBuf>,
        account: Option<&Path>,
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
        let address = entrances.first().context("no listening address")?.listener.local_addr()?;
        let token = token_file.map(load_token).transpose()?;
        let (events, inbox) = mpsc::channel(limits::COORDINATOR_QUEUE);
        let (results_in, results) = std::sync::mpsc::channel();
        let roster = Arc::new(Roster::default());
        let account = account.map(|path| Account::open(path, &spec.run, spec.lag)).transpose()?.unwrap_or_default();
        let complete = Arc::default();
        let coordinator =
            Coordinator::new(spec.max_episode_steps, results_in, roster.clone(), account, Arc::clone(&complete));
        runtime.spawn(coordinator.run(inbox));
        let largest = episodes.largest_message();
        let endpoint = Endpoint {
            terms: Arc::new(Terms { spec, episodes, fingerprint, complete }),
            events: events.clone(),
            sessions: AtomicU64::new(0),
        };
        let (accepted, connections) = mpsc::channel(limits::STREAM_QUEUE);
        let gate = Arc::new(Gate::new());
        for Entrance { listener, tls } in entrances {
            let tls = tls.map(TlsFiles::load).transpose()?;
            listener.set_nonblocking(true)?;
            let listener = runtime.block_on(async { tokio::net::TcpListener::from_std(listener) })?;
            runtime.spawn(connections::accept(transport::incoming(listener), tls, gate.clone(), accepted.clone()));
        }
        let (closing, closed) = oneshot::channel::<()>();
        let server = runtime.spawn(async move {
            let (health, health_service) = tonic_health::server::health_reporter();
            health.set_service_status(wire::learner_server::SERVICE_NAME, tonic_health::ServingStatus::Serving).await;
            let authorise = move |request| authorise(token.as_deref(), request);
            let service = transport::service(endpoint).max_decoding_message_size(largest);
            let service = InterceptedService::new(service, authorise);
            let mut server = transport::server().layer(InterceptorLayer::new(count));
            let server = server.add_service(health_service).add_service(service);
            let connections = ReceiverStream::new(connections);
            if let Err(error) = server.serve_with_incoming_shutdown(connections, async { drop(closed.await) }).await {
                tracing::error!("the service for actors has ended: {error}");
            }
        });
        monitor::set_ready(true);
        Ok(Self { runtime, events, results, roster, address, closing, server, open: Cell::new(None) })
    }

    /// Where it listens.
    pub fn addr(&self) -> SocketAddr {
        self.address
    }

    /// Actors that are connected and ready.
    pub fn actors(&self) -> usize {
        self.roster.count()
    }

    /// Who they are.
    pub fn roster(&self) -> Arc<Roster> {
        self.roster.clone()
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

    /// Tells all actors that the run is complete, and why, and waits a bounded time until they have gone.
    pub fn finish(self, reason: &str) {
        let reason = reason.chars().take(limits::MAX_REASON_CHARS).collect();
        self.end(Farewell::Complete(reason));
    }

    /// As [`finish`](Self::finish), but actors are told to wait for a learner to return, as they also do where the service is
    /// dropped without a word.
    pub fn pause(self) {
        self.end(Farewell::Pause);
    }

    fn end(self, farewell: Farewell) {
        monitor::set_ready(false);
        let (gone, all_gone) = oneshot::channel();
        if self.events.blocking_send(Event::Finish { farewell, gone }).is_ok() {
            let wait = async { tokio::time::timeout(limits::FINISH_DEADLINE, all_gone).await };
            if self.runtime.block_on(wait).is_err() {
                tracing::warn!(actors = self.actors(), "not all actors have gone in time");
            }
        }
        // Their last words may still be on their way. Whoever does not go now is cut off.
        let _ = self.closing.send(());
        let _ = self.runtime.block_on(async { tokio::time::timeout(limits::CLOSE_DEADLINE, self.server).await });
        self.runtime.shutdown_timeout(Duration::from_secs(1));
    }
}

fn load_token(file: PathBuf) -> anyhow::Result<Arc<Reloaded<Token>>> {
    let token =
        Reloaded::new("the token file", vec![file.clone()], move || Token::read(&file).map_err(anyhow::Error::msg))?;
    Ok(Arc::new(token))
}

/// Refuses the requests of one who asks too often, whatever for.
#[allow(clippy::result_large_err)] // tonic's own.
fn count(request: Request<()>) -> Result<Request<()>, Status> {
    peer(&request)?.attempt()?;
    Ok(request)
}

/// Refuses a request without the token, before anything of it is read.
#[allow(clippy::result_large_err)] // tonic's own.
fn authorise(token: Option<&Reloaded<Token>>, request: Request<()>) -> Result<Request<()>, Status> {
    let shows = |token: Arc<Token>| token.is_in(request.metadata());
    // A new one may have been in its file for less than a moment.
    if token.is_none_or(|token| shows(token.get()) || shows(token.get_now())) {
        return Ok(request);
    }
    let shown = request.metadata().contains_key("authorization");
    let why = if shown { "the token is not the learner's" } else { "no token was shown" };
    peer(&request)?.refuse("token", why);
    Err(Status::unauthenticated(format!("{why}; --token-file names the file that holds it")))
}

#[allow(clippy::result_large_err)] // tonic's own.
fn peer<T>(request: &Request<T>) -> Result<Arc<Peer>, Status> {
    request.extensions().get::<Arc<Peer>>().cloned().ok_or_else(|| Status::internal("a connection without a peer"))
}

/// The gRPC face.
struct Endpoint {
    terms: Arc<Terms>,
    events: mpsc::Sender<Event>,
    sessions: AtomicU64,
}

#[tonic::async_trait]
impl wire::learner_server::Learner for Endpoint {
    type SessionStream = Pin<Box<dyn Stream<Item = Result<wire::FromLearner, Status>> + Send>>;

    async fn session(
        &self,
        request: Request<Streaming<wire::FromActor>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let peer = peer(&request)?;
        if !peer.occupy() {
            let second = "this connection has a session already";
            peer.refuse_session("second", second);
            return Err(Status::failed_precondition(second));
        }
        let id = self.sessions.fetch_add(1, Ordering::Relaxed);
        let (replies, stream) = mpsc::channel(limits::STREAM_QUEUE + 1);
        let (terms, events) = (self.terms.clone(), self.events.clone());
        tokio::spawn(async move {
            session::serve(id, &terms, request.into_inner(), &peer, replies, events).await;
            peer.dismiss();
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(stream))))
    }
}

#[cfg(test)]
mod tests;
