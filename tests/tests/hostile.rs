//! Clients that lie, beside an actor that works: each is told why it has to go, each is counted, and `metrics.csv` is that of
//! the undisturbed run, byte for byte.

use std::net::Ipv4Addr;

use popgym_proto::{ActorMessage, Hello, LearnerMessage, limits, wire};
use popgym_tests::attacked::{Attacked, RUN, WINDOW, undisturbed};
use popgym_tests::hostile::{Connection, framed, hello};
use prost::Message as _;
use tonic::Code;

/// An episode of one step, in order.
fn episode(index: u64) -> wire::Episode {
    wire::Episode {
        index,
        steps: 1,
        observations_real: vec![0; 2 * 2 * 4].into(),
        actions_discrete: vec![1].into(),
        rewards: 0.005_f64.to_le_bytes().to_vec().into(),
        log_probs: (-0.7_f32).to_le_bytes().to_vec().into(),
        terminated: true,
        ..wire::Episode::default()
    }
}

fn batch(epoch: u64, version: u64, episodes: Vec<wire::Episode>) -> wire::FromActor {
    let episodes = episodes.into_iter().map(|episode| episode.encode_to_vec().into()).collect();
    wire::FromActor { message: Some(wire::from_actor::Message::Episodes(wire::Episodes { epoch, version, episodes })) }
}

/// A message with one episode that is not in order.
fn wrong(change: impl Fn(&mut wire::Episode)) -> Vec<u8> {
    let mut episode = episode(0);
    change(&mut episode);
    framed(&batch(0, 0, vec![episode]).encode_to_vec())
}

fn says(message: ActorMessage) -> Vec<u8> {
    framed(&message.into_wire().encode_to_vec())
}

/// A hello that is not in order.
fn greets(change: impl Fn(&mut wire::Hello)) -> Vec<u8> {
    let mut hello = hello("liar", 16).into_wire();
    change(&mut hello);
    framed(&wire::FromActor { message: Some(wire::from_actor::Message::Hello(hello)) }.encode_to_vec())
}

/// What is sent, the status that it ends with, and the counters that it raises.
struct Lie {
    sent: Vec<u8>,
    code: Code,
    told: &'static str,
    counted: [&'static str; 2],
}

const ILLEGAL: &str = "sessions_refused_total{reason=\"illegal\"}";
const HANDSHAKE: &str = "sessions_refused_total{reason=\"handshake\"}";
const VALUE: &str = "episodes_refused_total{reason=\"value\"}";
const LENGTH: &str = "episodes_refused_total{reason=\"length\"}";
const ELEMENT: &str = "episodes_refused_total{reason=\"element\"}";
const ENCODING: &str = "episodes_refused_total{reason=\"encoding\"}";
const MISSING: &str = "episodes_refused_total{reason=\"missing\"}";

fn lie(sent: Vec<u8>, told: &'static str, counted: &'static str) -> Lie {
    Lie { sent, code: Code::InvalidArgument, told, counted: [ILLEGAL, counted] }
}

/// Of one who has not said hello.
fn lies_of_strangers() -> Vec<Lie> {
    let refused = |sent, code, told| Lie { sent, code, told, counted: [HANDSHAKE, HANDSHAKE] };
    let first = "the first message must be a hello";
    let garbled = "\u{1b}[2J\u{202e}\r\nERROR the run is lost";
    vec![
        refused(says(ActorMessage::Heartbeat), Code::InvalidArgument, first),
        refused(says(ActorMessage::Ready([0; 32])), Code::InvalidArgument, first),
        refused(wrong(|_| ()), Code::InvalidArgument, first),
        refused(greets(|hello| hello.protocol_version = 99), Code::FailedPrecondition, "speaks protocol version 99"),
        refused(greets(|hello| hello.run = "other".into()), Code::FailedPrecondition, "for the run other"),
        lie(greets(|hello| hello.actor = garbled.into()), "actor is `\\u{1b}[2J\\u{202e}\\r\\nERROR", VALUE),
        lie(greets(|hello| hello.run = garbled.into()), "run is `\\u{1b}", VALUE),
        lie(greets(|hello| hello.build = "\u{9b}31m".into()), "build is `\\u{9b}31m`", VALUE),
        lie(greets(|hello| hello.actor = "x".repeat(30_000)), "actor has length 30000", LENGTH),
        lie(greets(|hello| hello.actor = String::new()), "actor has length 0", LENGTH),
        lie(greets(|hello| hello.slots = 0), "slots is 0", VALUE),
        lie(greets(|hello| hello.slots = u32::MAX), "slots is 4294967295", VALUE),
        // A name that is not UTF-8; a field that goes on for 4 GiB; an empty message, and none.
        lie(framed(&[0x0a, 0x03, 0x1a, 0x01, 0xff]), "UTF-8", ENCODING),
        lie(framed(&[0x0a, 0xff, 0xff, 0xff, 0xff, 0x0f]), "an illegal message", ENCODING),
        lie(framed(&[0xff; 1000]), "an illegal message", ENCODING),
        lie(framed(&[]), "message is missing", MISSING),
        Lie { code: Code::OutOfRange, ..lie(vec![0, 0xff, 0xff, 0xff, 0xff], "found 4294967295 bytes", ENCODING) },
        lie(vec![1, 0, 0, 0, 0], "compressed-flag", ENCODING),
        lie(vec![0xff; 64], "invalid compression flag: 255", ENCODING),
    ]
}

/// Of one who is ready.
fn lies_of_actors() -> Vec<Lie> {
    let reals = |value: f32, count| -> Vec<u8> { (0..count).flat_map(|_| value.to_le_bytes()).collect() };
    let reward = |value: f64| wrong(|e| e.rewards = value.to_le_bytes().to_vec().into());
    let log_prob = |value: f32| wrong(|e| e.log_probs = value.to_le_bytes().to_vec().into());
    let seen = |value: f32, count| wrong(|e| e.observations_real = reals(value, count).into());
    let second = |sent| Lie { counted: [ILLEGAL, ILLEGAL], ..lie(sent, "a second handshake", ILLEGAL) };
    let most = batch(0, 0, (0..=limits::MAX_EPISODES as u64).map(episode).collect());
    let torn = wire::Episodes { epoch: 0, version: 0, episodes: vec![vec![0x1a, 0x7f].into()] };
    let torn = wire::FromActor { message: Some(wire::from_actor::Message::Episodes(torn)) };
    let beyond = (limits::EPISODES_MESSAGE_BYTES + (1 << 20)) as u32;
    vec![
        lie(seen(f32::NAN, 4), "observations_real[0] is NaN", ELEMENT),
        lie(seen(f32::INFINITY, 4), "observations_real[0] is inf", ELEMENT),
        lie(seen(0.0, 3), "observations_real has length 12", LENGTH),
        lie(seen(0.0, 400_000), "observations_real has length 1600000", LENGTH),
        lie(wrong(|e| e.observations_discrete = vec![0; 2].into()), "observations_discrete has length 2", LENGTH),
        lie(wrong(|e| e.actions_discrete = vec![2].into()), "actions_discrete[0] is 2, allowed is 0..2", ELEMENT),
        lie(wrong(|e| e.actions_discrete = vec![].into()), "actions_discrete has length 0", LENGTH),
        lie(wrong(|e| e.actions_real = reals(0.0, 1).into()), "actions_real has length 4", LENGTH),
        lie(reward(f64::NAN), "rewards[0] is NaN", ELEMENT),
        lie(reward(f64::NEG_INFINITY), "rewards[0] is -inf", ELEMENT),
        lie(wrong(|e| e.rewards = vec![0; 7].into()), "rewards has length 7", LENGTH),
        lie(log_prob(f32::NAN), "log_probs[0] is NaN", ELEMENT),
        lie(log_prob(f32::INFINITY), "log_probs[0] is inf", ELEMENT),
        lie(wrong(|e| e.log_probs = vec![].into()), "log_probs has length 0", LENGTH),
        lie(wrong(|e| e.steps = 0), "steps is 0", VALUE),
        lie(wrong(|e| e.steps = u32::MAX), "steps is 4294967295", VALUE),
        lie(wrong(|e| e.steps = 2), "observations_real has length 16", LENGTH),
        lie(wrong(|e| e.terminated = false), "end is neither", VALUE),
        lie(framed(&batch(0, 0, vec![]).encode_to_vec()), "episodes has length 0", LENGTH),
        lie(framed(&most.encode_to_vec()), "episodes has length 4097", LENGTH),
        lie(framed(&torn.encode_to_vec()), "episode is no message", ENCODING),
        Lie {
            code: Code::OutOfRange,
            ..lie([&[0], &beyond.to_be_bytes()[..]].concat(), "message length too large", ENCODING)
        },
        second(greets(|_| ())),
        second(says(ActorMessage::Ready([0; 32]))),
    ]
}

#[test]
fn every_lie_is_answered_counted_and_without_effect() {
    let run = Attacked::begin(&RUN);
    let idle = run.hold();
    let mut addresses = (1..=255).map(|i| Ipv4Addr::new(127, 0, 1, i));
    let mut told_of = Vec::new();
    for (ready, lies) in [(false, lies_of_strangers()), (true, lies_of_actors())] {
        for Lie { sent, code, told, counted } in lies {
            let from = addresses.next().expect("an address");
            let before = run.counters(counted);
            let status = run.runtime.block_on(async {
                let connection = Connection::open(run.address, from, WINDOW).await.expect("a connection");
                let mut session = connection.session().await.expect("a session");
                if ready {
                    session.join(hello("liar", 16), run.fingerprint).await.expect("a welcome");
                    // Before it is known to be ready, a large message would be too much from a stranger.
                    let mut told = LearnerMessage::Heartbeat;
                    while told == LearnerMessage::Heartbeat {
                        told = session.reader.next().await.expect("the open epoch");
                    }
                    assert!(matches!(told, LearnerMessage::Epoch(_)), "{told:?}");
                }
                // Fails where the learner has heard enough.
                let _ = session.send_raw(sent.into()).await;
                session.reader.end().await
            });
            assert_eq!(status.code(), code, "{told}: {status}");
            assert!(status.message().contains(told), "{told}: {status}");
            assert_eq!(run.counters(counted), before.map(|count| count + 1), "{told}: {counted:?}");
            told_of.push(format!("refused {from}: "));
        }
    }
    // The wrong fingerprint, of one who has said hello properly.
    let from = addresses.next().expect("an address");
    let status = run.runtime.block_on(async {
        let connection = Connection::open(run.address, from, WINDOW).await.expect("a connection");
        let mut session = connection.session().await.expect("a session");
        session.join(hello("liar", 16), [7; 32]).await.expect("a welcome");
        session.reader.end().await
    });
    assert_eq!(status.code(), Code::FailedPrecondition);
    assert!(status.message().contains("another environment or policy"), "{status}");
    drop(idle);
    let log = run.expect_undisturbed(undisturbed());
    for line in told_of {
        assert_eq!(log.matches(&line).count(), 1, "{line}\n{log}");
    }
}

/// Episodes in order that nobody asked this actor for: of another's lease, of another epoch or version, twice.
#[test]
fn episodes_without_a_lease_are_refused_and_soon_their_sender() {
    const MOST: u64 = limits::MAX_EPISODES as u64;
    let run = Attacked::begin(&RUN);
    let names =
        ["late", "version", "unleased", "excess"].map(|why| format!("episodes_refused_total{{reason=\"{why}\"}}"));
    let refused = || run.counters(names.each_ref().map(String::as_str));
    let mut lies = ["late", "early", "version", "unleased", "last", "twice"].into_iter().cycle();
    let (before, mut told, mut sessions) = (refused(), 0, 0);
    // A lease pays for an episode, so one session can tell as many lies as it has leases.
    while refused()[..3].contains(&0) || sessions < 4 {
        sessions += 1;
        let from = Ipv4Addr::new(127, 0, 1, sessions);
        run.runtime.block_on(async {
            let (_connection, mut session) = run.joined(from, hello("liar", 4096)).await;
            let (open, leases) = session.held(1).await.expect("leases");
            let (epoch, version, held) = (open.epoch, open.version, leases.episodes);
            let other = (0..=u64::MAX).find(|index| !held.contains(index)).expect("an index");
            let mut credit = held.len();
            loop {
                let (epoch, version, indices) = match lies.next().expect("no end") {
                    "late" => (epoch.wrapping_sub(1), version, vec![held[0]]),
                    "early" => (u64::MAX, version, vec![held[0]]),
                    "version" => (epoch, version + 1, vec![held[0]]),
                    "last" => (epoch, version, vec![u64::MAX]),
                    "twice" => (epoch, version, vec![other, other]),
                    _ => (epoch, version, vec![other]),
                };
                let Some(left) = credit.checked_sub(indices.len()) else { break };
                (credit, told) = (left, told + indices.len() as u64);
                let message = batch(epoch, version, indices.into_iter().map(episode).collect());
                session.send_wire(message).await.expect("a stream");
            }
            let excess = (u64::MAX - MOST..u64::MAX).map(episode).collect();
            session.send_wire(batch(epoch, version, excess)).await.expect("a stream");
            let status = session.reader.end().await;
            assert_eq!(status.code(), Code::InvalidArgument);
            assert!(status.message().contains("episodes in a session that was leased"), "{status}");
        });
    }
    let counted: Vec<u64> = std::iter::zip(refused(), before).map(|(after, before)| after - before).collect();
    // An honest actor is late as well, where an epoch is complete before its last lease; it is never in excess.
    assert!(counted[..3].iter().sum::<u64>() >= told, "{counted:?}, {told}");
    assert_eq!(counted[3], u64::from(sessions) * MOST);
    assert_eq!(run.counters(["sessions_refused_total{reason=\"excess\"}"]), [u64::from(sessions)]);
    run.expect_undisturbed(undisturbed());
}

#[test]
fn a_stolen_name_is_only_a_name() {
    let run = Attacked::begin(&RUN);
    let idle = run.hold();
    run.runtime.block_on(async {
        for (i, incarnation) in [0, 1, u64::MAX, u64::MAX].into_iter().enumerate() {
            let thief = Hello { incarnation, key: u64::MAX - i as u64, ..hello("honest", 16) };
            let (_connection, mut session) = run.joined(Ipv4Addr::new(127, 0, 1, 1), thief).await;
            session.reader.next().await.expect("a word to one who is ready");
        }
    });
    drop(idle);
    let log = run.expect_undisturbed(undisturbed());
    assert_eq!(log.matches("actor returned actor=\"honest#").count(), 4, "{log}");
    assert!(!log.lines().any(|line| line.contains("actor lost") && line.contains("actor=\"honest\"")), "{log}");
}
