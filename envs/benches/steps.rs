//! Steps a second on one core, with uniformly random actions and with the resets between episodes.
//!
//! `cargo bench -p popgym-envs` prints a table; arguments, if any, are parts of the ids to measure. Without cargo's
//! `--bench` (under `cargo test --all-targets`) it only runs each environment for a moment.

use std::hint::black_box;
use std::time::{Duration, Instant};

use popgym_envs::{Purpose, Registry, Slab, Step, VecEnv, stream};

const ROWS: usize = 64;
const REPEATS: usize = 5;

/// Environments that step together, each with a random policy.
struct Bench {
    envs: VecEnv,
    rows: Vec<usize>,
    actions: Slab,
    observations: Slab,
    steps: Vec<Step>,
    episodes: u64,
}

impl Bench {
    fn new(registry: &Registry, id: &str, rows: usize) -> Self {
        let envs = VecEnv::new(registry, id, rows).expect("the id comes from the registry");
        let mut bench = Self {
            rows: (0..rows).collect(),
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
        let action = self.envs.spec().action.clone();
        let mut policy = stream(0, 0, 0, Purpose::TrainAction);
        let (start, mut steps) = (Instant::now(), 0);
        while start.elapsed() < time {
            // Many steps for each look at the clock.
            for _ in 0..4096_usize.div_ceil(self.rows.len()) {
                for &row in &self.rows {
                    action.sample_into(&mut policy, self.actions.row_mut(row));
                }
                self.envs.step_rows(&self.rows, &self.actions, &mut self.observations, &mut self.steps);
                for row in 0..self.rows.len() {
                    if self.steps[row].done() {
                        self.begin(row);
                    }
                }
                steps += self.rows.len();
            }
            black_box(&self.observations);
        }
        steps as f64 / start.elapsed().as_secs_f64()
    }

    fn median(&mut self, time: Duration) -> f64 {
        let mut speeds: Vec<f64> = (0..REPEATS).map(|_| self.run(time)).collect();
        speeds.sort_by(f64::total_cmp);
        speeds[REPEATS / 2]
    }
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let measure = arguments.iter().any(|argument| argument == "--bench");
    let parts: Vec<&String> = arguments.iter().filter(|argument| !argument.starts_with('-')).collect();
    let time = Duration::from_millis(if measure { 300 } else { 1 });
    println!("{:<44} {:>14} {:>14}", "million steps/s, one core", "1 env", format!("{ROWS} envs"));
    let registry = Registry::standard();
    for entry in &registry {
        if parts.is_empty() || parts.iter().any(|part| entry.id().contains(part.as_str())) {
            let [one, many] = [1, ROWS].map(|rows| Bench::new(&registry, entry.id(), rows).median(time) / 1e6);
            println!("{:<44} {one:>14.2} {many:>14.2}", entry.id());
        }
    }
}
