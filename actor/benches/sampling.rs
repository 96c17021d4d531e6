//! How much of an actor's time goes to anything but inference.
//!
//! On one thread: the bare rate of `policy.act`, and the rate of the whole loop (environment, encoding, inference,
//! drawing actions, episodes to wire bytes), for several numbers of rows, and their ratio.
//!
//! `cargo bench -p popgym-actor [-- MEMORY [ENV]]`

use std::time::{Duration, Instant};

use popgym_actor::{Rollout, worker};
use popgym_models::memory;
use popgym_proto::{Episode, RunSpec};
use prost::Message as _;
use tch::{Device, Kind, Tensor};

/// Both rates are measured in turns, so that whatever else the machine does meets both.
const ROUNDS: u32 = 6;
const ROUND: Duration = Duration::from_millis(500);

fn main() -> anyhow::Result<()> {
    tch::set_num_threads(1);
    // Cargo adds flags of its own.
    let mut words = std::env::args().skip(1).filter(|arg| !arg.starts_with("--"));
    let memory = words.next().unwrap_or_else(|| "gru".to_owned());
    let env = words.next().unwrap_or_else(|| "RepeatPreviousEasy".to_owned());
    println!("{memory} on {env}, one thread, {:.0} MiB resident before", resident_mib());
    println!(
        "{:>5} {:>16} {:>16} {:>7} {:>12} {:>10}",
        "rows", "act, rows/s", "actor, steps/s", "ratio", "bytes/step", "RSS, MiB"
    );
    for rows in [16, 64, 128, 256, 512] {
        let mut rollout = rollout(&memory, &env, rows)?;
        let mut sampler = Sampler::default();
        let (mut act, mut steps) = (0.0, 0.0);
        for round in 0..=ROUNDS {
            let rates = (act_rate(&rollout, rows), sampler.rate(&mut rollout));
            // The first warms up.
            if round > 0 {
                act += rates.0 / f64::from(ROUNDS);
                steps += rates.1 / f64::from(ROUNDS);
            }
        }
        let (ratio, bytes) = (100.0 * steps / act, sampler.bytes as f64 / sampler.sent_steps.max(1) as f64);
        println!("{rows:>5} {act:>16.0} {steps:>16.0} {ratio:>6.1}% {bytes:>12.1} {:>10.0}", resident_mib());
    }
    Ok(())
}

fn rollout(memory: &str, env: &str, slots: u32) -> anyhow::Result<Rollout> {
    let envs = popgym_envs::Registry::standard();
    let memories = memory::Registry::standard();
    let spec = RunSpec {
        run: "bench".to_owned(),
        env: envs.canonical(env)?.to_owned(),
        observability: popgym_envs::Observability::Partial,
        max_episode_steps: 1024,
        memory: memory.to_owned(),
        memory_options: memories.get(memory)?.resolve(&toml::Table::new())?,
        policy_options: toml::from_str("log_std_min = -inf\nlog_std_max = inf")?,
        seed: 0,
        lag: 0,
        rows: slots,
        evaluation: false,
        greedy: false,
    };
    let mut rollout = Rollout::new(&envs, &memories, spec, slots)?;
    let weights = rollout.policy().to_bytes();
    rollout.open(0, 0, Some(&weights))?;
    Ok(rollout)
}

/// Rows a second of `Policy::act` alone.
fn act_rate(rollout: &Rollout, rows: u32) -> f64 {
    let policy = rollout.policy();
    let features = Tensor::randn([i64::from(rows), policy.encoder().width() as i64], (Kind::Float, Device::Cpu));
    let mut state = policy.initial_state(i64::from(rows));
    let (begun, mut calls) = (Instant::now(), 0_u32);
    while begun.elapsed() < ROUND {
        (_, state) = policy.act(&features, &state);
        calls += 1;
    }
    f64::from(calls) * f64::from(rows) / begun.elapsed().as_secs_f64()
}

/// The whole loop, with leases without end.
#[derive(Default)]
struct Sampler {
    next_lease: u64,
    finished: Vec<Episode>,
    sent_steps: usize,
    bytes: usize,
}

impl Sampler {
    /// Environment steps a second.
    fn rate(&mut self, rollout: &mut Rollout) -> f64 {
        let (begun, mut steps) = (Instant::now(), 0);
        while begun.elapsed() < ROUND {
            if rollout.waiting() <= rollout.live() {
                rollout.lease(self.next_lease..self.next_lease + 1024);
                self.next_lease += 1024;
            }
            rollout.step(&mut self.finished).expect("actions of the space");
            steps += rollout.live() + self.finished.len();
            self.sent_steps += self.finished.iter().map(|episode| episode.steps).sum::<usize>();
            for message in worker::messages(0, 0, &mut self.finished) {
                self.bytes += message.encode_to_vec().len();
            }
        }
        steps as f64 / begun.elapsed().as_secs_f64()
    }
}

/// Resident memory of this process.
fn resident_mib() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    line.and_then(|line| line.split_whitespace().next()?.parse::<f64>().ok()).map_or(f64::NAN, |kib| kib / 1024.0)
}
