//! The service against simulated actors over real sockets.

use std::io::{ErrorKind, Read as _, Write as _};
use std::sync::Mutex;
use std::time::Instant;

use popgym_envs::space::Space;
use popgym_proto::{ActorMessage, Columns, EpisodeBatch, Hello, LearnerMessage, OpenEpoch, PROTOCOL_VERSION};
use prost::Message as _;
use tokio::runtime::Runtime;

use super::*;

const FINGERPRINT: Fingerprint = [3; 32];
/// Safetensors without a tensor.
const WEIGHTS: Bytes = Bytes::from_static(b"\x02\0\0\0\0\0\0\0{}");
const MAX_STEPS: u32 = 40;

fn service() -> Service {
    let spec = RunSpec {
        run: "test".to_owned(),
        env: "env".to_owned(),
        observability: popgym_envs::Observability::Partial,
        max_episode_steps: MAX_STEPS,
        memory: "gru".to_owned(),
        memory_options: toml::Table::new(),
        policy_options: toml::Table::new(),
        seed: 0,
        lag: 0,
        rows: 16,
        evaluation: false,
        greedy: false,
    };
    let episodes =
        EpisodeSpec { observation: Space::Discrete(256), action: Space::MultiDiscrete(vec![4]), max_steps: MAX_STEPS };
    let entrance = Entrance { listener: TcpListener::bind("127.0.0.1:0").unwrap(), tls: None };
    Service::start(vec![entrance], None, None, spec, episodes, FINGERPRINT).unwrap()
}

/// Two epochs whose episodes all have the same length: 1 step, then 40.
const SHORT: u64 = 1000;
const LONG: u64 = 1001;

/// Episode `index` of `epoch`, whoever samples it: of 1 to 40 steps.
fn episode(epoch: u64, index: u64) -> Episode {
    let number = (epoch << 32 | index).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 17;
    let steps = match epoch {
        SHORT => 1,
        LONG => MAX_STEPS as usize,
        _ => 1 + number as usize % MAX_STEPS as usize,
    };
    let discrete = |rows: usize, classes: u64| Columns {
        discrete: (0..rows as u64).map(|t| ((number + t) % classes) as u8).collect(),
        real: Vec::new(),
    };
    Episode {
        index,
        steps,
        observations: discrete(steps + 1, 256),
        actions: discrete(steps, 4),
        rewards: (0..steps).map(|t| t as f64).collect(),
        log_probs: vec![-1.0; steps],
        terminated: true,
        truncated: false,
    }
}

/// What a simulated actor does with its leases.
#[derive(Clone, Copy, PartialEq)]
enum Conduct {
    Honest,
    /// Goes away as soon as it holds leases.
    Vanishes,
    /// Sends an episode with a class out of range.
    SendsGarbage,
    /// Sends everything twice.
    SendsTwice,
    /// Sends the first episode of every message of leases twice, and not the second.
    Doubles,
    /// Sends the first five episodes of every message of leases, and the others when the epoch is closed.
    SendsFive,
    /// Sends heartbeats and nothing else, as fast as it can.
    Beats,
    /// Takes leases, and sends nothing.
    Sits,
}

/// What a simulated actor saw.
#[derive(Debug, Default)]
struct Seen {
    epochs: Vec<OpenEpoch>,
    leases: Vec<u64>,
    closed: Vec<u64>,
}

struct Actors {
    runtime: Runtime,
    address: SocketAddr,
}

impl Actors {
    fn of(service: &Service) -> Self {
        Self { runtime: Runtime::new().unwrap(), address: service.addr() }
    }

    fn spawn(&self, name: &str, conduct: Conduct) -> Handle {
        let seen = Arc::new(Mutex::new(Seen::default()));
        let actor = simulate(self.address, hello(name), FINGERPRINT, conduct, seen.clone());
        Handle { seen, end: self.runtime.spawn(actor) }
    }

    fn end(&self, actor: Handle) -> Result<String, Status> {
        let end = self.runtime.block_on(async { tokio::time::timeout(Duration::from_secs(20), actor.end).await });
        end.expect("the actor ends in time").unwrap()
    }
}

struct Handle {
    seen: Arc<Mutex<Seen>>,
    end: tokio::task::JoinHandle<Result<String, Status>>,
}

fn hello(name: &str) -> Hello {
    Hello {
        protocol_version: PROTOCOL_VERSION,
        build: "test".to_owned(),
        actor: name.to_owned(),
        key: 1,
        incarnation: 1,
        slots: 8,
        run: None,
    }
}

/// One session, until the learner says stop (its reason) or ends it (the status).
async fn simulate(
    address: SocketAddr,
    hello: Hello,
    fingerprint: Fingerprint,
    conduct: Conduct,
    seen: Arc<Mutex<Seen>>,
) -> Result<String, Status> {
    let channel = transport::endpoint(&format!("http://{address}")).unwrap().connect().await.unwrap();
    let (requests, stream) = mpsc::channel(16);
    requests.send(ActorMessage::Hello(hello).into_wire()).await.unwrap();
    let mut replies = transport::client(channel).session(ReceiverStream::new(stream)).await?.into_inner();
    let send = async |message: ActorMessage| drop(requests.send(message.into_wire()).await);
    let (mut version, mut late) = (0, Vec::new());
    while let Some(message) = replies.message().await? {
        match LearnerMessage::from_wire(message).unwrap() {
            LearnerMessage::Welcome(_) => send(ActorMessage::Ready(fingerprint)).await,
            LearnerMessage::Epoch(epoch) => {
                version = epoch.version;
                seen.lock().unwrap().epochs.push(epoch);
            }
            LearnerMessage::Leases(leases) => {
                seen.lock().unwrap().leases.extend(&leases.episodes);
                let epoch = leases.epoch;
                let episodes: Vec<Episode> = leases.episodes.iter().map(|&index| self::episode(epoch, index)).collect();
                let mut batch = EpisodeBatch { epoch, version, episodes };
                match conduct {
                    Conduct::Sits => {}
                    Conduct::Vanishes => return Ok("vanished".to_owned()),
                    Conduct::Honest => send(ActorMessage::Episodes(batch)).await,
                    Conduct::SendsFive => {
                        late.extend(batch.episodes.split_off(batch.episodes.len().min(5)));
                        send(ActorMessage::Episodes(batch)).await;
                    }
                    Conduct::SendsTwice => {
                        send(ActorMessage::Episodes(batch.clone())).await;
                        send(ActorMessage::Episodes(batch)).await;
                    }
                    Conduct::Doubles => {
                        if batch.episodes.len() > 1 {
                            batch.episodes[1] = batch.episodes[0].clone();
                        }
                        send(ActorMessage::Episodes(batch)).await;
                    }
                    Conduct::Beats => while requests.send(ActorMessage::Heartbeat.into_wire()).await.is_ok() {},
                    Conduct::SendsGarbage => {
                        let mut wire = ActorMessage::Episodes(batch).into_wire();
                        if let Some(wire::from_actor::Message::Episodes(batch)) = &mut wire.message {
                            let mut episode = wire::Episode::decode(&batch.episodes[0][..]).unwrap();
                            episode.actions_discrete = vec![77; episode.actions_discrete.len()].into();
                            batch.episodes[0] = episode.encode_to_vec().into();
                        }
                        drop(requests.send(wire).await);
                    }
                }
            }
            LearnerMessage::Closed { epoch } => {
                let episodes = std::mem::take(&mut late);
                if !episodes.is_empty() {
                    send(ActorMessage::Episodes(EpisodeBatch { epoch, version, episodes })).await;
                }
                seen.lock().unwrap().closed.push(epoch);
            }
            LearnerMessage::Stop { reason } => return Ok(reason),
            LearnerMessage::Heartbeat => {}
        }
    }
    Err(Status::cancelled("the stream ended"))
}

fn wait_for(what: &str, done: impl Fn() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(20);
    while !done() {
        assert!(Instant::now() < deadline, "{what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn collect(service: &Service) -> Collected {
    let deadline = Instant::now() + Duration::from_secs(30);
    service.collect(|| Instant::now() > deadline).expect("a batch in time")
}

/// The batch by definition: episodes 0, 1, ... until the target is reached.
fn expected(epoch: u64, target: Target) -> Vec<Episode> {
    let (mut batch, mut steps) = (Vec::new(), 0);
    while !target.reached(batch.len() as u64, steps) {
        batch.push(episode(epoch, batch.len() as u64));
        steps += batch.last().unwrap().steps as u64;
    }
    batch
}

#[test]
fn sixty_four_actors_at_once_are_all_served() {
    let service = service();
    let actors = Actors::of(&service);
    let handles: Vec<Handle> = (0..64).map(|i| actors.spawn(&format!("actor-{i}"), Conduct::Honest)).collect();
    wait_for("64 actors", || service.actors() == 64);
    for epoch in 0..3 {
        service.open(epoch, epoch, WEIGHTS, Target::Steps(20_000)).unwrap();
        let collected = collect(&service);
        assert_eq!(collected.episodes, expected(epoch, Target::Steps(20_000)));
        assert_eq!(collected.steps, collected.episodes.iter().map(|episode| episode.steps as u64).sum::<u64>());
    }
    assert!(handles.iter().all(|actor| !actor.seen.lock().unwrap().leases.is_empty()));
    assert!(handles.iter().all(|actor| actor.seen.lock().unwrap().epochs.len() == 3));
    service.finish("done");
    for actor in handles {
        assert_eq!(actors.end(actor).unwrap(), "done");
    }
}

#[test]
fn the_batch_does_not_depend_on_the_number_of_actors() {
    for count in [1, 2, 7] {
        let service = service();
        let actors = Actors::of(&service);
        // Actors may come at any time.
        let target = Target::Steps(3_000);
        service.open(5, 4, WEIGHTS, target).unwrap();
        let handles: Vec<Handle> = (0..count).map(|i| actors.spawn(&format!("actor-{i}"), Conduct::Honest)).collect();
        let collected = collect(&service);
        assert_eq!((collected.epoch, collected.version), (5, 4));
        assert_eq!(collected.episodes, expected(5, target), "{count} actors");
        service.open(6, 4, WEIGHTS, Target::Episodes(33)).unwrap();
        assert_eq!(collect(&service).episodes, expected(6, Target::Episodes(33)));
        service.finish("done");
        drop(handles);
    }
}

#[test]
fn leases_of_an_actor_that_vanishes_are_leased_again() {
    let service = service();
    let actors = Actors::of(&service);
    let vanishing = actors.spawn("vanishing", Conduct::Vanishes);
    let staying = actors.spawn("staying", Conduct::Honest);
    wait_for("two actors", || service.actors() == 2);
    let target = Target::Steps(2_000);
    service.open(0, 0, WEIGHTS, target).unwrap();
    assert_eq!(collect(&service).episodes, expected(0, target));
    let held = std::mem::take(&mut vanishing.seen.lock().unwrap().leases);
    assert!(!held.is_empty());
    let seen = staying.seen.lock().unwrap();
    assert!(held.iter().all(|index| seen.leases.contains(index)), "{held:?} of {:?}", seen.leases);
}

#[test]
fn an_actor_is_refused_with_a_reason() {
    let service = service();
    let actors = Actors::of(&service);
    let refused = |hello: Hello, fingerprint| {
        let actor = simulate(actors.address, hello, fingerprint, Conduct::Honest, Arc::default());
        let status = actors.runtime.block_on(actor).unwrap_err();
        (status.code(), status.message().to_owned())
    };
    let (code, reason) = refused(Hello { protocol_version: 99, ..hello("a") }, FINGERPRINT);
    assert_eq!(code, tonic::Code::FailedPrecondition);
    assert!(reason.contains("protocol version 99"), "{reason}");
    let (code, reason) = refused(Hello { run: Some("other".to_owned()), ..hello("a") }, FINGERPRINT);
    assert_eq!(code, tonic::Code::FailedPrecondition);
    assert_eq!(reason, "the actor is for the run other, this learner's run is test");
    let (code, reason) = refused(hello("a"), [4; 32]);
    assert_eq!(code, tonic::Code::FailedPrecondition);
    assert!(reason.contains("another environment or policy"), "{reason}");
    let (code, reason) = refused(Hello { slots: 0, ..hello("a") }, FINGERPRINT);
    assert_eq!(
        (code, reason.as_str()),
        (tonic::Code::InvalidArgument, "an illegal message: slots is 0, allowed is 1..=4096")
    );
    assert_eq!(service.actors(), 0);
}

#[test]
fn an_illegal_episode_ends_its_session_and_nothing_else() {
    let service = service();
    let actors = Actors::of(&service);
    let garbage = actors.spawn("garbage", Conduct::SendsGarbage);
    let _honest = actors.spawn("honest", Conduct::Honest);
    wait_for("two actors", || service.actors() == 2);
    let target = Target::Steps(1_000);
    service.open(0, 0, WEIGHTS, target).unwrap();
    assert_eq!(collect(&service).episodes, expected(0, target));
    let status = actors.end(garbage).unwrap_err();
    assert_eq!(status.code(), tonic::Code::InvalidArgument);
    assert_eq!(status.message(), "an illegal message: actions_discrete[0] is 77, allowed is 0..4");
}

#[test]
fn what_nobody_asked_for_ends_its_session_and_changes_nothing() {
    let target = Target::Steps(1_500);
    for (conduct, told) in
        [(Conduct::SendsTwice, "episodes in a session that was leased"), (Conduct::Beats, "too many heartbeats")]
    {
        let service = service();
        let actors = Actors::of(&service);
        let busy = actors.spawn("busy", conduct);
        wait_for("an actor", || service.actors() == 1);
        service.open(0, 0, WEIGHTS, target).unwrap();
        let status = actors.end(busy).unwrap_err();
        assert!(status.message().contains(told), "{status}");
        let _honest = actors.spawn("honest", Conduct::Honest);
        assert_eq!(collect(&service).episodes, expected(0, target));
    }
}

#[test]
fn an_episode_that_comes_twice_counts_once() {
    let service = service();
    let actors = Actors::of(&service);
    let doubling = actors.spawn("doubling", Conduct::Doubles);
    wait_for("an actor", || service.actors() == 1);
    let target = Target::Steps(3_000);
    service.open(0, 0, WEIGHTS, target).unwrap();
    // It still holds what it did not send: its session goes on, until that is taken from it.
    wait_for("leases", || !doubling.seen.lock().unwrap().leases.is_empty());
    let _honest = actors.spawn("honest", Conduct::Honest);
    wait_for("two actors", || service.actors() == 2);
    doubling.end.abort();
    assert_eq!(collect(&service).episodes, expected(0, target));
}

#[test]
fn weights_are_sent_once_a_version_and_to_newcomers() {
    let service = service();
    let actors = Actors::of(&service);
    let first = actors.spawn("first", Conduct::Honest);
    for (epoch, version) in [(0, 0), (1, 0), (2, 1)] {
        service.open(epoch, version, WEIGHTS, Target::Episodes(5)).unwrap();
        collect(&service);
    }
    let sent: Vec<bool> = first.seen.lock().unwrap().epochs.iter().map(|epoch| epoch.weights.is_some()).collect();
    assert_eq!(sent, [true, false, true]);
    service.open(3, 1, WEIGHTS, Target::Steps(1_000_000)).unwrap();
    let newcomer = actors.spawn("newcomer", Conduct::Sits);
    wait_for("the newcomer's epoch", || !newcomer.seen.lock().unwrap().epochs.is_empty());
    let seen = newcomer.seen.lock().unwrap();
    assert_eq!((seen.epochs[0].epoch, seen.epochs[0].version), (3, 1));
    assert!(seen.epochs[0].weights.is_some());
}

#[test]
fn an_actor_that_connects_anew_replaces_its_older_self() {
    let service = service();
    let actors = Actors::of(&service);
    let older = actors.spawn("one", Conduct::Sits);
    service.open(0, 0, WEIGHTS, Target::Episodes(10)).unwrap();
    wait_for("leases", || !older.seen.lock().unwrap().leases.is_empty());
    let seen = Arc::default();
    let newer = Hello { incarnation: 2, ..hello("one") };
    actors.runtime.spawn(simulate(actors.address, newer, FINGERPRINT, Conduct::Honest, seen));
    assert_eq!(collect(&service).episodes, expected(0, Target::Episodes(10)));
    assert_eq!(actors.end(older).unwrap_err().code(), tonic::Code::FailedPrecondition);
    // And an older one does not replace a newer.
    let stale = simulate(actors.address, hello("one"), FINGERPRINT, Conduct::Honest, Arc::default());
    let status = actors.runtime.block_on(stale).unwrap_err();
    assert_eq!(status.message(), "this actor has connected anew since");
    assert_eq!(service.actors(), 1);
    // Who has its name and not its key is another.
    for incarnation in [0, u64::MAX] {
        let thief = Hello { key: 2 + incarnation % 2, incarnation, ..hello("one") };
        actors.runtime.spawn(simulate(actors.address, thief, FINGERPRINT, Conduct::Honest, Arc::default()));
    }
    wait_for("three actors", || service.actors() == 3);
    service.open(1, 1, WEIGHTS, Target::Steps(1_000)).unwrap();
    assert_eq!(collect(&service).episodes, expected(1, Target::Steps(1_000)));
    assert_eq!(service.actors(), 3);
}

#[test]
fn what_is_under_way_is_called_off_when_the_batch_is_complete() {
    let service = service();
    let actors = Actors::of(&service);
    let actor = actors.spawn("actor", Conduct::SendsFive);
    // After an epoch of short episodes, far too many of the long ones are leased.
    service.open(SHORT, 0, WEIGHTS, Target::Episodes(5)).unwrap();
    assert_eq!(collect(&service).steps, 5);
    service.open(LONG, 0, WEIGHTS, Target::Steps(5 * u64::from(MAX_STEPS))).unwrap();
    assert_eq!(collect(&service).episodes, expected(LONG, Target::Episodes(5)));
    wait_for("the call", || actor.seen.lock().unwrap().closed == [LONG]);
    assert!(actor.seen.lock().unwrap().leases.len() > 10);
    // What comes late answers a lease too: no reason to part.
    service.open(0, 0, WEIGHTS, Target::Episodes(5)).unwrap();
    assert_eq!(collect(&service).episodes, expected(0, Target::Episodes(5)));
    assert_eq!(service.actors(), 1);
}

#[test]
fn the_end_does_not_wait_for_a_batch() {
    let service = service();
    let actors = Actors::of(&service);
    let sitting = actors.spawn("sitting", Conduct::Sits);
    service.open(0, 0, WEIGHTS, Target::Episodes(4)).unwrap();
    wait_for("leases", || sitting.seen.lock().unwrap().leases.len() == 4);
    assert!(service.collect(|| true).is_none(), "interrupted");
    service.finish("enough");
    assert_eq!(actors.end(sitting).unwrap(), "enough");
}

#[test]
fn strangers_have_little_room_and_little_time() {
    /// How HTTP/2 begins, and nothing after it.
    const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0";
    let service = service();
    let actors = Actors::of(&service);
    let _working = actors.spawn("working", Conduct::Honest);
    wait_for("an actor", || service.actors() == 1);
    let connect = |i| {
        let mut stranger = std::net::TcpStream::connect(actors.address).unwrap();
        if i % 2 == 0 {
            stranger.write_all(PREFACE).unwrap();
        }
        stranger.set_nonblocking(true).unwrap();
        stranger
    };
    let strangers: Vec<_> = (0..limits::MAX_STRANGERS + 20).map(connect).collect();
    let is_gone = |mut stranger: &std::net::TcpStream| match stranger.read(&mut [0; 1024]) {
        Ok(read) => read == 0,
        Err(error) => error.kind() != ErrorKind::WouldBlock,
    };
    let gone = || strangers.iter().filter(|stranger| is_gone(stranger)).count();
    wait_for("those beyond the limit", || gone() == 20);
    // They are in nobody's way: neither who works already, nor, when their time is up, who comes anew.
    service.open(0, 0, WEIGHTS, Target::Steps(1_000)).unwrap();
    assert_eq!(collect(&service).episodes, expected(0, Target::Steps(1_000)));
    wait_for("the end of the others", || gone() == strangers.len());
    let _late = actors.spawn("late", Conduct::Honest);
    wait_for("another actor", || service.actors() == 2);
}
