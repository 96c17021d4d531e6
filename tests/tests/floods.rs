//! Clients that flood, dawdle and come again and again, beside an actor that works: they are cut off, and `metrics.csv` is that
//! of the undisturbed run, byte for byte.
//!
//! `POPGYM_SOAK=1` makes the crowd large and its run long. `--ignored` prints what the crowd costs.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant};

use http::{HeaderMap, HeaderName, HeaderValue};
use popgym_proto::{ActorMessage, Fingerprint, limits};
use popgym_tests::attacked::{Attacked, RUN, WINDOW, undisturbed};
use popgym_tests::hostile::{self, Connection, SESSION, connect, framed, hello};
use popgym_tests::{DEADLINE, Scene, until};
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tonic::Code;

const HEALTH: &str = "/grpc.health.v1.Health/Check";

fn refused(reason: &str) -> String {
    format!("connections_refused_total{{reason=\"{reason}\"}}")
}

/// Frames that HTTP/2 allows at any time, and that nobody needs.
fn idle_frames() -> [(&'static str, Vec<u8>); 5] {
    [
        ("pings", hostile::frame(6, 0, 0, &[7; 8])),
        ("settings", hostile::frame(4, 0, 0, &[])),
        ("windows", hostile::frame(8, 0, 0, &[0, 0, 0, 1])),
        ("priorities", hostile::frame(2, 0, 1, &[0, 0, 0, 0, 1])),
        ("unknown", hostile::frame(0xfa, 0, 0, &[0; 64])),
    ]
}

fn many_headers(count: usize) -> HeaderMap {
    let name = |i: usize| HeaderName::try_from(format!("x-{i}")).expect("a name");
    (0..count).map(|i| (name(i), HeaderValue::from_static("a value that is forty characters long...."))).collect()
}

#[test]
fn connections_to_no_purpose_are_cut() {
    let run = Attacked::begin(&RUN);
    let idle = run.hold();
    // Each from an address of its own, with limits of its own.
    let mut addresses = (1..).map(|i| Ipv4Addr::new(127, 0, 1, i));
    let mut from = || addresses.next().expect("an address");
    let [http2, flood] = ["http2", "flood"].map(refused);
    let others = [&b"GET / HTTP/1.1\r\nHost: learner\r\n\r\n"[..], &[0xff; 4096], b"\x16\x03\x01\x02\0\x01\0"];
    for (i, other) in others.into_iter().enumerate() {
        run.runtime.block_on(async {
            let stream = connect(run.address, from()).await.unwrap();
            stream.writable().await.unwrap();
            stream.try_write(other).unwrap();
            hostile::closed(&stream).await;
        });
        assert_eq!(run.counters([&http2]), [i as u64 + 1]);
    }
    for (i, (what, frame)) in idle_frames().into_iter().enumerate() {
        run.runtime.block_on(async { hostile::flood(&connect(run.address, from()).await.unwrap(), &frame).await });
        assert_eq!(run.counters([&flood]), [i as u64 + 1], "{what}");
    }
    // Streams that are opened and reset, one by one and a hundred at a time.
    for burst in [1, 100] {
        run.runtime.block_on(async {
            let connection = Connection::open(run.address, from(), WINDOW).await.unwrap();
            let reset = async {
                for i in 1.. {
                    let Ok(mut session) = connection.session().await else { return };
                    session.out.send_reset(h2::Reason::CANCEL);
                    if i % burst == 0 {
                        tokio::task::yield_now().await;
                    }
                }
            };
            tokio::time::timeout(DEADLINE, reset).await.expect("the end of a connection");
        });
    }
    run.runtime.block_on(async {
        // More headers than anyone needs, and more than a stranger may send at all.
        for (count, told) in [(400, "431"), (3000, "")] {
            let connection = Connection::open(run.address, from(), WINDOW).await.unwrap();
            let Ok(mut session) = connection.call(SESSION, many_headers(count)).await else { continue };
            let status = session.reader.end().await;
            assert!(status.code() == Code::Unavailable && status.message().contains(told), "{status}");
        }
        // What the service does not have.
        let connection = Connection::open(run.address, from(), WINDOW).await.unwrap();
        let status = connection.call("/popgym.v1.Learner/Other", HeaderMap::new()).await.unwrap().reader.end().await;
        assert_eq!(status.code(), Code::Unimplemented);
    });
    drop(idle);
    run.expect_undisturbed(undisturbed());
}

#[test]
fn actors_that_send_nothing_of_use_are_cut() {
    let run = Attacked::begin(&RUN);
    let idle = run.hold();
    let flood = refused("flood");
    run.runtime.block_on(async {
        // A second session of one connection; the first goes on.
        let (connection, mut first) = run.joined(Ipv4Addr::new(127, 0, 1, 1), hello("two", 1)).await;
        let status = connection.session().await.unwrap().reader.end().await;
        assert_eq!(status.code(), Code::FailedPrecondition);
        assert_eq!(status.message(), "this connection has a session already");
        assert_eq!(run.counters(["sessions_refused_total{reason=\"second\"}"]), [1]);
        first.send(ActorMessage::Heartbeat).await.unwrap();
        first.reader.next().await.expect("the first session goes on");
        // Heartbeats, and nothing else.
        let (_connection, mut beating) = run.joined(Ipv4Addr::new(127, 0, 1, 2), hello("beating", 1)).await;
        // Not without end, which would be a flood before the answer is read.
        for _ in 0..4 * limits::HEARTBEATS.burst {
            let _ = beating.send(ActorMessage::Heartbeat).await;
        }
        let status = beating.reader.end().await;
        assert_eq!((status.code(), status.message()), (Code::ResourceExhausted, "too many heartbeats"));
        assert_eq!(run.counters(["sessions_refused_total{reason=\"heartbeats\"}"]), [1]);
        // Anything but messages of its session: that is allowed up to the longest message.
        let (connection, _session) = run.joined(Ipv4Addr::new(127, 0, 1, 3), hello("elsewhere", 1)).await;
        let before = run.counters([&flood]);
        while let Ok(mut call) = connection.call(HEALTH, HeaderMap::new()).await {
            let _ = call.send_bytes(&vec![0xff; 1 << 20]).await;
            call.reader.end().await;
        }
        assert_eq!(run.counters([&flood]), before.map(|count| count + 1));
    });
    drop(idle);
    run.expect_undisturbed(undisturbed());
}

#[test]
fn who_comes_again_and_again_is_kept_out() {
    let run = Attacked::begin(&RUN);
    let idle = run.hold();
    let rate = refused("rate");
    let address = run.address;
    // One who says hello and goes; one who lies each time, and so pays more.
    let comes = async |from, lies: bool| -> Option<()> {
        let connection = Connection::open(address, from, WINDOW).await.ok()?;
        let mut session = connection.session().await.ok()?;
        if lies {
            session.send_raw(vec![0xff; 5].into()).await.ok()?;
            (session.reader.end().await.code() == Code::InvalidArgument).then_some(())
        } else {
            session.send(ActorMessage::Hello(hello("guest", 1))).await.ok()?;
            session.reader.next().await.ok().map(drop)
        }
    };
    let mut before = 0;
    for (i, most) in [limits::ATTEMPTS.burst, limits::ATTEMPTS.burst / limits::OFFENCE_ATTEMPTS].into_iter().enumerate()
    {
        let (times, seconds) = run.runtime.block_on(async {
            let (begun, mut times) = (Instant::now(), 0);
            while comes(Ipv4Addr::new(127, 0, 1, i as u8), i == 1).await.is_some() {
                times += 1;
            }
            (times, begun.elapsed().as_secs() as u32 + 1)
        });
        // What time gives back counts too.
        assert!(times > 0 && times <= most + seconds * limits::ATTEMPTS.per_second, "{times} times in {seconds} s");
        let [after] = run.counters([&rate]);
        assert!(after > before, "{before} {after}");
        before = after;
    }
    // Nobody else is.
    run.runtime.block_on(async { comes(Ipv4Addr::new(127, 0, 2, 1), false).await.expect("a welcome") });
    drop(idle);
    run.expect_undisturbed(undisturbed());
}

#[test]
fn those_who_dawdle_take_nobody_elses_time() {
    const STRANGERS: usize = 3000;
    // As many descriptors as the system allows: each stranger takes one here.
    let Rlimit { maximum, .. } = getrlimit(Resource::Nofile);
    setrlimit(Resource::Nofile, Rlimit { current: maximum, maximum }).unwrap();
    let strangers = maximum.map_or(STRANGERS, |most| STRANGERS.min(most as usize / 2));
    let run = Attacked::begin(&RUN);
    let address = run.address;
    // One that stands still with its sockets open, as if its machine had.
    let standstill = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let frozen = standstill.block_on(async {
        let mut frozen = run.joined(Ipv4Addr::new(127, 0, 1, 1), hello("frozen", 16)).await;
        frozen.1.reader.next().await.expect("a word to one who is ready");
        frozen
    });
    let (unread, silent) = run.runtime.block_on(async {
        // One that sends, and reads nothing.
        let connection = Connection::open(address, Ipv4Addr::new(127, 0, 1, 2), 0).await.unwrap();
        let mut unread = connection.session().await.unwrap();
        unread.send(ActorMessage::Hello(hello("unread", 16))).await.unwrap();
        unread.send(ActorMessage::Ready(run.fingerprint)).await.unwrap();
        let alive = tokio::spawn(async move {
            hostile::stay_alive(&mut unread.out).await;
            unread.reader
        });
        // One whose message never ends.
        let (trickling, mut session) = run.joined(Ipv4Addr::new(127, 0, 1, 3), hello("trickling", 16)).await;
        let silent = tokio::spawn(async move {
            session.out.send_data(vec![0, 0, 0x10, 0, 0].into(), false).unwrap();
            while session.out.send_data(vec![0].into(), false).is_ok() && !trickling.is_over() {
                tokio::time::sleep(Duration::from_millis(500)).await;
            }
            session.reader.end().await
        });
        ((connection, alive), silent)
    });
    // Some that do not read what they asked for: while its answers are stuck, HTTP/2 does not read either.
    let deaf: Vec<_> = run.runtime.block_on(async {
        let deaf = (1..=8).map(|i| tokio::spawn(hostile::deaf(address, Ipv4Addr::new(127, 0, 2, i))));
        let mut streams = Vec::new();
        for stream in deaf.collect::<Vec<_>>() {
            streams.push(stream.await.unwrap().unwrap());
        }
        streams
    });
    run.counted(&refused("deadline"), deaf.len() as u64);
    // Very many that say nothing at all.
    let silent_ones: Vec<_> = run.runtime.block_on(async {
        let mut silent = Vec::new();
        for _ in 0..strangers {
            silent.push(connect(address, Ipv4Addr::new(127, 0, 1, 4)).await.unwrap());
        }
        silent
    });
    let most = limits::MAX_STRANGERS;
    run.counted(&refused("full"), (strangers - most) as u64);
    run.counted(&refused("deadline"), (deaf.len() + most) as u64);
    run.runtime.block_on(async {
        for stream in &silent_ones {
            hostile::closed(stream).await;
        }
    });
    run.counted("sessions_refused_total{reason=\"unread\"}", 1);
    run.counted("sessions_refused_total{reason=\"silent\"}", 1);
    let (status, silent) = run.runtime.block_on(async {
        // Now it reads: the last word is still there.
        unread.0.widen(WINDOW);
        (unread.1.await.unwrap().end().await, silent.await.unwrap())
    });
    assert_eq!((status.code(), status.message()), (Code::ResourceExhausted, "too slow: its messages were not read"));
    assert_eq!((silent.code(), silent.message()), (Code::DeadlineExceeded, "silent for 20 s"));
    for name in ["frozen", "unread", "trickling"] {
        until(&format!("the loss of {name}"), || {
            let log = run.learner.stderr();
            log.lines().any(|line| line.contains("actor lost") && line.contains(name)).then_some(())
        });
    }
    drop(frozen);
    run.expect_undisturbed(undisturbed());
}

/// One of a crowd: attacks in one of several ways.
async fn attack(run: Target, turn: u32) -> Option<()> {
    let [_, a, b, c] = (turn % run.addresses).to_be_bytes();
    let from = Ipv4Addr::new(127, 1 + a, b, c);
    let open = async || Connection::open(run.address, from, WINDOW).await.ok();
    let join = async |name, slots| {
        let connection = open().await?;
        let mut session = connection.session().await.ok()?;
        session.join(hello(name, slots), run.fingerprint).await.ok()?;
        Some((connection, session))
    };
    match turn % 10 {
        0 => {
            let (_connection, mut session) = join("heartbeats", 1).await?;
            while session.send(ActorMessage::Heartbeat).await.is_ok() {}
        }
        1 => {
            let (_connection, mut session) = join("illegal", 1).await?;
            session.send_bytes(&vec![0x1a; 4 << 20]).await.ok()?;
            session.reader.end().await;
        }
        2 => {
            let (_connection, mut session) = join("honest", 1).await?;
            session.send_raw(vec![0, 0xff, 0xff, 0xff, 0xff].into()).await.ok()?;
            session.reader.end().await;
        }
        3 => {
            let connection = open().await?;
            while let Ok(mut session) = connection.session().await {
                session.out.send_reset(h2::Reason::CANCEL);
                tokio::task::yield_now().await;
            }
        }
        4 => {
            let mut session = open().await?.session().await.ok()?;
            session.send(ActorMessage::Hello(hello(&"x".repeat(10_000), 1))).await.ok()?;
            session.reader.end().await;
        }
        5 => drop(join("gone", 16).await?),
        6 => {
            let connection = open().await?;
            while let Ok(mut call) = connection.call(HEALTH, many_headers(20)).await {
                call.send_raw(framed(&[]).into()).await.ok()?;
                if call.reader.end().await.code() == Code::Unavailable {
                    break;
                }
            }
        }
        7 => {
            // An episode in two bytes, two million times.
            let (_connection, mut session) = join("many", 1).await?;
            let empty = [0x1a, 0].repeat(1 << 21);
            let mut content = vec![0x1a];
            prost::encoding::encode_varint(empty.len() as u64, &mut content);
            content.extend(empty);
            session.send_bytes(&content).await.ok()?;
            session.reader.end().await;
        }
        8 => hostile::flood(&connect(run.address, from).await.ok()?, &[0xff; 64]).await,
        _ => {
            let [(_, pings), ..] = idle_frames();
            hostile::flood(&connect(run.address, from).await.ok()?, &pings).await;
        }
    }
    Some(())
}

/// Whom a crowd attacks.
#[derive(Clone, Copy)]
struct Target {
    address: SocketAddr,
    fingerprint: Fingerprint,
    /// Addresses from which the crowd comes, in turn.
    addresses: u32,
}

/// So many addresses that hardly one is seen twice: the learner does not know who it is.
const EVERYWHERE: u32 = 1 << 22;

/// Many who attack at once; they stop when this is dropped.
struct Crowd {
    over: Arc<AtomicBool>,
    turns: Arc<AtomicU32>,
}

impl Crowd {
    fn on(run: &Attacked, clients: usize, addresses: u32) -> Self {
        let crowd = Self { over: Arc::default(), turns: Arc::default() };
        let target = Target { address: run.address, fingerprint: run.fingerprint, addresses };
        for _ in 0..clients {
            let (over, turns) = (crowd.over.clone(), crowd.turns.clone());
            run.runtime.spawn(async move {
                while !over.load(Ordering::Relaxed) {
                    let turn = turns.fetch_add(1, Ordering::Relaxed);
                    // One that does not come to an end is of no more use; the learner has its own deadlines.
                    let _ = tokio::time::timeout(Duration::from_secs(30), attack(target, turn)).await;
                    tokio::time::sleep(Duration::from_millis(1)).await;
                }
            });
        }
        crowd
    }

    fn turns(&self) -> u32 {
        self.turns.load(Ordering::Relaxed)
    }
}

impl Drop for Crowd {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
    }
}

#[test]
fn a_crowd_of_them_changes_nothing() {
    let soak = std::env::var_os("POPGYM_SOAK").is_some_and(|value| value == "1");
    let (clients, steps) = if soak { (64, "1048576") } else { (8, RUN[3]) };
    let steps = [RUN[0], RUN[1], RUN[2], steps];
    let curve = if soak { Scene::new().curve("undisturbed", &steps) } else { undisturbed().to_owned() };
    let run = Attacked::begin(&steps);
    let crowd = Crowd::on(&run, clients, EVERYWHERE);
    until("a turn of each kind", || (crowd.turns() >= 20).then_some(()));
    run.expect_undisturbed(&curve);
    println!("{} attacks", crowd.turns());
}

/// Seconds of CPU that a process has used.
fn cpu_seconds(process: &str) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).expect("a process");
    let fields: Vec<&str> = stat.rsplit_once(')').expect("a name").1.split_whitespace().collect();
    let ticks: u64 = fields[11..13].iter().map(|field| field.parse::<u64>().expect("a number")).sum();
    ticks as f64 / 100.0
}

/// Steps so far.
fn steps(scene: &Scene) -> f64 {
    let metrics = scene.metrics("run");
    let last = metrics.lines().last().expect("a row");
    last.split(',').nth(1).expect("a column").parse().expect("a number")
}

#[test]
#[ignore = "a measurement: it prints what a crowd costs"]
fn what_a_crowd_costs() {
    const EPOCHS: usize = 300;
    const CROWDS: [(&str, usize, u32); 4] =
        [("none", 0, 1), ("1", 1, 1), ("8, one address", 8, 1), ("8, everywhere", 8, EVERYWHERE)];
    println!("CPU in seconds per million steps; the attackers are another process on the same machine");
    println!("| crowd | steps/s | learner's CPU | actor's CPU | attackers' CPU | attacks |");
    println!("|---|--:|--:|--:|--:|--:|");
    for _ in 0..5 {
        for (name, clients, addresses) in CROWDS {
            let mut run = Attacked::begin(&[RUN[0], RUN[1], RUN[2], "100000000"]);
            let crowd = Crowd::on(&run, clients, addresses);
            let processes = [run.learner.id().to_string(), run.honest.id().to_string(), "self".to_owned()];
            let look =
                |run: &Attacked| (Instant::now(), steps(&run.scene), processes.each_ref().map(|id| cpu_seconds(id)));
            let rows = run.scene.rows("run");
            let (begun, before, cpu_before) = look(&run);
            run.scene.reached(&mut run.learner, "run", rows + EPOCHS);
            let (ended, after, cpu_after) = look(&run);
            let steps = after - before;
            let [learner, actor, attackers] = [0, 1, 2].map(|i| (cpu_after[i] - cpu_before[i]) / steps * 1e6);
            println!(
                "| {name} | {:.0} | {learner:.1} | {actor:.1} | {attackers:.1} | {} |",
                steps / (ended - begun).as_secs_f64(),
                crowd.turns()
            );
        }
    }
}
