//! What the service for actors takes: many light actors that send recorded episodes as fast as they get leases, or at a given
//! rate.
//!
//! `cargo bench -p popgym-learner` prints a table. The learner's side is a whole one but for learning: episodes are accepted,
//! checked, written into `events.jsonl` and laid out as batches of 65,536 steps; after each the weights (GRU-256) go out to all.
//! Its actors are tasks of one other process on the same cores. Time is that of the processor, in shares of one core: of the
//! learner's network, of its batches, and of the actors. Last, 500 actors are connected, and what the metrics port answers is
//! timed. Without cargo's `--bench` (under `cargo test --all-targets`) it only
//! runs for a moment.

use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::process::{Child, Command};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use bytes::Bytes;
use popgym_envs::{Observability, Purpose, Registry, VecEnv, stream};
use popgym_learner::batch::Batch;
use popgym_learner::page::{self, Board};
use popgym_learner::service::{Entrance, Service, Target};
use popgym_models::{Policy, PolicyOptions, PolicySpec, memory};
use popgym_proto::{
    ActorMessage, Episode, EpisodeBatch, EpisodeBuilder, EpisodeSpec, Fingerprint, Hello, LearnerMessage,
    PROTOCOL_VERSION, RunSpec, transport,
};
use tch::Device;
use tokio::sync::{Semaphore, mpsc};
use tokio_stream::wrappers::ReceiverStream;

const ENV: &str = "RepeatPreviousEasy";
const BATCH_STEPS: u64 = 65_536;
const FINGERPRINT: Fingerprint = [3; 32];

/// Numbers of actors, and the steps a second that they send together; 0 for all that is taken.
const LOADS: [(usize, u64); 4] = [(1, 0), (16, 0), (256, 0), (256, 20_000)];

fn main() -> anyhow::Result<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    if let [role, address, actors, rate] = &words[..]
        && role == "actors"
    {
        return act(address.parse()?, actors.parse()?, rate.parse()?);
    }
    tch::set_num_threads(1);
    let measures = words.iter().any(|word| word == "--bench");
    println!(
        "{:>6} {:>10} {:>10} {:>10} {:>10} {:>10} {:>10} {:>12}",
        "actors", "asked", "steps/s", "MB/s in", "network", "batches", "actors", "memory, MiB"
    );
    for (actors, rate) in if measures { &LOADS[..] } else { &LOADS[1..2] } {
        measure(*actors, *rate, Duration::from_secs(if measures { 15 } else { 1 }), None)?;
    }
    let monitor = TcpListener::bind("127.0.0.1:0")?.local_addr()?;
    let board = Board::default();
    popgym_proto::monitor::serve(monitor, page::router(board.clone())).map_err(anyhow::Error::msg)?;
    let (actors, time) = if measures { (500, Duration::from_secs(15)) } else { (16, Duration::from_secs(1)) };
    measure(actors, 20_000, time, Some((monitor, board)))
}

/// Asks for `path` every 50 ms until `time` is over, and prints how long the answers took and how large they were.
fn scrape(address: SocketAddr, path: &str, time: Duration) -> anyhow::Result<String> {
    let (began, mut seconds, mut bytes) = (Instant::now(), Vec::new(), 0);
    while began.elapsed() < time {
        let asked = Instant::now();
        let mut stream = TcpStream::connect(address)?;
        write!(stream, "GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n")?;
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer)?;
        anyhow::ensure!(answer.starts_with(b"HTTP/1.1 200"), "{path}: {}", String::from_utf8_lossy(&answer));
        seconds.push(asked.elapsed().as_secs_f64());
        bytes = bytes.max(answer.len());
        std::thread::sleep(Duration::from_millis(50));
    }
    seconds.sort_by(f64::total_cmp);
    let ms = |share: f64| 1e3 * seconds[((seconds.len() - 1) as f64 * share) as usize];
    Ok(format!(
        "{path}: {} answers, median {:.1} ms, 99% within {:.1} ms, largest {:.0} KB",
        seconds.len(),
        ms(0.5),
        ms(0.99),
        bytes as f64 / 1e3
    ))
}

/// Serves `actors` actors for `time`, and prints a line; and what a metrics port answers meanwhile, if there is one.
fn measure(actors: usize, rate: u64, time: Duration, monitor: Option<(SocketAddr, Board)>) -> anyhow::Result<()> {
    let env = Registry::standard().get(ENV)?.observed(Observability::Partial)?;
    let memories = memory::Registry::standard();
    let spec = PolicySpec {
        observation: env.observation.clone(),
        action: env.action.clone(),
        memory: "gru".to_owned(),
        memory_options: memories.get("gru")?.resolve(&toml::Table::new())?,
        options: PolicyOptions { log_std_min: f64::NEG_INFINITY, log_std_max: f64::INFINITY },
        max_steps: env.max_steps,
    };
    let policy = Policy::new(&spec, &memories, Device::Cpu)?;
    let weights = Bytes::from(policy.to_bytes());
    let dir = tempfile::tempdir()?;
    let entrance = Entrance { listener: TcpListener::bind("127.0.0.1:0")?, tls: None };
    let episodes = EpisodeSpec { observation: env.observation, action: env.action.clone(), max_steps: env.max_steps };
    let account = dir.path().join("events.jsonl");
    let service = Service::start(vec![entrance], None, Some(&account), run_spec(), episodes, FINGERPRINT)?;
    let mut others = Others::start(service.addr(), actors, rate)?;
    while service.actors() < actors {
        anyhow::ensure!(others.0.try_wait()?.is_none(), "the actors have ended");
        std::thread::sleep(Duration::from_millis(10));
    }

    let scrapes = monitor.map(|(address, board)| {
        board.set_roster(service.roster());
        ["/metrics", "/run.json"].map(|path| std::thread::spawn(move || scrape(address, path, time)))
    });
    let (mut steps, mut bytes, mut epoch, mut start) = (0, 0, 0, None);
    // The first epoch warms up.
    loop {
        service.open(epoch, epoch, weights.clone(), Target::Steps(BATCH_STEPS))?;
        let collected = service.collect(|| false).context("the service has died")?;
        let batch = Batch::new(&collected.episodes, &env.action, &policy);
        epoch += 1;
        let (begun, before) = *start.get_or_insert_with(|| (Instant::now(), Usage::now(&others)));
        if epoch == 1 {
            continue;
        }
        steps += batch.steps();
        bytes += collected.episodes.iter().map(Episode::wire_bytes).sum::<usize>();
        if begun.elapsed() >= time {
            let (seconds, now) = (begun.elapsed().as_secs_f64(), Usage::now(&others));
            let share = |now: f64, before: f64| format!("{:.1}%", 100.0 * (now - before) / seconds);
            println!(
                "{actors:>6} {:>10} {:>10.0} {:>10.1} {:>10} {:>10} {:>10} {:>12.0}",
                if rate == 0 { "all".to_owned() } else { rate.to_string() },
                steps as f64 / seconds,
                bytes as f64 / 1e6 / seconds,
                share(now.network, before.network),
                share(now.all - now.network, before.all - before.network),
                share(now.others, before.others),
                peak_memory_mib(),
            );
            break;
        }
    }
    for scrapes in scrapes.into_iter().flatten() {
        println!("{}", scrapes.join().expect("no panic")?);
    }
    service.finish("measured");
    Ok(())
}

fn run_spec() -> RunSpec {
    RunSpec {
        run: "load".to_owned(),
        env: ENV.to_owned(),
        observability: Observability::Partial,
        max_episode_steps: 1024,
        memory: "gru".to_owned(),
        memory_options: toml::Table::new(),
        policy_options: toml::Table::new(),
        seed: 0,
        lag: 0,
        rows: 16,
        evaluation: false,
        greedy: false,
    }
}

/// The process of the actors.
struct Others(Child);

impl Others {
    fn start(address: SocketAddr, actors: usize, rate: u64) -> anyhow::Result<Self> {
        let words = ["actors".to_owned(), address.to_string(), actors.to_string(), rate.to_string()];
        Ok(Self(Command::new(std::env::current_exe()?).args(words).spawn()?))
    }
}

impl Drop for Others {
    fn drop(&mut self) {
        // They end with the service; here it has failed before.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Seconds of processor time so far.
#[derive(Clone, Copy)]
struct Usage {
    /// Of the threads of the learner's network.
    network: f64,
    /// Of this process.
    all: f64,
    /// Of the actors' process.
    others: f64,
}

impl Usage {
    fn now(others: &Others) -> Self {
        let tasks = std::fs::read_dir("/proc/self/task").into_iter().flatten().flatten();
        let network = tasks.map(|task| seconds(&task.path().join("stat"), Some("network"))).sum();
        let (all, others) = (
            seconds("/proc/self/stat".as_ref(), None),
            seconds(format!("/proc/{}/stat", others.0.id()).as_ref(), None),
        );
        Self { network, all, others }
    }
}

/// Of the process or thread that a file of `/proc` is about, if it has this name; else 0.
fn seconds(stat: &std::path::Path, name: Option<&str>) -> f64 {
    /// Ticks a second, on every Linux that there is.
    const TICKS: f64 = 100.0;
    let text = std::fs::read_to_string(stat).unwrap_or_default();
    let Some((head, rest)) = text.rsplit_once(')') else { return 0.0 };
    if name.is_some_and(|name| !head.ends_with(&format!("({name}"))) {
        return 0.0;
    }
    let fields = rest.split_whitespace().skip(11).take(2);
    fields.filter_map(|ticks| ticks.parse::<f64>().ok()).sum::<f64>() / TICKS
}

fn peak_memory_mib() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    line.and_then(|line| line.split_whitespace().next()?.parse::<f64>().ok()).map_or(f64::NAN, |kib| kib / 1024.0)
}

/// Actors that shake hands at a time: a learner has a limit of those from one address that have not yet said who they are.
const NEWCOMERS: usize = 64;

/// Runs `actors` actors until the learner stops them.
fn act(address: SocketAddr, actors: usize, rate: u64) -> anyhow::Result<()> {
    let episode = recorded()?;
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    runtime.block_on(async {
        let mut tasks = tokio::task::JoinSet::new();
        let door = Arc::new(Semaphore::new(NEWCOMERS));
        for actor in 0..actors {
            let pace = (rate > 0).then(|| Duration::from_secs_f64(actors as f64 / rate as f64));
            tasks.spawn(one_actor(address, door.clone(), actor, episode.clone(), pace));
        }
        while let Some(ended) = tasks.join_next().await {
            ended??;
        }
        Ok(())
    })
}

/// An episode as a random policy plays it.
fn recorded() -> anyhow::Result<Episode> {
    let mut envs = VecEnv::new(&Registry::standard(), ENV, 1)?;
    let (mut observations, mut actions) = (envs.observations(), envs.actions());
    let mut policy = stream(0, 0, 0, Purpose::TrainAction);
    envs.begin(0, stream(0, 0, 0, Purpose::TrainEnv), &mut observations);
    let mut episode = EpisodeBuilder::default();
    episode.begin(0, observations.row(0));
    loop {
        envs.spec().action.sample_into(&mut policy, actions.row_mut(0));
        let step = envs.step(0, actions.row(0), &mut observations)?;
        episode.push(actions.row(0), -1.0, step.reward, observations.row(0));
        if step.done() {
            return Ok(episode.finish(step.terminated, step.truncated));
        }
    }
}

/// One session; `pace` is the time that a step takes.
async fn one_actor(
    address: SocketAddr,
    door: Arc<Semaphore>,
    number: usize,
    episode: Episode,
    pace: Option<Duration>,
) -> anyhow::Result<()> {
    let mut entering = Some(door.acquire_owned().await?);
    let channel = transport::endpoint(&format!("http://{address}"))?.connect().await?;
    let (requests, stream) = mpsc::channel(4);
    let hello = Hello {
        protocol_version: PROTOCOL_VERSION,
        build: "bench".to_owned(),
        actor: format!("actor-{number}"),
        key: number as u64,
        incarnation: 1,
        slots: 16,
        run: None,
    };
    requests.send(ActorMessage::Hello(hello).into_wire()).await?;
    let mut replies = transport::client(channel).session(ReceiverStream::new(stream)).await?.into_inner();
    let (mut version, mut free_at) = (0, tokio::time::Instant::now());
    while let Some(message) = replies.message().await? {
        let leases = match LearnerMessage::from_wire(message)? {
            LearnerMessage::Welcome(_) => {
                requests.send(ActorMessage::Ready(FINGERPRINT).into_wire()).await?;
                drop(entering.take());
                continue;
            }
            LearnerMessage::Epoch(epoch) => {
                version = epoch.version;
                continue;
            }
            LearnerMessage::Leases(leases) => leases,
            LearnerMessage::Stop { .. } => return Ok(()),
            LearnerMessage::Closed { .. } | LearnerMessage::Heartbeat => continue,
        };
        if let Some(pace) = pace {
            free_at = free_at.max(tokio::time::Instant::now()) + pace * (episode.steps * leases.episodes.len()) as u32;
            tokio::time::sleep_until(free_at).await;
        }
        let episodes = leases.episodes.iter().map(|&index| Episode { index, ..episode.clone() }).collect();
        let batch = EpisodeBatch { epoch: leases.epoch, version, episodes };
        requests.send(ActorMessage::Episodes(batch).into_wire()).await?;
    }
    anyhow::bail!("the learner has gone")
}
