//! A run with an actor that works, and those who attack it.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::{OnceLock, mpsc};

use popgym_proto::{ActorMessage, Fingerprint, Hello, LearnerMessage};
use tokio::runtime::Runtime;
use tokio::task::JoinHandle;

use crate::hostile::{self, Connection, Session, hello};
use crate::{DEADLINE, Process, Scene, net, until};

/// Epochs of some hundredths of a second: 32 of them. Observations are two reals, actions one of two.
pub const RUN: [&str; 4] = ["--env", "StatelessCartPoleEasy", "--steps", "16384"];

/// Bytes of a stream that may be on the way: more than any liar reads.
pub const WINDOW: u32 = 1 << 20;

/// The curve of an undisturbed run.
pub fn undisturbed() -> &'static str {
    static CURVE: OnceLock<String> = OnceLock::new();
    CURVE.get_or_init(|| Scene::new().curve("undisturbed", &RUN))
}

/// A run with an actor that works, and those who attack it.
#[derive(Debug)]
pub struct Attacked {
    /// Of the attackers.
    pub runtime: Runtime,
    /// Of the run, which is called `run`.
    pub scene: Scene,
    /// The learner.
    pub learner: Process,
    /// The actor that works.
    pub honest: Process,
    /// Where the learner listens.
    pub address: SocketAddr,
    metrics: String,
    /// What an actor of this run says to be let in.
    pub fingerprint: Fingerprint,
}

/// One that keeps a run waiting while it is there.
#[derive(Debug)]
pub struct Idle(JoinHandle<()>);

impl Drop for Idle {
    fn drop(&mut self) {
        self.0.abort();
    }
}

const FOR_IDLE: Ipv4Addr = Ipv4Addr::new(127, 0, 0, 2);

async fn join(address: SocketAddr, from: Ipv4Addr, hello: Hello, fingerprint: Fingerprint) -> (Connection, Session) {
    let connection = Connection::open(address, from, WINDOW).await.expect("a connection");
    let mut session = connection.session().await.expect("a session");
    session.join(hello, fingerprint).await.expect("a welcome");
    (connection, session)
}

impl Attacked {
    /// Starts it with these flags besides [`Attacked`]'s own; returns when it is in its middle.
    ///
    /// # Panics
    /// If it does not get there.
    pub fn begin(run: &[&str]) -> Self {
        let runtime = Runtime::new().expect("a runtime");
        let (scene, metrics) = (Scene::new(), net::free_address());
        let remote = ["--actors", "0", "--listen", "127.0.0.1:0", "--metrics-listen", metrics.as_str()];
        let mut learner = scene.train("run", &[run, &remote].concat());
        let url = learner.url();
        let address = url.trim_start_matches("http://").parse().expect("an address");
        let fingerprint = runtime.block_on(async {
            let connection = Connection::open(address, Ipv4Addr::LOCALHOST, WINDOW).await.expect("a connection");
            let mut session = connection.session().await.expect("a session");
            session.send(ActorMessage::Hello(hello("curious", 1))).await.expect("a stream");
            let Ok(LearnerMessage::Welcome(spec)) = session.reader.next().await else { panic!("no welcome") };
            hostile::fingerprint(spec, |url| scene.actor(url, &[])).await
        });
        let honest = scene.actor(&url, &["--name", "honest"]);
        scene.reached(&mut learner, "run", 3);
        Self { runtime, scene, learner, honest, address, metrics, fingerprint }
    }

    /// A session of an actor that is ready.
    ///
    /// # Panics
    /// If it is not welcome.
    pub async fn joined(&self, from: Ipv4Addr, hello: Hello) -> (Connection, Session) {
        join(self.address, from, hello, self.fingerprint).await
    }

    /// Takes leases and does nothing about them, so that the run gets hardly on until this is dropped.
    ///
    /// # Panics
    /// If there are none.
    pub fn hold(&self) -> Idle {
        let (address, fingerprint) = (self.address, self.fingerprint);
        let (held, first) = mpsc::channel();
        let idle = self.runtime.spawn(async move {
            // The learner loses its patience with each.
            loop {
                let (_connection, mut session) = join(address, FOR_IDLE, hello("idle", 4096), fingerprint).await;
                if session.held(1).await.is_ok() {
                    // Fails for all but the first.
                    let _ = held.send(());
                    tokio::select! {
                        () = hostile::stay_alive(&mut session.out) => {}
                        _ = session.reader.end() => {}
                    }
                }
            }
        });
        first.recv_timeout(DEADLINE).expect("leases");
        Idle(idle)
    }

    /// The counters of these names now.
    pub fn counters<const N: usize>(&self, names: [&str; N]) -> [u64; N] {
        let seen = net::get(&self.metrics, "/metrics", &[]);
        names.map(|name| net::counter(&seen, &format!("popgym_learner_{name}")))
    }

    /// Waits until a counter is at least `value`.
    ///
    /// # Panics
    /// Past the deadline.
    pub fn counted(&self, name: &str, value: u64) {
        until(&format!("{name} to be {value}"), || (self.counters([name]) >= [value]).then_some(()));
    }

    /// The run's end is as if nothing had been.
    ///
    /// # Panics
    /// If it is not.
    pub fn expect_undisturbed(self, curve: &str) -> String {
        self.honest.expect(0);
        let log = self.learner.expect(0).stderr;
        assert_eq!(self.scene.accounted("run"), curve);
        // Liars, who have keys of their own, may take one another's place.
        let replaced = |line: &str| line.contains("connected anew") && line.contains("actor=\"honest\"");
        assert!(!log.lines().any(replaced) && log.chars().all(|c| c == '\n' || !c.is_control()), "{log}");
        log
    }
}
