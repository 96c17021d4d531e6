//! Steps a second on one core, with uniformly random actions drawn in the loop and the resets between episodes.
//!
//! `cargo bench -p popgym-envs` prints a table: each environment alone and in a `VecEnv` of 64, beside the Python package as the
//! paper printed it (Colab, laptop) and as it was measured since, and how many times the package's rate the 64 reach.
//! Arguments, if any, are parts of the ids to measure. `--package FILE` takes the package's rates from a CSV that
//! `package_speed.py` wrote on this machine: rates of different machines, or of different hours, make no ratio to rely on.
//! Without cargo's `--bench` (under `cargo test --all-targets`) it only runs each environment for a moment.

use std::collections::HashMap;
use std::hint::black_box;
use std::path::Path;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use popgym_envs::{Purpose, Registry, Slab, Step, VecEnv, stream};

const ROWS: usize = 64;
const REPEATS: usize = 5;

/// The paper's table: steps a second by `RepeatFirst` and so on.
const PAPER: &str = include_str!("paper-env-fps.csv");
/// The package, version 1.0.7, on two virtual cores of an Intel Xeon: steps a second by id.
const PACKAGE: &str = include_str!("package-fps.csv");

/// Environments that step together under a random policy.
struct Bench {
    envs: VecEnv,
    actions: Slab,
    observations: Slab,
    steps: Vec<Step>,
    episodes: u64,
}

impl Bench {
    fn new(registry: &Registry, id: &str, rows: usize) -> Self {
        let envs = VecEnv::new(registry, id, rows).expect("the id comes from the registry");
        let mut bench = Self {
            actions: envs.actions(),
            observations: envs.observations(),
            steps: vec![Step::default(); rows],
            episodes: 0,
            envs,
        };
        (0..rows).for_each(|row| bench.begin(row));
        bench
    }

    fn begin(&mut self, row: usize) {
        self.episodes += 1;
        self.envs.begin(row, stream(0, 0, self.episodes, Purpose::TrainEnv), &mut self.observations);
    }

    /// Steps a second over `time`.
    fn run(&mut self, time: Duration) -> f64 {
        let (action, rows) = (self.envs.spec().action.clone(), self.envs.rows());
        let mut policy = stream(0, 0, 0, Purpose::TrainAction);
        let (start, mut steps) = (Instant::now(), 0);
        while start.elapsed() < time {
            // Many steps for each look at the clock.
            for _ in 0..4096_usize.div_ceil(rows) {
                action.sample_rows(&mut policy, &mut self.actions);
                let ended = self.envs.step_all(&self.actions, &mut self.observations, &mut self.steps);
                if ended.expect("running episodes, and actions of the space") > 0 {
                    for row in 0..rows {
                        if self.steps[row].done() {
                            self.begin(row);
                        }
                    }
                }
                steps += rows;
            }
            black_box(&self.observations);
        }
        steps as f64 / start.elapsed().as_secs_f64()
    }

    fn median(&mut self, time: Duration) -> f64 {
        median((0..REPEATS).map(|_| self.run(time)).collect())
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    f64::midpoint(values[(values.len() - 1) / 2], values[values.len() / 2])
}

/// Rates by name: the first column, and those of the columns `columns`.
fn rates<const N: usize>(csv: &str, columns: [usize; N]) -> Result<HashMap<String, [f64; N]>, String> {
    let row = |line: &str| {
        let fields: Vec<&str> = line.split(',').collect();
        let rate = |column: usize| fields.get(column)?.parse().ok().filter(|rate| *rate > 0.0);
        let rates = columns.map(rate);
        if rates.contains(&None) {
            return Err(format!("`{line}` is no row of rates"));
        }
        Ok((fields[0].to_owned(), rates.map(Option::unwrap_or_default)))
    };
    csv.lines().skip(1).map(row).collect()
}

/// A rate in thousands, or a dash.
fn thousands(rate: Option<f64>) -> String {
    rate.map_or_else(|| "-".to_owned(), |rate| format!("{:.1}", rate / 1e3))
}

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run() -> Result<(), String> {
    let (mut parts, mut measure, mut package) = (Vec::new(), false, PACKAGE.to_owned());
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--bench" => measure = true,
            "--package" => {
                let file = arguments.next().ok_or("--package needs a file")?;
                package = std::fs::read_to_string(Path::new(&file)).map_err(|error| format!("{file}: {error}"))?;
            }
            // What cargo's own test runner would take means nothing here.
            flag if flag.starts_with('-') => {}
            _ => parts.push(argument),
        }
    }
    let paper = rates(PAPER, [2, 3])?;
    let package = rates(&package, [1])?;
    let time = Duration::from_millis(if measure { 300 } else { 1 });
    println!(
        "{:<46}{:>10}{:>10} |{:>11}{:>11}{:>11} |{:>8}",
        "", "million", "steps/s", "thousand", "steps/s of", "the package", ""
    );
    println!(
        "{:<46}{:>10}{:>10} |{:>11}{:>11}{:>11} |{:>8}",
        "one core",
        "1 env",
        format!("{ROWS} envs"),
        "Colab",
        "laptop",
        "measured",
        "ratio"
    );
    let registry = Registry::standard();
    let mut ratios = Vec::new();
    for entry in &registry {
        if !parts.is_empty() && !parts.iter().any(|part| entry.id().contains(part.as_str())) {
            continue;
        }
        let [one, many] = [1, ROWS].map(|rows| Bench::new(&registry, entry.id(), rows).median(time));
        let difficulty = entry.difficulty.map(|difficulty| difficulty.to_string()).unwrap_or_default();
        let game = entry.paper_name.as_deref().and_then(|name| paper.get(name.strip_suffix(&difficulty)?));
        let theirs = package.get(entry.id()).map(|[rate]| *rate);
        let ratio = theirs.map(|rate| many / rate);
        println!(
            "{:<46}{:>10.2}{:>10.2} |{:>11}{:>11}{:>11} |{:>8}",
            entry.id(),
            one / 1e6,
            many / 1e6,
            thousands(game.map(|rates| rates[0])),
            thousands(game.map(|rates| rates[1])),
            thousands(theirs),
            ratio.map_or_else(|| "-".to_owned(), |ratio| format!("{ratio:.0}x"))
        );
        ratios.extend(ratio);
    }
    if !ratios.is_empty() {
        let least = ratios.iter().copied().fold(f64::INFINITY, f64::min);
        let hundred = ratios.iter().filter(|&&ratio| ratio >= 100.0).count();
        println!(
            "ratio: least {least:.0}x, median {:.0}x; {hundred} of {} at 100x or more",
            median(ratios.clone()),
            ratios.len()
        );
    }
    Ok(())
}
