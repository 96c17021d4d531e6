//! One connection to the learner: hello, welcome, ready; then epochs and leases in, episodes out.

use std::hash::{BuildHasher as _, RandomState};

use popgym_proto::{ActorMessage, Hello, LearnerMessage, PROTOCOL_VERSION, RunSpec, limits, monitor, transport, wire};
use tokio::sync::{mpsc, oneshot};
use tokio::time::{MissedTickBehavior, interval, timeout};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Request, Status, Streaming};

use crate::args::Args;
use crate::door::{Door, innermost};
use crate::worker::{Command, Output, Worker};

/// How a session ended.
#[derive(Debug)]
pub enum End {
    /// The learner said that the run is complete.
    Complete(String),
    /// There is no use in trying again: refused, or unable to do this run's work.
    Failed(String),
    /// The learner is not there, or not any more.
    Lost {
        /// What happened, in one line.
        reason: String,
        /// Whether it had been there at all.
        welcomed: bool,
    },
}

/// Who this actor is, from connection to connection.
#[derive(Debug)]
pub struct Identity {
    actor: String,
    run: Option<String>,
    slots: u32,
    key: u64,
    incarnation: u64,
}

impl Identity {
    /// The name given, or host name and process id.
    pub fn new(args: &Args) -> Self {
        let actor = args.name.clone().unwrap_or_else(|| {
            let system = rustix::system::uname();
            let host: String = system.nodename().to_string_lossy().split_whitespace().collect();
            let host: String = host.chars().filter(|c| !c.is_control()).take(100).collect();
            format!("{host}-{}", std::process::id())
        });
        // SipHash under keys that the system drew.
        let key = RandomState::new().hash_one("key");
        Self { actor, run: args.run.clone(), slots: args.slots, key, incarnation: 0 }
    }

    /// The hello of the next connection.
    pub fn hello(&mut self) -> Hello {
        self.incarnation += 1;
        Hello {
            protocol_version: PROTOCOL_VERSION,
            build: env!("CARGO_PKG_VERSION").to_owned(),
            actor: self.actor.clone(),
            key: self.key,
            incarnation: self.incarnation,
            slots: self.slots,
            run: self.run.clone(),
        }
    }
}

/// One session, from connecting to its end. `known`: this learner has taken this actor's credentials before, so that files
/// which are no good now are being replaced.
pub async fn run(args: &Args, hello: Hello, worker: &Worker, known: bool) -> End {
    let expected_run = hello.run.clone();
    let (to_learner, requests) = mpsc::channel(limits::STREAM_QUEUE);
    let door = match Door::new(args) {
        Ok(door) => door,
        Err(reason) if known => return End::Lost { reason, welcomed: false },
        Err(problem) => return End::Failed(problem),
    };
    let mut replies = match connect(door, hello, &to_learner, requests).await {
        Ok(replies) => replies,
        Err(status) if known && status.code() == Code::Unauthenticated => {
            return End::Lost { reason: status.message().to_owned(), welcomed: false };
        }
        Err(status) => return ended(&status, false),
    };
    let spec = match welcome(&mut replies, expected_run.as_deref()).await {
        Ok(spec) => spec,
        Err(end) => return end,
    };
    let (outputs, from_worker) = mpsc::channel(limits::STREAM_QUEUE);
    let end = tokio::select! {
        end = listen(&mut replies, spec, outputs, &to_learner, worker) => end,
        end = speak(from_worker, &to_learner, worker) => end,
    };
    monitor::set_ready(false);
    // `from_worker` is gone, so a worker that waits for room in it is free by now.
    if !worker.send(Command::Disconnected).await {
        return worker_died();
    }
    end
}

/// Connects and says hello.
async fn connect(
    door: Door,
    hello: Hello,
    to_learner: &mpsc::Sender<wire::FromActor>,
    requests: mpsc::Receiver<wire::FromActor>,
) -> Result<Streaming<wire::FromLearner>, Status> {
    let channel = door.endpoint.connect().await.map_err(|error| Status::unavailable(innermost(&error)))?;
    // The queue is empty and holds at least one.
    to_learner.try_send(ActorMessage::Hello(hello).into_wire()).map_err(|error| Status::internal(error.to_string()))?;
    let mut client = transport::client(channel);
    let mut request = Request::new(ReceiverStream::new(requests));
    if let Some(token) = door.token {
        token.put(request.metadata_mut());
    }
    let answer = timeout(limits::HELLO_DEADLINE, client.session(request)).await;
    Ok(answer.map_err(|_| Status::unavailable("no answer"))??.into_inner())
}

/// Waits for the learner's welcome.
async fn welcome(replies: &mut Streaming<wire::FromLearner>, run: Option<&str>) -> Result<RunSpec, End> {
    match timeout(limits::HELLO_DEADLINE, next(replies, false)).await {
        Ok(Ok(LearnerMessage::Welcome(spec))) if run.is_none_or(|run| run == spec.run) => Ok(spec),
        Ok(Ok(LearnerMessage::Welcome(spec))) => {
            Err(End::Failed(format!("this actor is for the run {}, the learner's is {}", run.unwrap_or(""), spec.run)))
        }
        Ok(Ok(LearnerMessage::Stop { reason })) => Err(End::Complete(reason)),
        Ok(Ok(_)) => Err(End::Failed("the learner did not begin with a welcome".to_owned())),
        Ok(Err(end)) => Err(end),
        Err(_) => Err(End::Lost { reason: "no welcome".to_owned(), welcomed: false }),
    }
}

/// Gets ready, then passes on what the learner says, until it stops, falls silent, or goes away.
async fn listen(
    replies: &mut Streaming<wire::FromLearner>,
    spec: RunSpec,
    outputs: mpsc::Sender<Output>,
    to_learner: &mpsc::Sender<wire::FromActor>,
    worker: &Worker,
) -> End {
    let (reply, ready) = oneshot::channel();
    if !worker.send(Command::Prepare { spec: Box::new(spec), outputs, reply }).await {
        return worker_died();
    }
    match ready.await {
        Ok(Ok(fingerprint)) => {
            // If this fails the stream has ended, and the next read says why.
            let _ = to_learner.send(ActorMessage::Ready(fingerprint).into_wire()).await;
            monitor::set_ready(true);
        }
        Ok(Err(error)) => return End::Failed(format!("this actor cannot build the run's policy: {error:#}")),
        Err(_) => return worker_died(),
    }
    loop {
        let message = match timeout(limits::MESSAGE_DEADLINE, next(replies, true)).await {
            Ok(Ok(message)) => message,
            Ok(Err(end)) => return end,
            Err(_) => {
                let reason = format!("the learner was silent for {} s", limits::MESSAGE_DEADLINE.as_secs());
                return End::Lost { reason, welcomed: true };
            }
        };
        let command = match message {
            LearnerMessage::Epoch(epoch) => Command::Open(epoch),
            LearnerMessage::Leases(leases) => Command::Lease(leases),
            LearnerMessage::Closed { epoch } => Command::Close { epoch },
            LearnerMessage::Stop { reason } => return End::Complete(reason),
            LearnerMessage::Heartbeat => continue,
            LearnerMessage::Welcome(_) => return End::Failed("the learner said welcome twice".to_owned()),
        };
        if !worker.send(command).await {
            return worker_died();
        }
    }
}

/// Sends what the worker has to say, and heartbeats while it has nothing.
async fn speak(
    mut from_worker: mpsc::Receiver<Output>,
    to_learner: &mpsc::Sender<wire::FromActor>,
    worker: &Worker,
) -> End {
    let mut heartbeat = interval(limits::HEARTBEAT_INTERVAL);
    heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        let message = tokio::select! {
            output = from_worker.recv() => match output {
                Some(Output::Message(message)) => message,
                Some(Output::Failed(reason)) => return End::Failed(reason),
                // The worker lets go of a session where it cannot do its work, which `listen` reports; or it has died.
                None => {
                    worker.died().await;
                    return worker_died();
                }
            },
            _ = heartbeat.tick() => ActorMessage::Heartbeat.into_wire(),
        };
        if to_learner.send(message).await.is_err() {
            // The stream has ended; `listen` has the learner's own word for it, and needs a worker that does not wait for us.
            drop(from_worker);
            return std::future::pending().await;
        }
    }
}

/// The learner's next message, or how the session ended.
async fn next(replies: &mut Streaming<wire::FromLearner>, welcomed: bool) -> Result<LearnerMessage, End> {
    match replies.message().await {
        Ok(Some(message)) => LearnerMessage::from_wire(message)
            .map_err(|error| End::Failed(format!("the learner sent a message that is not legal: {error}"))),
        Ok(None) => Err(End::Lost { reason: "the learner closed the connection".to_owned(), welcomed }),
        Err(status) => Err(ended(&status, welcomed)),
    }
}

/// What a status means: refusals are final, all else may pass.
fn ended(status: &Status, welcomed: bool) -> End {
    match status.code() {
        Code::InvalidArgument | Code::FailedPrecondition | Code::Unauthenticated => {
            End::Failed(format!("refused by the learner: {}", status.message()))
        }
        Code::Unimplemented => End::Failed("whoever listens there is not a learner of popgym-rs".to_owned()),
        Code::OutOfRange => End::Failed(format!("a message is too large: {}", status.message())),
        _ => {
            let reason = match status.message() {
                "" | "transport error" => innermost(status),
                message => message.to_owned(),
            };
            End::Lost { reason, welcomed }
        }
    }
}

fn worker_died() -> End {
    End::Failed("the rollout thread has died".to_owned())
}
