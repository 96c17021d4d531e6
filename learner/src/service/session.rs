//! One actor's session: handshake, then messages both ways, each with a deadline.

use std::time::Duration;

use popgym_proto::{
    ActorMessage, EpisodeSpec, Fingerprint, Hello, LearnerMessage, Leases, OpenEpoch, PROTOCOL_VERSION, RunSpec,
    limits, wire,
};
use tokio::sync::{mpsc, oneshot};
use tokio::time::{MissedTickBehavior, interval, timeout};
use tonic::{Status, Streaming};

use super::connections::Peer;
use super::coordinator::Event;
use super::metrics;

/// What every session checks against.
#[derive(Debug)]
pub(super) struct Terms {
    pub(super) spec: RunSpec,
    pub(super) episodes: EpisodeSpec,
    pub(super) fingerprint: Fingerprint,
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
    /// The run is complete.
    Stop { reason: String },
    /// End the session.
    End(Status),
}

/// The stream to an actor.
pub(super) type Replies = mpsc::Sender<Result<wire::FromLearner, Status>>;

/// Serves one stream from its first message to its end, whatever that is.
pub(super) async fn serve(
    id: u64,
    terms: &Terms,
    mut requests: Streaming<wire::FromActor>,
    peer: &Peer,
    replies: Replies,
    events: mpsc::Sender<Event>,
) {
    let hello = match handshake(terms, &mut requests, peer, &replies).await {
        Ok(hello) => hello,
        Err(status) => {
            metrics::handshake_refused();
            tracing::debug!(%status, "handshake refused");
            return refuse(&replies, status).await;
        }
    };
    let (to_session, orders) = mpsc::channel(limits::SESSION_QUEUE);
    let (reply, accepted) = oneshot::channel();
    if events.send(Event::Joined { session: id, hello, orders: to_session, reply }).await.is_err() {
        return refuse(&replies, Status::unavailable("the learner is ending")).await;
    }
    match accepted.await {
        Ok(Ok(())) => {}
        Ok(Err(status)) => {
            metrics::handshake_refused();
            return refuse(&replies, status).await;
        }
        Err(_) => return refuse(&replies, Status::unavailable("the learner is ending")).await,
    }
    let status = tokio::select! {
        status = listen(id, terms, &mut requests, &events) => status,
        status = speak(orders, &replies) => status,
    };
    let reason = status.message().to_owned();
    refuse(&replies, status).await;
    // Fails only when the coordinator has ended, which then does not care.
    let _ = events.send(Event::Left { session: id, reason }).await;
}

/// Ends the stream with `status`. Waits a moment where the actor has not read what came before.
async fn refuse(replies: &Replies, status: Status) {
    let _ = timeout(Duration::from_secs(1), replies.send(Err(status))).await;
}

/// Hello, welcome, ready.
async fn handshake(
    terms: &Terms,
    requests: &mut Streaming<wire::FromActor>,
    peer: &Peer,
    replies: &Replies,
) -> Result<Hello, Status> {
    let hello = match timeout(limits::HELLO_DEADLINE, next(terms, requests)).await {
        Ok(Ok(ActorMessage::Hello(hello))) => hello,
        Ok(Ok(_)) => return Err(Status::invalid_argument("the first message must be a hello")),
        Ok(Err(status)) => return Err(status),
        Err(_) => return Err(Status::deadline_exceeded("no hello")),
    };
    check_hello(terms, &hello)?;
    peer.welcome();
    send(replies, LearnerMessage::Welcome(terms.spec.clone())).await?;
    let ready = async {
        loop {
            match next(terms, requests).await? {
                ActorMessage::Ready(fingerprint) => return Ok(fingerprint),
                ActorMessage::Heartbeat => {}
                _ => return Err(Status::invalid_argument("expected ready after the welcome")),
            }
        }
    };
    let fingerprint =
        timeout(limits::READY_DEADLINE, ready).await.map_err(|_| Status::deadline_exceeded("never ready"))??;
    if fingerprint != terms.fingerprint {
        return Err(Status::failed_precondition(format!(
            "the actor (build {}) builds another environment or policy for {} with {} than the learner (build {}); \
             use the same version of both",
            hello.build,
            terms.spec.env,
            terms.spec.memory,
            env!("CARGO_PKG_VERSION")
        )));
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

/// Passes on what the actor says, until it breaks a rule, falls silent, or goes away.
async fn listen(
    id: u64,
    terms: &Terms,
    requests: &mut Streaming<wire::FromActor>,
    events: &mpsc::Sender<Event>,
) -> Status {
    loop {
        let message = match timeout(limits::SILENCE_LIMIT, next(terms, requests)).await {
            Ok(Ok(message)) => message,
            Ok(Err(status)) => return status,
            Err(_) => {
                return Status::deadline_exceeded(format!("silent for {} s", limits::SILENCE_LIMIT.as_secs()));
            }
        };
        let batch = match message {
            ActorMessage::Episodes(batch) => batch,
            ActorMessage::Heartbeat => continue,
            ActorMessage::Hello(_) | ActorMessage::Ready(_) => {
                return Status::invalid_argument("a second handshake in one session");
            }
        };
        metrics::received(batch.episodes.iter().map(popgym_proto::Episode::wire_bytes).sum());
        if events.send(Event::Episodes { session: id, batch }).await.is_err() {
            return Status::unavailable("the learner is ending");
        }
    }
}

/// Sends what the coordinator orders, and heartbeats while there is nothing to say.
async fn speak(mut orders: mpsc::Receiver<Order>, replies: &Replies) -> Status {
    let mut heartbeat = interval(limits::HEARTBEAT_INTERVAL);
    heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        let order = tokio::select! {
            order = orders.recv() => order,
            _ = heartbeat.tick() => {
                if let Err(status) = send(replies, LearnerMessage::Heartbeat).await {
                    return status;
                }
                continue;
            }
        };
        let message = match order {
            Some(Order::Open(epoch)) => {
                metrics::sent(epoch.weights.as_ref().map_or(0, |weights| weights.bytes.len()));
                LearnerMessage::Epoch(epoch)
            }
            Some(Order::Lease(leases)) => LearnerMessage::Leases(leases),
            Some(Order::Close { epoch }) => LearnerMessage::Closed { epoch },
            Some(Order::Stop { reason }) => LearnerMessage::Stop { reason },
            Some(Order::End(status)) => return status,
            // Only a coordinator that drops a session for leaving its orders unread lets go without a word.
            None => return Status::resource_exhausted("too slow: its messages were not read"),
        };
        if let Err(status) = send(replies, message).await {
            return status;
        }
    }
}

async fn send(replies: &Replies, message: LearnerMessage) -> Result<(), Status> {
    replies.send(Ok(message.into_wire())).await.map_err(|_| Status::cancelled("the connection is gone"))
}

/// The actor's next message, checked.
async fn next(terms: &Terms, requests: &mut Streaming<wire::FromActor>) -> Result<ActorMessage, Status> {
    let message = match requests.message().await {
        Ok(Some(message)) => message,
        Ok(None) => return Err(Status::cancelled("closed its connection")),
        Err(status) => return Err(Status::new(status.code(), describe(&status))),
    };
    ActorMessage::from_wire(message, &terms.episodes).map_err(|error| {
        metrics::refused(error.reason(), 1);
        Status::invalid_argument(format!("an illegal message: {error}"))
    })
}

fn describe(status: &Status) -> String {
    let mut cause: &dyn std::error::Error = status;
    while let Some(next) = cause.source() {
        cause = next;
    }
    if status.message().is_empty() { cause.to_string() } else { status.message().to_owned() }
}
