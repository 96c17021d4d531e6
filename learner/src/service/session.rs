//! One actor's session: handshake, then messages both ways, each with a deadline.

use std::error::Error as _;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};

use popgym_proto::{
    ActorMessage, EpisodeBatch, EpisodeSpec, Fingerprint, Hello, LearnerMessage, Leases, OpenEpoch, PROTOCOL_VERSION,
    RunSpec, limits, wire,
};
use prost::Message as _;
use tokio::sync::{mpsc, oneshot};
use tokio::time::{Instant, MissedTickBehavior, interval, timeout};
use tonic::{Code, Status, Streaming};

use super::allowance::Bucket;
use super::connections::Peer;
use super::coordinator::Event;
use super::metrics;

/// What every session checks against.
#[derive(Debug)]
pub(super) struct Terms {
    pub(super) spec: RunSpec,
    pub(super) episodes: EpisodeSpec,
    pub(super) fingerprint: Fingerprint,
    /// Why the run is complete, once it is.
    pub(super) complete: Arc<OnceLock<String>>,
}

/// What the coordinator tells a session.
#[derive(Debug)]
pub(super) enum Order {
    /// An epoch is open. Its weights are shared by all sessions; they are left out where the session has them.
    Open(OpenEpoch),
    /// Leases of the open epoch.
    Lease(Leases),
    /// The epoch is complete.
    Close { epoch: u64 },
    /// It has kept others waiting for too long: end the session.
    Overdue,
    /// The run is complete.
    Stop { reason: String },
    /// End the session.
    End(Status),
}

/// The stream to an actor.
pub(super) type Replies = mpsc::Sender<Result<wire::FromLearner, Status>>;

/// What can be held against an actor.
#[derive(Clone, Copy, Debug)]
enum Fault {
    /// It is not an actor for this run.
    Handshake,
    /// It is one too many.
    Full,
    /// It said nothing for too long.
    Silent,
    /// It does not read what it is told.
    Unread,
    /// It does not do what it took on.
    Overdue,
    /// It sent what is no message.
    Illegal,
    /// It sent more heartbeats than anyone needs.
    Heartbeats,
    /// It sent more episodes than it was ever leased.
    Excess,
}

impl Fault {
    /// The label in the metrics.
    fn label(self) -> &'static str {
        match self {
            Self::Handshake => "handshake",
            Self::Full => "full",
            Self::Silent => "silent",
            Self::Unread => "unread",
            Self::Overdue => "overdue",
            Self::Illegal => "illegal",
            Self::Heartbeats => "heartbeats",
            Self::Excess => "excess",
        }
    }

    /// Whether nobody does this by mistake.
    fn is_a_lie(self) -> bool {
        matches!(self, Self::Illegal | Self::Heartbeats | Self::Excess)
    }
}

/// How a session ends: what the actor is told, and what is held against it.
#[derive(Debug)]
struct End {
    status: Status,
    fault: Option<Fault>,
}

impl End {
    fn because(fault: Fault, status: Status) -> Self {
        Self { status, fault: Some(fault) }
    }
}

impl From<Status> for End {
    fn from(status: Status) -> Self {
        Self { status, fault: None }
    }
}

/// Serves one stream from its first message to its end, whatever that is.
pub(super) async fn serve(
    id: u64,
    terms: &Terms,
    requests: Streaming<wire::FromActor>,
    peer: &Peer,
    replies: Replies,
    events: mpsc::Sender<Event>,
) {
    // Room for the last word, which is said whether what came before is read or not.
    let Ok(last) = replies.clone().try_reserve_owned() else { return };
    let heartbeats = Bucket::new(limits::HEARTBEATS, Instant::now());
    let mut requests = Requests { terms, peer, stream: requests, heartbeats };
    let end = attend(id, &mut requests, &replies, &events).await;
    if let Some(fault) = end.fault {
        if fault.is_a_lie() {
            peer.fine();
        }
        peer.refuse_session(fault.label(), end.status.message());
    }
    last.send(Err(end.status));
}

/// All of a session but its last word.
async fn attend(id: u64, requests: &mut Requests<'_>, replies: &Replies, events: &mpsc::Sender<Event>) -> End {
    let hello = match handshake(requests, replies).await {
        Ok(hello) => hello,
        Err(end) => return end,
    };
    let (peer, terms) = (requests.peer, requests.terms);
    let (to_session, orders) = mpsc::channel(limits::SESSION_QUEUE);
    let (reply, accepted) = oneshot::channel();
    if events.send(Event::Joined { session: id, hello, orders: to_session, reply }).await.is_err() {
        return ending(terms, peer, replies).await;
    }
    match accepted.await {
        Ok(Ok(())) => peer.welcome(terms.episodes.largest_message()),
        Ok(Err(status)) if status.code() == Code::ResourceExhausted => return End::because(Fault::Full, status),
        Ok(Err(status)) => return End::because(Fault::Handshake, status),
        Err(_) => return ending(terms, peer, replies).await,
    }
    let leased = AtomicU64::new(0);
    let end = tokio::select! {
        end = listen(id, requests, &leased, events) => end,
        end = speak(peer, orders, replies, &leased) => end,
    };
    // Fails only when the coordinator has ended, which then does not care.
    let _ = events.send(Event::Left { session: id, reason: end.status.message().to_owned() }).await;
    end
}

/// For one who comes when the coordinator has gone.
async fn ending(terms: &Terms, peer: &Peer, replies: &Replies) -> End {
    if let Some(reason) = terms.complete.get() {
        // Whether it is heard or not, the session ends.
        let _ = send(peer, replies, LearnerMessage::Stop { reason: reason.clone() }).await;
    }
    Status::unavailable("the learner is ending").into()
}

/// Hello, welcome, ready.
async fn handshake(requests: &mut Requests<'_>, replies: &Replies) -> Result<Hello, End> {
    let terms = requests.terms;
    let refused = |status| End::because(Fault::Handshake, status);
    // Its connection has a deadline for that.
    let ActorMessage::Hello(hello) = requests.next().await? else {
        return Err(refused(Status::invalid_argument("the first message must be a hello")));
    };
    check_hello(terms, &hello).map_err(refused)?;
    requests.peer.greet();
    send(requests.peer, replies, LearnerMessage::Welcome(terms.spec.clone())).await?;
    let ready = async {
        loop {
            match requests.next().await? {
                ActorMessage::Ready(fingerprint) => return Ok(fingerprint),
                ActorMessage::Heartbeat => {}
                _ => return Err(refused(Status::invalid_argument("expected ready after the welcome"))),
            }
        }
    };
    let fingerprint = match timeout(limits::READY_DEADLINE, ready).await {
        Ok(fingerprint) => fingerprint?,
        Err(_) => return Err(refused(Status::deadline_exceeded("never ready"))),
    };
    if fingerprint != terms.fingerprint {
        return Err(refused(Status::failed_precondition(format!(
            "the actor (build {}) builds another environment or policy for {} with {} than the learner (build {}); \
             use the same version of both",
            hello.build,
            terms.spec.env,
            terms.spec.memory,
            env!("CARGO_PKG_VERSION")
        ))));
    }
    Ok(hello)
}

fn check_hello(terms: &Terms, hello: &Hello) -> Result<(), Status> {
    if hello.protocol_version != PROTOCOL_VERSION {
        return Err(Status::failed_precondition(format!(
            "the actor (build {}) speaks protocol version {}, the learner (build {}) speaks {PROTOCOL_VERSION}",
            hello.build,
            hello.protocol_version,
            env!("CARGO_PKG_VERSION")
        )));
    }
    match &hello.run {
        Some(run) if *run != terms.spec.run => Err(Status::failed_precondition(format!(
            "the actor is for the run {run}, this learner's run is {}",
            terms.spec.run
        ))),
        _ => Ok(()),
    }
}

/// Passes on what the actor says, until it breaks a rule, falls silent, or goes away. `leased`: leases that it was told of.
async fn listen(id: u64, requests: &mut Requests<'_>, leased: &AtomicU64, events: &mpsc::Sender<Event>) -> End {
    let mut sent = 0;
    loop {
        let peer = requests.peer;
        let message = match unless_still(requests.next(), || peer.read()).await {
            Some(Ok(message)) => message,
            Some(Err(end)) => return end,
            None => {
                let silent = format!("silent for {} s", limits::SILENCE_LIMIT.as_secs());
                return End::because(Fault::Silent, Status::deadline_exceeded(silent));
            }
        };
        let batch = match message {
            ActorMessage::Episodes(batch) => batch,
            ActorMessage::Heartbeat => continue,
            ActorMessage::Hello(_) | ActorMessage::Ready(_) => {
                let again = Status::invalid_argument("a second handshake in one session");
                return End::because(Fault::Illegal, again);
            }
        };
        sent += batch.episodes.len() as u64;
        if let Err(end) = check_count(&batch, sent, leased.load(Ordering::Relaxed)) {
            return end;
        }
        metrics::received(batch.episodes.iter().map(popgym_proto::Episode::wire_bytes).sum());
        if events.send(Event::Episodes { session: id, batch }).await.is_err() {
            return Status::unavailable("the learner is ending").into();
        }
    }
}

/// Every episode answers a lease, in time or late, so an actor never sends more of them: `sent`, with this batch.
fn check_count(batch: &EpisodeBatch, sent: u64, leased: u64) -> Result<(), End> {
    if sent <= leased {
        return Ok(());
    }
    metrics::refused("excess", batch.episodes.len());
    let excess = format!("{sent} episodes in a session that was leased {leased}");
    Err(End::because(Fault::Excess, Status::invalid_argument(excess)))
}

/// Sends what the coordinator orders, and heartbeats while there is nothing to say.
async fn speak(peer: &Peer, mut orders: mpsc::Receiver<Order>, replies: &Replies, leased: &AtomicU64) -> End {
    let mut heartbeat = interval(limits::HEARTBEAT_INTERVAL);
    heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        let order = tokio::select! {
            order = orders.recv() => order,
            _ = heartbeat.tick() => {
                if let Err(end) = send(peer, replies, LearnerMessage::Heartbeat).await {
                    return end;
                }
                continue;
            }
        };
        let message = match order {
            Some(Order::Open(epoch)) => {
                metrics::sent(epoch.weights.as_ref().map_or(0, |weights| weights.bytes.len()));
                LearnerMessage::Epoch(epoch)
            }
            Some(Order::Lease(leases)) => {
                leased.fetch_add(leases.episodes.len() as u64, Ordering::Relaxed);
                LearnerMessage::Leases(leases)
            }
            Some(Order::Close { epoch }) => LearnerMessage::Closed { epoch },
            Some(Order::Stop { reason }) => LearnerMessage::Stop { reason },
            Some(Order::Overdue) => {
                let overdue = Status::deadline_exceeded("its leases are overdue, and go to others");
                return End::because(Fault::Overdue, overdue);
            }
            Some(Order::End(status)) => return status.into(),
            // Only a coordinator that drops a session for leaving its orders unread lets go without a word.
            None => return unread(),
        };
        if let Err(end) = send(peer, replies, message).await {
            return end;
        }
    }
}

/// Sends a message, unless the peer takes none.
async fn send(peer: &Peer, replies: &Replies, message: LearnerMessage) -> Result<(), End> {
    match unless_still(replies.send(Ok(message.into_wire())), || peer.written()).await {
        Some(sent) => sent.map_err(|_| Status::cancelled("the connection is gone").into()),
        None => Err(unread()),
    }
}

/// What `action` comes to; `None` if it takes longer than [`limits::SILENCE_LIMIT`] while next to no bytes move.
async fn unless_still<T>(action: impl Future<Output = T>, bytes: impl Fn() -> u64) -> Option<T> {
    let mut action = std::pin::pin!(action);
    loop {
        let before = bytes();
        if let Ok(outcome) = timeout(limits::SILENCE_LIMIT, &mut action).await {
            return Some(outcome);
        }
        if bytes() - before < limits::SLOWEST_BYTES {
            return None;
        }
    }
}

fn unread() -> End {
    End::because(Fault::Unread, Status::resource_exhausted("too slow: its messages were not read"))
}

/// What comes from an actor.
struct Requests<'a> {
    terms: &'a Terms,
    peer: &'a Peer,
    stream: Streaming<wire::FromActor>,
    heartbeats: Bucket,
}

impl Requests<'_> {
    /// The actor's next message, checked.
    async fn next(&mut self) -> Result<ActorMessage, End> {
        let message = match self.stream.message().await {
            Ok(Some(message)) => message,
            Ok(None) => return Err(Status::cancelled("closed its connection").into()),
            Err(status) => return Err(unreadable(&status)),
        };
        let bytes = message.encoded_len();
        let message = ActorMessage::from_wire(message, &self.terms.episodes).map_err(|error| {
            metrics::refused(error.reason(), 1);
            End::because(Fault::Illegal, Status::invalid_argument(format!("an illegal message: {error}")))
        })?;
        if message == ActorMessage::Heartbeat && !self.heartbeats.take(Instant::now()) {
            return Err(End::because(Fault::Heartbeats, Status::resource_exhausted("too many heartbeats")));
        }
        self.peer.earn(bytes);
        Ok(message)
    }
}

/// A message that gRPC could not read: the actor's doing, or its connection's.
fn unreadable(status: &Status) -> End {
    let mut cause = status.source();
    while let Some(next) = cause.and_then(std::error::Error::source) {
        cause = Some(next);
    }
    match cause {
        Some(cause) if status.message().is_empty() => Status::new(status.code(), cause.to_string()).into(),
        Some(_) => Status::new(status.code(), status.message()).into(),
        None => {
            let code = if status.code() == Code::OutOfRange { Code::OutOfRange } else { Code::InvalidArgument };
            metrics::refused("encoding", 1);
            End::because(Fault::Illegal, Status::new(code, format!("an illegal message: {}", status.message())))
        }
    }
}
