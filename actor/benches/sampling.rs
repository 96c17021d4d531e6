//! How much of an actor's time goes to anything but inference.
//!
//! On one thread: the bare rate of `policy.act`, and the rate of the whole loop (environment, encoding, inference,
//! drawing actions, episodes to wire bytes), for several numbers of rows, and their ratio.
//!
//! `cargo bench -p popgym-actor [-- MEMORY [ENV]]`

use std::time::{Duration, Instant};

use popgym_actor::{Rollout, worker};
use popgym_models::memory;
use popgym_proto::RunSpec;
use prost::Message as _;
use tch::{Device, Kind, Tensor};

const WARM_UP: Duration = Duration::from_millis(500);
const MEASURE: Duration = Duration::from_secs(3);

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
        let act = act_rate(&rollout, rows);
        let (steps, bytes) = sampling_rate(&mut rollout);
        let ratio = 100.0 * steps / act;
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
        max_episode_steps: 1024,
        memory: memory.to_owned(),
        memory_options: memories.get(memory)?.resolve(&toml::Table::new())?,
        policy_options: toml::from_str("log_std_min = -inf\nlog_std_max = inf")?,
        seed: 0,
        lag: 0,
        rows: slots,
        evaluation: false,
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
    let mut act = |time: Duration| {
        let (begun, mut calls) = (Instant::now(), 0_u32);
        while begun.elapsed() < time {
            (_, state) = policy.act(&features, &state);
            calls += 1;
        }
        f64::from(calls) * f64::from(rows) / begun.elapsed().as_secs_f64()
    };
    act(WARM_UP);
    act(MEASURE)
}

/// Environment steps a second of the whole loop, and bytes a step on the wire.
fn sampling_rate(rollout: &mut Rollout) -> (f64, f64) {
    let (mut next, mut finished) = (0_u64, Vec::new());
    let mut sample = |time: Duration| {
        let (begun, mut steps, mut sent, mut bytes) = (Instant::now(), 0_usize, 0_usize, 0_usize);
        while begun.elapsed() < time {
            if rollout.waiting() < 64 {
                rollout.lease(next..next + 1024);
                next += 1024;
            }
            rollout.step(&mut finished);
            steps += rollout.live() + finished.len();
            sent += finished.iter().map(|episode| episode.steps).sum::<usize>();
            for message in worker::messages(0, 0, &mut finished) {
                bytes += message.encode_to_vec().len();
            }
        }
        (steps as f64 / begun.elapsed().as_secs_f64(), bytes as f64 / sent.max(1) as f64)
    };
    sample(WARM_UP);
    sample(MEASURE)
}

/// Resident memory of this process.
fn resident_mib() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    line.and_then(|line| line.split_whitespace().next()?.parse::<f64>().ok()).map_or(f64::NAN, |kib| kib / 1024.0)
}
