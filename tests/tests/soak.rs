//! Random faults in one run, one upon the other: it ends with the curve of the undisturbed run, byte for byte, and its account is
//! in order.
//!
//! A few of them in every test run. With `POPGYM_SOAK=1`, as `make soak` has it, 200 for each lag; then also how soon who was
//! struck is at work again is printed and held to its bounds, and that the learner's memory and descriptors stay as they are.

use std::collections::BTreeSet;
use std::fmt;
use std::fs;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use popgym_envs::rng::{EpisodeRng, Purpose, below, stream};
use popgym_tests::net::{self, Network};
use popgym_tests::process::Life;
use popgym_tests::{POLL_INTERVAL, Process, Scene, until};
use rustix::process::Signal;
use serde_json::Value;

/// Actors on the other side of a network that fails; one more is the learner's own.
const REMOTE: usize = 3;

/// Steps of a run that ends only when it is asked to.
const ENDLESS: &str = "1000000000000";

/// After this long a learner has all the memory that it will have: it draws the curve's picture for the second time after a
/// minute, and the allocator then keeps the room.
const SETTLED: Duration = Duration::from_secs(70);

/// Steps after the last fault.
const REST: u64 = 8192;

/// Beyond a learner's and an actor's patience with one another (20 s).
const LONG: Duration = Duration::from_secs(22);

#[derive(Clone, Copy, Debug, PartialEq)]
enum Fault {
    KillLocalActors,
    KillActor(usize),
    FreezeActor(usize, Duration),
    KillLearner,
    CutNetwork(usize),
    StallNetwork(usize, Duration),
}

impl Fault {
    /// One of those that come in this part of the run. A learner is killed in the first half alone: what it holds is
    /// looked at in the other.
    fn draw(rng: &mut EpisodeRng, first_half: bool, long: bool) -> Self {
        let actor = below(rng, REMOTE as u32) as usize;
        let lasts = if long && below(rng, 10) == 0 { LONG } else { Duration::from_millis(u64::from(below(rng, 1500))) };
        match below(rng, if first_half { 6 } else { 5 }) {
            0 => Self::KillLocalActors,
            1 => Self::KillActor(actor),
            2 => Self::FreezeActor(actor, lasts),
            3 => Self::CutNetwork(actor),
            4 => Self::StallNetwork(actor, lasts),
            _ => Self::KillLearner,
        }
    }
}

impl Fault {
    /// Whether who recovers from this fault is struck by the other.
    fn meets(self, other: Self) -> bool {
        let actor = |fault| match fault {
            Self::KillActor(i) | Self::FreezeActor(i, _) | Self::CutNetwork(i) | Self::StallNetwork(i, _) => Some(i),
            Self::KillLocalActors => Some(REMOTE),
            Self::KillLearner => None,
        };
        actor(self).is_none() || actor(other).is_none() || actor(self) == actor(other)
    }
}

/// Whether this is the whole form.
fn whole() -> bool {
    std::env::var_os("POPGYM_SOAK").is_some_and(|value| value == "1")
}

fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).expect("a clock").as_secs_f64()
}

/// A run with its actors, and what has been done to them.
struct Fleet {
    scene: Scene,
    learner: Process,
    listen: String,
    metrics: String,
    networks: Vec<Network>,
    actors: Vec<Process>,
    /// Ends of freezes and stalls.
    recoveries: Vec<(Instant, Fault)>,
    /// When what was done, in seconds since 1970, while nobody was frozen or stalled; or when somebody was.
    struck: Vec<(f64, Fault, bool)>,
    /// Bytes of the learner's memory, from the middle of the run on.
    memory: Vec<u64>,
    local: Vec<Life>,
}

impl Fleet {
    fn start(scene: Scene, flags: &[&str]) -> Self {
        let (listen, metrics) = (net::free_address(), net::free_address());
        let service = ["--actors", "1", "--listen", &listen, "--metrics-listen", &metrics];
        let learner = scene.train("run", &[flags, &service].concat());
        let networks: Vec<Network> = (0..REMOTE).map(|_| Network::to(&listen)).collect();
        let actors = (0..REMOTE).map(|i| start_actor(&scene, &networks[i], i)).collect();
        Self {
            scene,
            learner,
            listen,
            metrics,
            networks,
            actors,
            recoveries: Vec::new(),
            struck: Vec::new(),
            memory: Vec::new(),
            local: Vec::new(),
        }
    }

    fn strike(&mut self, fault: Fault) {
        self.local.extend(self.learner.actors());
        self.struck.push((now(), fault, self.recoveries.is_empty()));
        match fault {
            Fault::KillLocalActors => {
                for actor in self.learner.actors() {
                    actor.signal(Signal::KILL);
                }
            }
            Fault::KillActor(i) => {
                self.recoveries.retain(|(_, fault)| !matches!(fault, Fault::FreezeActor(frozen, _) if *frozen == i));
                self.actors[i].kill();
                self.actors[i] = start_actor(&self.scene, &self.networks[i], i);
            }
            Fault::FreezeActor(i, lasts) => {
                self.actors[i].signal(Signal::STOP);
                self.recoveries.push((Instant::now() + lasts, fault));
            }
            Fault::CutNetwork(i) => self.networks[i].cut(),
            Fault::StallNetwork(i, lasts) => {
                self.networks[i].stall(true);
                self.recoveries.push((Instant::now() + lasts, fault));
            }
            Fault::KillLearner => {
                self.learner.kill();
                Life::expect_gone(&self.local);
                let service = ["--listen", &self.listen, "--metrics-listen", &self.metrics];
                self.learner = self.scene.resume("run", &service);
            }
        }
    }

    fn recover(&mut self, by: Instant) {
        let (due, later) = self.recoveries.drain(..).partition(|(end, _)| *end <= by);
        self.recoveries = later;
        let due: Vec<(Instant, Fault)> = due;
        for (_, fault) in due {
            match fault {
                Fault::FreezeActor(i, _) => self.actors[i].signal(Signal::CONT),
                Fault::StallNetwork(i, _) => self.networks[i].stall(false),
                _ => unreachable!("nothing else lasts"),
            }
        }
    }

    /// Lets the run go on for so long.
    fn go_on(&mut self, time: Duration) {
        let end = Instant::now() + time;
        while Instant::now() < end {
            self.recover(Instant::now());
            assert!(self.learner.is_running(), "the learner has ended after {:?}", self.struck.last());
            std::thread::sleep(POLL_INTERVAL);
        }
    }

    /// Waits until every actor is there; returns how many descriptors the learner then has.
    fn complete(&mut self) -> usize {
        while !self.recoveries.is_empty() {
            self.recover(Instant::now());
            std::thread::sleep(POLL_INTERVAL);
        }
        net::get(&self.metrics, "/metrics", &[&format!("popgym_learner_actors {}\n", REMOTE + 1)]);
        let descriptors = format!("/proc/{}/fd", self.learner.id());
        fs::read_dir(descriptors).expect("a running learner").count()
    }

    fn weigh(&mut self) {
        let statm = fs::read_to_string(format!("/proc/{}/statm", self.learner.id())).expect("a running learner");
        let pages: u64 = statm.split(' ').nth(1).and_then(|pages| pages.parse().ok()).expect("resident pages");
        self.memory.push(pages * rustix::param::page_size() as u64);
    }

    /// Ends the run some steps after the last fault, and checks it; returns how soon who was struck was at work again.
    fn end(mut self, lag: &str) -> Vec<Recovery> {
        self.local.extend(self.learner.actors());
        self.learner.signal(Signal::TERM);
        self.learner.expect(0);
        let summary = self.scene.json("run/summary.json");
        let steps = (summary["env_steps"].as_u64().expect("steps") + REST).to_string();
        let mut learner = self.scene.resume("run", &["--steps", &steps, "--listen", &self.listen]);
        self.local.extend(learner.actors());
        finish(learner);
        for mut actor in self.actors {
            let outcome = actor.wait();
            // One that was between two connections when the run ended has not heard of it.
            let status = i32::from(!outcome.stderr.contains("run complete"));
            assert_eq!(outcome.status.code(), Some(status), "{}", outcome.stderr);
            assert!(status == 0 || outcome.stderr.contains("error: no learner at"), "{}", outcome.stderr);
        }
        Life::expect_gone(&self.local);
        let scene = Scene::new();
        finish(scene.train("undisturbed", &["--lag", lag, "--steps", &steps]));
        assert_eq!(self.scene.accounted("run"), scene.metrics("undisturbed"));
        recoveries(&self.scene.read("run/events.jsonl"), &self.struck)
    }
}

/// Waits for the end of a run, which may take longer than anything else.
fn finish(mut learner: Process) {
    while learner.is_running() {
        std::thread::sleep(Duration::from_millis(100));
    }
    learner.expect(0);
}

fn start_actor(scene: &Scene, network: &Network, i: usize) -> Process {
    scene.actor(&network.url(), &["--name", &name(i), "--retry-seconds", "60"])
}

fn name(i: usize) -> String {
    format!("remote-{i}")
}

/// Whether it is this actor's, who has a number behind its name while the connection it had before is not given up.
fn is_name(actor: &str, i: usize) -> bool {
    actor.split('#').next() == Some(&name(i))
}

/// From a fault to the next lease of who was struck, in seconds.
struct Recovery {
    what: &'static str,
    seconds: f64,
    bound: f64,
}

/// Of those faults that met no other.
fn recoveries(account: &str, struck: &[(f64, Fault, bool)]) -> Vec<Recovery> {
    let lines: Vec<Value> = account.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
    let leased = |after: f64, is_it: &dyn Fn(&str) -> bool| {
        let joined = lines.iter().position(|line| {
            line["time"].as_f64() >= Some(after)
                && line["event"] == "joined"
                && line["actor"].as_str().is_some_and(is_it)
        })?;
        let actor = &lines[joined]["actor"];
        let lease = lines[joined..].iter().find(|line| line["event"] == "leased" && line["actor"] == *actor)?;
        lease["time"].as_f64()
    };
    let mut found = Vec::new();
    for (index, &(time, fault, _)) in struck.iter().enumerate().filter(|(_, strike)| strike.2) {
        let next = struck[index + 1..].iter().find(|(_, other, _)| fault.meets(*other));
        let next = next.map_or(f64::INFINITY, |(time, _, _)| *time);
        let (what, bound, back) = match fault {
            Fault::KillLocalActors => {
                ("a killed local actor's replacement", 3.0, leased(time, &|actor| !actor.starts_with("remote")))
            }
            Fault::KillActor(i) => {
                ("a killed remote actor's replacement", 3.0, leased(time, &|actor| is_name(actor, i)))
            }
            Fault::KillLearner => {
                let all = (0..REMOTE).map(|i| leased(time, &|actor| is_name(actor, i)));
                let last = all.collect::<Option<Vec<f64>>>().map(|times| times.into_iter().fold(0.0, f64::max));
                ("all actors, after the learner was killed", 5.0, last)
            }
            _ => continue,
        };
        // One who is not back when the next fault meets it was too late, or had no chance to be in time.
        let late = (next.is_finite() && next - time > bound).then_some(next);
        if let Some(back) = back.filter(|&back| back < next).or(late) {
            found.push(Recovery { what, seconds: back - time, bound });
        }
    }
    found
}

impl fmt::Display for Recovery {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:<45} {:>6.2} s of {} s", self.what, self.seconds, self.bound)
    }
}

/// The learner's memory, from its smallest to its largest, in bytes.
fn range(memory: &[u64]) -> (u64, u64) {
    memory.iter().fold((u64::MAX, 0), |(least, most), &bytes| (least.min(bytes), most.max(bytes)))
}

fn survives(lag: &str) {
    let faults: u64 = if whole() { 200 } else { 10 };
    let seed = std::env::var("POPGYM_SOAK_SEED").map_or(0, |seed| seed.parse().expect("a seed"));
    let mut rng = stream(seed, 0, 0, Purpose::Shuffle);
    let mut fleet = Fleet::start(Scene::new(), &["--lag", lag, "--steps", ENDLESS]);
    fleet.complete();
    let mut descriptors = None;
    for fault in 0..faults {
        let first_half = fault < faults / 2;
        if !first_half {
            let before = *descriptors.get_or_insert_with(|| {
                fleet.go_on(if whole() { SETTLED } else { Duration::ZERO });
                fleet.complete()
            });
            fleet.weigh();
            if fault + 1 == faults {
                until("no more descriptors than before", || (fleet.complete() <= before).then_some(()));
            }
        }
        fleet.strike(Fault::draw(&mut rng, first_half, whole()));
        if below(&mut rng, 3) == 0 {
            fleet.complete();
        }
        fleet.go_on(Duration::from_millis(u64::from(below(&mut rng, 300))));
    }
    fleet.complete();
    fleet.weigh();
    let (least, most) = range(&fleet.memory);
    let recoveries = fleet.end(lag);
    if whole() {
        println!(
            "lag {lag}, {faults} faults, seed {seed}; the learner's memory in the second half: {least} to {most} bytes"
        );
        for recovery in &recoveries {
            println!("{recovery}");
        }
        assert!(most - least <= most / 20, "the learner's memory is not flat: {least} to {most} bytes");
        assert!(recoveries.iter().all(|recovery| recovery.seconds <= recovery.bound), "too late");
        let kinds: BTreeSet<&str> = recoveries.iter().map(|recovery| recovery.what).collect();
        assert!(kinds.len() == 3 && recoveries.len() >= 30, "too few recoveries to tell");
    }
}

#[test]
fn random_faults_change_nothing_without_lag() {
    survives("0");
}

#[test]
fn random_faults_change_nothing_with_lag() {
    survives("1");
}
